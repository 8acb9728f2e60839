"""Several adapters on one base: memory, swapping, and batches.

    python -m benchmarks.adapters                            # pi0 nano
    python -m benchmarks.adapters --size base --dtype bfloat16 --method lora_sp

Weights are random. "own weights" is a policy served alone, whose adapter is fused with its base in
advance. Requests to several adapters run as one batch each. --shapes-only computes the memory
without allocating it.
"""

import argparse
import dataclasses
import functools
from typing import Any

import jax
import numpy as np
from flax import nnx
from rich.console import Console

from benchmarks import backbones
from benchmarks.measuring import best, machine, print_table
from lorasp_jax import adapt, peft
from lorasp_jax.adapters import adaptation
from lorasp_jax.extras.serving.adapters import OnDevice
from lorasp_jax.extras.serving.exported import sampling_options
from lorasp_jax.models import backbone, presets
from lorasp_jax.models.observation import Observation, abstract_observation
from lorasp_jax.models.shared_base import SharedBase, SharedSampler


@dataclasses.dataclass(frozen=True)
class Holder:
    """What `OnDevice` places: a policy without its processor."""

    model: SharedSampler


def sizes(config: Any, rules: Any) -> tuple[int, int]:
    """Return the memory of base and adapter [bytes], from shapes, as files hold them.

    On a base, an adapter's factors have the dtype of the products: half as much in bf16.
    """
    build = lambda: adapt(config.create(nnx.Rngs(0)), rules, rngs=nnx.Rngs(1))  # noqa: E731
    _, adapters, frozen = adaptation.split(nnx.eval_shape(build))
    total = lambda tree: sum(a.size * a.dtype.itemsize for a in jax.tree.leaves(tree))  # noqa: E731
    return total(frozen), total(adapters)


def memory_rows(config: Any, rules: Any, adapters: int) -> list[dict[str, Any]]:
    """Return the table of memory in GB."""
    base, own = sizes(config, rules)
    copies, shared = adapters * (base + own), base + adapters * own
    return [
        {
            "base GB": base / 1e9,
            "adapter GB": own / 1e9,
            f"{adapters} copies GB": copies / 1e9,
            f"one base, {adapters} adapters GB": shared / 1e9,
        }
    ]


def make_samplers(config: Any, rules: Any, adapters: int) -> tuple[list[SharedSampler], Any]:
    """Return samplers of random adapters on one base, and the sampler of one of them alone."""
    model = config.create(nnx.Rngs(0))
    base, first = SharedBase(model), adapt(model, rules, rngs=nnx.Rngs(1))
    sampler = base.attach_model(first, model)
    keys = jax.random.split(jax.random.key(0), adapters)
    samplers = []
    for key in keys:  # in host memory
        each = jax.random.split(key, len(sampler.own))
        own = [np.asarray(_near(k, a)) for k, a in zip(each, sampler.own, strict=True)]
        samplers.append(dataclasses.replace(sampler, own=own))
    return samplers, jax.jit(lambda model: model.sampler())(first)


@jax.jit
def _near(key: jax.Array, array: jax.Array) -> jax.Array:
    """Add noise to one of an adapter's arrays."""
    return array + (0.01 * jax.random.normal(key, array.shape)).astype(array.dtype)


@functools.partial(jax.jit, static_argnames="steps", compiler_options=sampling_options())
def sample(sampler: Any, obs: Observation, noise: jax.Array, *, steps: int) -> jax.Array:
    """Sample with one adapter."""
    return sampler.sample_actions(None, obs, noise=noise, num_steps=steps)


def device_rows(samplers: list[SharedSampler]) -> list[dict[str, Any]]:
    """Return the table of memory in GB that the base and the placed adapters take."""
    place = OnDevice()
    placed = [place(Holder(each)).model for each in samplers]  # type: ignore[arg-type]
    arrays = {id(a): a.nbytes for each in placed for a in (*each.base, *each.own)}
    return [{"adapters": len(placed), "arrays GB": sum(arrays.values()) / 1e9}]


def swap_rows(samplers: list[SharedSampler]) -> list[dict[str, Any]]:
    """Time an adapter's way from host memory to the device."""
    place = OnDevice(1)
    turns = [Holder(each) for each in samplers[:2]]
    swap = lambda: [place(each).model.own for each in turns]  # type: ignore[arg-type]  # noqa: E731
    milliseconds = best(swap, repeats=5) / 2 * 1e3
    bytes_ = sum(a.nbytes for a in samplers[0].own)
    return [{"swap ms": milliseconds, "GB/s": bytes_ / milliseconds / 1e6}]


def batch_rows(
    config: Any, samplers: list[SharedSampler], alone: Any, batch: int, steps: int
) -> list[dict[str, Any]]:
    """Time batches."""
    obs = backbones.noise(abstract_observation(config, batch))
    noise = jax.random.normal(jax.random.key(1), (batch, config.chunk, config.action_dim))
    single = [jax.tree.map(lambda a, i=i: a[i : i + 1], (obs, noise)) for i in range(batch)]
    chosen = [samplers[i % len(samplers)] for i in range(batch)]
    placed = [dataclasses.replace(each, own=jax.device_put(each.own)) for each in chosen]
    run = functools.partial(sample, steps=steps)
    calls = {
        "own weights, 1": (1, lambda: run(alone, *single[0])),
        f"own weights, {batch}": (batch, lambda: run(alone, obs, noise)),
        "one base, 1": (1, lambda: run(placed[0], *single[0])),
        f"one base, {batch}": (batch, lambda: run(placed[0], obs, noise)),
        f"{batch} adapters, one batch each": (
            batch,
            lambda: [run(p, *each) for p, each in zip(placed, single, strict=True)],
        ),
    }
    table = []
    for name, (requests, call) in calls.items():
        seconds = best(call, repeats=5)
        table.append({"batch": name, "ms": seconds * 1e3, "requests/s": requests / seconds})
    return table


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--backbone", default="pi0", choices=backbone.names())
    parser.add_argument("--size", default="nano")
    parser.add_argument("--dtype", default="float32", choices=("float32", "bfloat16"))
    parser.add_argument("--method", default="lora_sp", choices=peft.names())
    parser.add_argument("--rank", type=int, default=128)
    parser.add_argument("--targets", default="paper", help="preset or regular expression")
    parser.add_argument("--adapters", type=int, default=10)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--denoise-steps", type=int, default=10)
    parser.add_argument("--shapes-only", action="store_true", help="only compute the memory")
    options = parser.parse_args()
    console = Console()
    config = getattr(backbone.find(options.backbone), options.size)()
    config = dataclasses.replace(config, dtype=options.dtype, param_dtype=options.dtype)
    method = dataclasses.replace(peft.create(options.method), rank=options.rank)  # type: ignore[call-arg]
    rules = presets.rules(options.targets, method)
    print_table(console, memory_rows(config, rules, options.adapters), "memory, from shapes")
    if options.shapes_only:
        return
    console.print(machine("jax", "lorasp_jax"))
    samplers, alone = make_samplers(config, rules, options.adapters)
    print_table(console, device_rows(samplers), "memory, measured")
    print_table(console, swap_rows(samplers), "from host memory to the device")
    table = batch_rows(config, samplers, alone, options.batch, options.denoise_steps)
    print_table(console, table, f"{options.batch} requests")


if __name__ == "__main__":
    main()
