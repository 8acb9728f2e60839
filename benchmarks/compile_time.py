"""Compile time of a stack of dense layers, bare and adapted, compared with qwix's LoRA.

    JAX_PLATFORMS=cpu python -m benchmarks.compile_time

The program is the gradient of a training loss, including auxiliary losses, with respect to the
adapters. Times are CPU seconds of this process on all cores, which other programs hardly affect,
and the best of several repeats. Ratios are relative to qwix's LoRA in the same run
(`pip install qwix`), or to the bare model if qwix is not installed.
"""

import argparse
import importlib.util
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx
from rich.console import Console

import lorasp_jax
from benchmarks.measuring import machine, print_table, write_json
from benchmarks.peers.stacks import Stack
from lorasp_jax import peft
from lorasp_jax.adapters.adaptation import adapt

LOSS_WEIGHT = 1e-2
PHASES = ("trace s", "lower s", "compile s", "total s")


def models(base: Stack, x: jax.Array, rank: int) -> Iterator[tuple[str, Any, Any]]:
    """Yield each model's name, the model and its type of trainable variables, reference first."""
    if importlib.util.find_spec("qwix"):
        import qwix  # pyright: ignore[reportMissingImports]

        provider = qwix.LoraProvider(module_path=".*", rank=rank, alpha=2.0 * rank)
        yield (
            "qwix LoRA",
            qwix.apply_lora_to_model(base, provider, x, rngs=nnx.Rngs(0)),
            nnx.LoRAParam,
        )
    yield "bare", base, nnx.Param
    for name in peft.names():
        fields = {} if name == "full" else {"rank": rank}
        rules = [("layers", peft.create(name, **fields))]
        yield name, adapt(base, rules, rngs=nnx.Rngs(0)), nnx.LoRAParam


def gradient(model: nnx.Module, kind: Any) -> tuple[Callable[..., Any], tuple[Any, Any]]:
    """Return the function to compile, and its first two arguments."""
    graphdef, trainable, frozen = nnx.split(nnx.clone(model), kind, ...)

    def loss(trainable: Any, frozen: Any, x: jax.Array) -> jax.Array:
        model: Any = nnx.merge(graphdef, trainable, frozen)
        total = jnp.square(model(x)).mean()
        if nnx.state(model, lorasp_jax.dense.AdapterAux):
            for aux in lorasp_jax.collect_aux(model).values():
                total += LOSS_WEIGHT * sum(aux.losses.values())
        return total

    return jax.value_and_grad(loss), (trainable, frozen)


def seconds(function: Callable[..., Any], *arguments: Any) -> tuple[float, ...]:
    """Measure the CPU seconds of each of `PHASES`."""
    jax.clear_caches()
    times = [time.process_time()]
    traced = jax.jit(function).trace(*arguments)
    times.append(time.process_time())
    lowered = traced.lower()
    times.append(time.process_time())
    lowered.compile()
    times.append(time.process_time())
    return times[1] - times[0], times[2] - times[1], times[3] - times[2], times[3] - times[0]


def measure(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yield one row per model, interleaving the models so that machine load affects all alike."""
    x = jnp.ones((options.tokens, options.width), options.dtype)
    base = Stack(options.depth, options.width, options.dtype)
    times: dict[str, list[tuple[float, ...]]] = {}
    functions = {name: gradient(m, kind) for name, m, kind in models(base, x, options.rank)}
    for _ in range(options.repeats):
        for name, (function, arguments) in functions.items():
            times.setdefault(name, []).append(seconds(function, *arguments, x))
    fastest = {name: min(rows, key=lambda row: row[-1]) for name, rows in times.items()}
    reference = next(iter(fastest.values()))[-1]
    for name, row in fastest.items():
        yield {"model": name, **dict(zip(PHASES, row, strict=True)), "ratio": row[-1] / reference}


def main(arguments: list[str] | None = None) -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--depth", type=int, default=12)
    parser.add_argument("--width", type=int, default=512)
    parser.add_argument("--tokens", type=int, default=1024)
    parser.add_argument("--rank", type=int, default=16)
    parser.add_argument("--dtype", default="float32")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", type=Path, help="file for the results")
    options = parser.parse_args(arguments)
    jax.config.update("jax_enable_compilation_cache", False)
    console, name = Console(soft_wrap=True), machine("jax")
    console.print(
        f"{name}; {options.depth} layers of width {options.width}, {options.tokens} tokens, "
        f"rank {options.rank}, {options.dtype}"
    )
    rows = list(measure(options))
    print_table(console, rows)
    write_json(options.json, {"machine": name, "rows": rows})


if __name__ == "__main__":
    main()
