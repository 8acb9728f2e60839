"""openpi's pi0 (JAX): its LoRA training and its sampling, with its own model, optimizer and loss.

openpi's model file imports its PyTorch port, which needs a patched transformers and is not used
here. An empty module takes its place.
"""

import dataclasses
import functools
import sys
import types
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import nnx

from benchmarks.peers import worker, workloads
from benchmarks.peers.worker import Job, Row

CAMERAS = ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")
TINY = {"width": 64, "depth": 4, "mlp_dim": 128, "num_heads": 8, "num_kv_heads": 1, "head_dim": 16}
PACKAGES = ("openpi", "jax", "flax", "optax", "jaxtyping", "beartype", "augmax")


def import_models() -> Any:
    """Import and return openpi's modules pi0_config, model, optimizer and nnx_utils."""
    port = types.ModuleType("openpi.models_pytorch")
    port.pi0_pytorch = types.ModuleType("openpi.models_pytorch.pi0_pytorch")
    sys.modules[port.__name__] = port
    from openpi.models import model, pi0_config  # pyright: ignore[reportMissingImports]
    from openpi.shared import nnx_utils  # pyright: ignore[reportMissingImports]
    from openpi.training import optimizer  # pyright: ignore[reportMissingImports]

    return types.SimpleNamespace(
        pi0_config=pi0_config, model=model, optimizer=optimizer, nnx_utils=nnx_utils
    )


def shrink(image: int) -> None:
    """Replace the sizes of towers and images [pixels], which openpi fixes in its code."""
    from openpi.models import gemma, model, siglip  # pyright: ignore[reportMissingImports]

    published, vision = gemma.get_config, siglip.Module
    model.IMAGE_RESOLUTION = (image, image)
    model.preprocess_observation.__kwdefaults__["image_resolution"] = model.IMAGE_RESOLUTION

    def small_vision(*arguments: Any, **options: Any) -> Any:
        return vision(*arguments, **options | {"variant": "mu/16"})

    gemma.get_config = lambda variant: dataclasses.replace(published(variant), **TINY)
    siglip.Module = small_vision


def inputs(openpi: Any, job: Job, size: int) -> tuple[Any, jax.Array]:
    """Return the observation and actions of the common batch."""
    batch = workloads.policy_batch(workloads.PI0[job.size], size)
    observation = openpi.model.Observation(
        images={name: jnp.asarray(x) for name, x in zip(CAMERAS, batch["images"], strict=True)},
        image_masks={name: jnp.ones(size, bool) for name in CAMERAS},
        state=jnp.asarray(batch["state"]),
        tokenized_prompt=jnp.asarray(batch["tokens"]),
        tokenized_prompt_mask=jnp.ones(batch["tokens"].shape, bool),
    )
    return observation, jnp.asarray(batch["actions"])


def model_config(openpi: Any, job: Job, *, lora: bool) -> Any:
    """Return openpi's config; its LoRA has rank 16 in the language model and 32 in the expert."""
    suffix, shape = "_lora" if lora else "", workloads.PI0[job.size]
    if job.size == "tiny":
        shrink(shape.image)
    return openpi.pi0_config.Pi0Config(
        paligemma_variant=f"gemma_2b{suffix}",
        action_expert_variant=f"gemma_300m{suffix}",
        action_dim=shape.dim,
        action_horizon=shape.chunk,
        max_token_len=shape.tokens,
    )


def halved(tree: Any) -> Any:
    """Cast all floating-point arrays to bf16."""

    def cast(x: jax.Array) -> jax.Array:
        return x.astype(jnp.bfloat16) if jnp.issubdtype(x.dtype, jnp.floating) else x

    return jax.tree.map(cast, tree)


def split(config: Any, kind: Any) -> tuple[Any, Any, Any]:
    """Return the graph, the parameters of `kind` in f32 and all others in bf16, with random values.

    Both are created in one program, so that the f32 values of frozen parameters are not kept.
    """
    graph = nnx.split(nnx.eval_shape(config.create, jax.random.key(0)), kind, ...)[0]

    @jax.jit
    def draw(key: jax.Array) -> tuple[Any, Any]:
        trained, frozen = nnx.split(config.create(key), kind, ...)[1:]
        return trained, halved(frozen)

    return graph, *draw(jax.random.key(0, impl="rbg"))


def train(job: Job) -> Iterator[Row]:
    """Time training steps as in openpi's `scripts/train.py`, without data loading and logging."""
    openpi, augment = import_models(), not job.variant.endswith("without augmentation")
    config = model_config(openpi, job, lora=True)
    kind = nnx.All(nnx.Param, nnx.Not(config.get_freeze_filter()))
    graph, trained, frozen = split(config, kind)
    schedule = openpi.optimizer.CosineDecaySchedule()
    optimizer = openpi.optimizer.create_optimizer(openpi.optimizer.AdamW(), schedule)
    batch = workloads.PI0[job.size].batch
    observation, actions = inputs(openpi, job, batch)

    def step(state: tuple[Any, Any], frozen: Any, observation: Any, actions: jax.Array) -> Any:
        trained, moments = state

        def loss(trained: Any) -> jax.Array:
            model = nnx.merge(graph, trained, frozen)
            return model.compute_loss(jax.random.key(1), observation, actions, train=augment).mean()

        value, gradients = jax.value_and_grad(loss)(trained)
        updates, moments = optimizer.update(gradients, moments, trained)
        return (optax.apply_updates(trained, updates), moments), value

    compiled, state = jax.jit(step, donate_argnums=0), [(trained, jax.jit(optimizer.init)(trained))]
    count = sum(leaf.size for leaf in jax.tree.leaves(trained))
    del trained

    def call() -> jax.Array:
        state[0], value = compiled(state[0], frozen, observation, actions)
        return value

    row = worker.timed(f"batch {batch}", call, jax.block_until_ready, job)
    yield row | {"samples": batch, "trainable": count, "gib": worker.jax_peak_gib()}


def sample(job: Job) -> Iterator[Row]:
    """Time sampling as in openpi's policies, with bf16 weights, from images to actions."""
    openpi = import_models()
    graph, _, frozen = split(model_config(openpi, job, lora=False), lambda *_: False)
    model = nnx.merge(graph, nnx.State({}), frozen)
    run = openpi.nnx_utils.module_jit(model.sample_actions)
    for size in workloads.PI0[job.size].sampled:
        observation = inputs(openpi, job, size)[0]
        for steps in job.denoise_steps:
            call = functools.partial(run, jax.random.key(1), observation, num_steps=steps)
            item = worker.sampled(size, steps)
            yield worker.timed(item, call, jax.block_until_ready, job) | {"samples": size}


def measure(job: Job) -> Iterator[Row]:
    """Yield the rows of one job."""
    yield from (sample if job.table == "pi0-sample" else train)(job)


if __name__ == "__main__":
    worker.main(measure, worker.jax_device, PACKAGES)
