"""Latency of LoRA-SP layers for one token: the full bank compared with gathered active directions.

    python -m benchmarks.decoding --json decoding.json
    python -m benchmarks.decoding --dtype float32 --shapes 1024x1024 --ranks 128 512   # on a CPU

Several layers with separate arrays run in one program, so that neither launch overhead nor cache
hits dominate. Capacity, the number of directions gathered, is a fraction of the rank R. An
untrained router keeps about 0.9 R directions, more than the capacity; the gather drops the rest,
which does not affect its time. "gain" is dense time divided by gathered time.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import jax
from rich.console import Console

from benchmarks.measuring import best, machine, print_table
from lorasp_jax.peft import LoRASP
from lorasp_jax.peft.lora_sp import decoding

QUEUED = 10
DIVISORS = (2, 4, 8)


def measure(shape: tuple[int, int], rank: int, dtype: str, num_layers: int) -> dict[str, Any]:
    """Measure microseconds per layer, with the full bank and with each capacity."""
    method = LoRASP(rank=rank)

    def draw(key: jax.Array) -> Any:
        params = method.init_params(key, *shape)
        u = jax.random.normal(key, (rank, shape[1]))
        params = params | {"bank": params["bank"] | {"u": u}}
        bank = {name: value.astype(dtype) for name, value in params["bank"].items()}
        return params | {"bank": bank}, decoding.prepare(method, params, dtype)

    pairs = [jax.jit(draw)(key) for key in jax.random.split(jax.random.key(0), num_layers)]
    dense_params, prepared = map(list, zip(*pairs, strict=True))
    x = jax.random.normal(jax.random.key(1), (shape[0],)).astype(dtype)
    dense = jax.jit(lambda layers, x: [method.delta(p, x)[0] for p in layers])
    base = best(lambda: dense(dense_params, x), calls=QUEUED) / num_layers
    row: dict[str, Any] = {"layer": "x".join(map(str, shape)), "R": rank, "dense us": base * 1e6}
    for divisor in DIVISORS:
        capacity = max(rank // divisor, 1)
        gathered = jax.jit(
            lambda layers, x, capacity=capacity: [
                decoding.decode(method, p, x, capacity=capacity)[0] for p in layers
            ]
        )
        seconds = best(lambda run=gathered: run(prepared, x), calls=QUEUED) / num_layers
        row |= {f"R/{divisor} us": seconds * 1e6, f"R/{divisor} gain": base / seconds}
    return row


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--shapes", nargs="+", default=["2048x2048", "2048x16384", "16384x2048"])
    parser.add_argument("--ranks", nargs="+", type=int, default=[128, 512, 2048])
    parser.add_argument("--dtype", default="bfloat16", choices=["bfloat16", "float32"])
    parser.add_argument("--layers", type=int, default=8)
    parser.add_argument("--json", type=Path, help="file for the results")
    options = parser.parse_args()
    shapes = [tuple(map(int, shape.split("x"))) for shape in options.shapes]
    rows = [
        measure((d_in, d_out), rank, options.dtype, options.layers)
        for d_in, d_out in shapes
        for rank in options.ranks
    ]
    name = machine("jax", "jaxlib")
    console = Console()
    print_table(console, rows, f"one token, {options.dtype}, {name}")
    if options.json:
        options.json.write_text(json.dumps({"machine": name, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
