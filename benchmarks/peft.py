"""Cost of adapters: a dense layer with and without each method, forward and with gradients.

    python -m benchmarks.peft --json peft.json
    python -m benchmarks.peft --tokens 1024 --shapes 256x2048 2048x256 --dtype float32   # on a CPU

Each shape [I, O] has these rows:

- bare: the frozen layer alone
- usual LoRA: autodiff of x W + scale (x A) B, as LoRA is usually written
- this project's methods at rank R, with their losses

Gradients are with respect to the input and the adapter, as in training. Ratios are relative to the
usual LoRA in the same run. With `--float8`, two more columns (f8) are for both passes with a float8
base. Memory is that of the compiled program without its arguments.

A second table compares separate with grouped calls of layers that share an input ("I:O,O,O"). A
third compares the energy gate with a copy of its scores. Everything is warmed up twice, and ten
calls are queued at once (for the gate, one call with 20 gates).
"""

import argparse
import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from rich.console import Console

from benchmarks.measuring import best, machine, print_table, write_json
from lorasp_jax import peft
from lorasp_jax.dense import DenseLayer, dense_shared_input
from lorasp_jax.kernels.energy_gate import energy_gate
from lorasp_jax.kernels.frozen_matmul import Kernel, frozen_matmul
from lorasp_jax.kernels.quantized_weights import quantize_kernel

SHAPES = ((2048, 16384), (16384, 2048), (2048, 2048), (1152, 4304))
# Query, key and value projections of pi0's language model and vision tower; gate and up projections
# of a smaller MLP.
SHARED_INPUT = ((2048, (2048, 256, 256)), (1152, (1152, 1152, 1152)), (1024, (4096, 4096)))
QUEUED = 10
COPIES = 20  # gates per program: the launch dominates the time of a single gate
LOSS_WEIGHT = 1e-2

Layer = Callable[[Any, jax.Array, Any], tuple[Any, Any]]


def bare(params: Any, x: jax.Array, kernel: Kernel) -> tuple[jax.Array, Any]:
    """Apply only the frozen layer."""
    del params
    return frozen_matmul(x, kernel), {}


def usual_lora(params: Any, x: jax.Array, kernel: jax.Array) -> tuple[jax.Array, Any]:
    """Apply LoRA as it is usually written."""
    a, b = (params[name].astype(x.dtype) for name in ("lora_a", "lora_b"))
    return x @ kernel + 2.0 * ((x @ a) @ b), {}


def layers(rank: int) -> Iterator[tuple[str, Layer, Any]]:
    """Yield each layer's name, its function and the method that creates its parameters."""
    yield "bare", bare, peft.LoRA(rank=1)
    yield "usual LoRA", usual_lora, peft.LoRA(rank=rank)
    for name in peft.names():
        method = make(name, rank)
        yield name, adapted(method), method


def adapted(method: peft.Method) -> Layer:
    """Return the layer of a method."""

    def layer(params: Any, x: jax.Array, kernel: jax.Array) -> tuple[jax.Array, Any]:
        y, aux = method.apply(params, x, kernel)
        return y, dict(aux.losses)

    return layer


def make(name: str, rank: int) -> peft.Method:
    """Create a method with `rank` directions in total."""
    fields: dict[str, dict[str, Any]] = {
        "full": {},
        "lora_moe": {"rank": rank // 4},
    }
    return peft.create(name, **fields.get(name, {"rank": rank}))


def inputs(method: peft.Method, shape: tuple[int, int], tokens: int, dtype: str) -> Any:
    """Sample parameters, x [tokens, I], kernel [I, O] and the gradient of y, on the device."""

    @jax.jit
    def draw(key: jax.Array) -> Any:
        keys = jax.random.split(key, 4)
        kernel = jax.random.normal(keys[0], shape, dtype) / shape[0] ** 0.5
        x = jax.random.normal(keys[1], (tokens, shape[0]), dtype)
        gradient = jax.random.normal(keys[2], (tokens, shape[1]), dtype)
        return method.init(keys[3], kernel)[0], x, kernel, gradient

    return draw(jax.random.key(0))


def with_gradients(layer: Layer, params: Any, x: jax.Array, kernel: Any, g: Any) -> Any:
    """Compute y and the gradients with respect to x and the adapter, including auxiliary losses."""

    def run(params: Any, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        y, losses = layer(params, x, kernel)
        return y, sum(losses.values(), jnp.zeros(()))

    (y, loss), vjp = jax.vjp(run, params, x)
    return y, vjp((g, jnp.full_like(loss, LOSS_WEIGHT)))


def measure_shared_input(
    options: argparse.Namespace, d_in: int, d_outs: tuple[int, ...]
) -> Iterator[dict[str, Any]]:
    """Measure layers that share an input, one by one and grouped."""
    for name in ("lora", "lora_sp"):
        method = make(name, options.rank)
        drawn = [inputs(method, (d_in, d_out), options.tokens, options.dtype) for d_out in d_outs]
        params, xs, kernels, gradients = map(list, zip(*drawn, strict=True))

        def separate(params: Any, x: jax.Array, kernels: Any, method: Any = method) -> Any:
            return [method.apply(p, x, k) for p, k in zip(params, kernels, strict=True)]

        def grouped(params: Any, x: jax.Array, kernels: Any, method: Any = method) -> Any:
            pairs = zip(params, kernels, strict=True)
            return dense_shared_input(x, [DenseLayer(k, None, p, method) for p, k in pairs])

        seconds = []
        for layers in (separate, grouped):
            run = jax.jit(functools.partial(with_gradients, functools.partial(_summed, layers)))
            arguments = (params, xs[0], kernels, gradients)
            run = run.lower(*arguments).compile()
            seconds.append(best(functools.partial(run, *arguments), calls=QUEUED))
        yield {
            "layers": f"{d_in}:{','.join(map(str, d_outs))}",
            "method": name,
            "separate ms": 1e3 * seconds[0],
            "grouped ms": 1e3 * seconds[1],
            "ratio": seconds[1] / seconds[0],
        }


def _summed(layers: Callable[..., Any], *arguments: Any) -> tuple[list[jax.Array], Any]:
    """Return the outputs of several layers, and each loss summed over the layers."""
    outputs = layers(*arguments)
    losses = (dict(aux.losses) for _, aux in outputs)
    return [y for y, _ in outputs], jax.tree.map(lambda *x: sum(x), *losses)


def measure(options: argparse.Namespace, shape: tuple[int, int]) -> Iterator[dict[str, Any]]:
    """Yield the rows of one shape."""
    base: dict[str, float] = {}
    for name, layer, method in layers(options.rank):
        params, x, kernel, g = inputs(method, shape, options.tokens, options.dtype)
        seconds, memory = measure_layer(layer, params, x, kernel, g)
        if name == "usual LoRA":
            base = seconds
        row = {
            "shape": "x".join(map(str, shape)),
            "layer": name,
            "fwd ms": 1e3 * seconds["forward"],
            "fwd+bwd ms": 1e3 * seconds["both"],
            "fwd ratio": seconds["forward"] / base["forward"] if base else "",
            "ratio": seconds["both"] / base["both"] if base else "",
            "MiB": (memory.temp_size_in_bytes + memory.output_size_in_bytes) / 2**20,
        }
        if options.float8:
            row |= {"f8 ms": "", "f8 ratio": ""}
            if name != "usual LoRA" and not method.trains_base:
                quantized = quantize_kernel(kernel, "float8")
                both = measure_layer(layer, params, x, quantized, g)[0]["both"]
                row["f8 ms"] = 1e3 * both
                row["f8 ratio"] = both / base["both"] if base else ""
        yield row


def measure_layer(layer: Layer, *arrays: Any) -> tuple[dict[str, float], Any]:
    """Time a layer on (parameters, x, kernel, gradient): its forward pass, and both passes.

    Returns:
        The times [s], and the memory analysis of both passes.
    """
    forward = jax.jit(lambda p, x, w: layer(p, x, w)[0]).lower(*arrays[:3]).compile()
    both = jax.jit(functools.partial(with_gradients, layer)).lower(*arrays).compile()
    seconds = {
        "forward": best(functools.partial(forward, *arrays[:3]), calls=QUEUED),
        "both": best(functools.partial(both, *arrays), calls=QUEUED),
    }
    return seconds, both.memory_analysis()


def measure_gate(options: argparse.Namespace) -> dict[str, Any]:
    """Time the gate on fp32 scores [tokens, R], and a copy of these scores for comparison."""
    keys = jax.random.split(jax.random.key(0), COPIES)
    draw = jax.jit(jax.vmap(lambda key: jax.random.normal(key, (options.tokens, options.rank))))
    scores = [*jax.nn.softplus(draw(keys))]
    gate = jax.jit(lambda scores: [energy_gate(s, 0.9)[0] for s in scores])
    copy = jax.jit(lambda scores: [-s for s in scores])
    gated, copied = (best(lambda f=f: f(scores)) / COPIES for f in (gate, copy))
    return {
        "gate": f"{options.tokens}x{options.rank}",
        "us": 1e6 * gated,
        "copy us": 1e6 * copied,
        "ratio": gated / copied,
    }


def _shape(text: str) -> tuple[int, int]:
    d_in, d_out = map(int, text.split("x"))
    return d_in, d_out


def _shared_input(text: str) -> tuple[int, tuple[int, ...]]:
    d_in, _, d_outs = text.partition(":")
    return int(d_in), tuple(map(int, d_outs.split(",")))


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--shapes", nargs="+", type=_shape, default=SHAPES, metavar="IxO")
    parser.add_argument(
        "--together", nargs="+", type=_shared_input, default=SHARED_INPUT, metavar="I:O,O"
    )
    parser.add_argument("--tokens", type=int, default=26112)
    parser.add_argument("--rank", type=int, default=128)
    parser.add_argument("--dtype", default="bfloat16")
    parser.add_argument("--float8", action="store_true", help="also with a float8 base")
    parser.add_argument("--json", type=Path, help="file for the results")
    options = parser.parse_args()
    console = Console(soft_wrap=True)
    results: dict[str, Any] = {"machine": machine("jax"), "rows": []}
    console.print(
        f"{results['machine']}; {options.tokens} tokens, rank {options.rank}, {options.dtype}"
    )
    for shape in options.shapes:
        rows = list(measure(options, shape))
        print_table(console, rows)
        results["rows"] += rows
    results["together"] = [
        row for case in options.together for row in measure_shared_input(options, *case)
    ]
    print_table(console, results["together"])
    results["gate"] = measure_gate(options)
    print_table(console, [results["gate"]])
    write_json(options.json, results)


if __name__ == "__main__":
    main()
