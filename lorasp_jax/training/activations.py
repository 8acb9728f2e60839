"""Activations of a model on the data of a run."""

import re
from collections.abc import Callable, Iterator

import jax
from flax import nnx

from lorasp_jax.adapters import paths
from lorasp_jax.adapters.compress import calibration
from lorasp_jax.data.batches import Batch, encode
from lorasp_jax.data.stream import Stream
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.policies.processor import Processor
from lorasp_jax.training import fixed_batches, rules
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run import Run

BATCHES = 8
"""Number of batches on which activations are measured."""


def input_moments(run: Run, model: Backbone, processor: Processor) -> dict[str, jax.Array]:
    """Return `calibration.input_moments` of the layers that need them, over training batches."""
    pairs = rules.rules(run.config)

    def needs(path: str) -> bool:
        method = None if (i := paths.find_rule(pairs, path)) is None else pairs[i][1]
        return method is not None and method.needs_statistics

    layers = [layer.path for layer in paths.locate_matmul_layers(nnx.List([model]))]
    pattern = "|".join(f"^{re.escape(path)}$" for path in layers if needs(path))
    batches = sampled(run, processor, model.config.chunk)
    return calibration.input_moments(model, batches, pattern, fixed_batches.forward)


def sampled(run: Run, processor: Processor, chunk: int) -> Iterator[fixed_batches.Keyed]:
    """Yield `BATCHES` random keys and training batches."""
    sample = batch_sampler(run, processor, chunk)
    key = RandomStream.STATISTICS.key(run.config.seed)
    for batch_key, loss_key in jax.random.split(key, (BATCHES, 2)):
        yield loss_key, sample(batch_key)


def batch_sampler(run: Run, processor: Processor, chunk: int) -> Callable[[jax.Array], Batch]:
    """Return a function from a random key to a training batch."""
    size, noise = run.config.optim.batch_size, run.config.optim.state_noise
    if run.streams:
        stream = Stream(run.steps, batch_size=size, chunk=chunk, seed=run.config.seed)
        return lambda key: encode(key, next(stream), processor, state_noise=noise)
    steps = jax.device_put(run.steps)
    sizes = {"batch_size": size, "chunk": chunk, "state_noise": noise}
    return lambda key: fixed_batches.sample(key, steps, processor, **sizes)
