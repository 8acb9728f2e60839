"""How training scales across the devices of a host: LoRA-SP on all linear layers, random weights.

    python -m benchmarks.scaling --devices 1 2 4 --json scaling.json
    python -m benchmarks.scaling --devices 1 2 --sizes nano --batch 4 --rank 8 --dtype float32

The batch per device ("batch") is constant. "data" replicates all weights on each device. "fsdp"
shards base weights, adapters and optimizer state over the devices and gathers each layer's weights
when needed. "efficiency" is the rate per device relative to the rate on one device; "GiB" is the
program's memory per device.
"""

import argparse
import dataclasses
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
from rich.console import Console

from benchmarks import backbones
from benchmarks.measuring import best, machine, print_table, write_json
from lorasp_jax import peft
from lorasp_jax.training.cost.preflight import GIB
from lorasp_jax.training.distributed import mesh as meshes

BATCH = {"nano": 512, "small": 512, "base": 32}


def layouts(devices: list[int]) -> list[tuple[str, int]]:
    """Return (layout, number of devices) to measure, one device first."""
    several = sorted(set(devices) - {1})
    return [("data", 1), *((name, n) for n in several for name in ("data", "fsdp"))]


def rows(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yield one row per layout; all programs are compiled in parallel."""
    batch = options.batch or BATCH[options.size]
    config = backbones.sized(options.backbone, options, options.remat)
    single = backbones.run_config(peft.LoRASP(rank=options.rank), ("all-linear",), batch)

    def compile_step(layout: tuple[str, int]) -> backbones.Step:
        name, number = layout
        fsdp = number if name == "fsdp" else 1
        mesh = meshes.make_mesh(fsdp, jax.devices()[:number])
        optim = dataclasses.replace(single.optim, batch_size=number * batch)
        return backbones.Step(config, dataclasses.replace(single, optim=optim, fsdp=fsdp), mesh)

    cases, single_rate = layouts(options.devices), None
    with ThreadPoolExecutor(options.threads) as pool:
        arrays = pool.submit(backbones.arrays, config, single)
        steps = dict(zip(cases, pool.map(compile_step, cases), strict=True))
    for name, number in cases:
        step = steps.pop((name, number)).load(*arrays.result()[1:])
        rate = number * batch / best(step, calls=options.calls)
        single_rate = single_rate or rate
        yield {
            "backbone": options.backbone,
            "size": options.size,
            "devices": number,
            "layout": name,
            "batch": batch,
            "samples/s": rate,
            "efficiency": rate / number / single_rate,
            "GiB": step.bytes / GIB,
        }


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--backbone", default="pi0")
    parser.add_argument("--sizes", nargs="+", default=["small", "base"])
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument(
        "--batch", type=int, help="windows per device (default: depends on the size)"
    )
    parser.add_argument("--threads", type=int, default=8, help="compilation threads")
    backbones.add_options(parser)
    options = parser.parse_args()
    console, results = Console(soft_wrap=True), dict[str, Any](machine=machine("jax"))
    console.print(f"{results['machine']}, rank {options.rank}, {options.dtype}")
    for size in options.sizes:
        options.size = size
        results[size] = [*rows(options)]
        print_table(console, results[size])
        write_json(options.json, results)


if __name__ == "__main__":
    main()
