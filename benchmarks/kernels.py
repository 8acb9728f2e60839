"""Where the time of a training step goes, by kind of kernel.

    python -m benchmarks.kernels --json kernels.json
    python -m benchmarks.kernels --size nano --batch 4 --rank 8 --dtype float32    # on a CPU

JAX's profiler records the kernels of a few steps (the step of `benchmarks.backbones`). The compiled
program tells what each kernel computes. `idle` is the time of a step in which no kernel runs. On a
GPU, the step is compiled without CUDA graphs, whose kernels the profiler cannot name.
"""

import argparse
import collections
import dataclasses
import re
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
from jax.profiler import ProfileData
from rich.console import Console

from benchmarks.backbones import CAMERAS, Step, add_options, arrays, run_config, sized
from benchmarks.measuring import machine, print_table, write_json
from lorasp_jax import peft

SLOWEST = 40
"""Number of kernels in the JSON file's second table."""

WITHOUT_GRAPHS: dict[str, str | bool] = {"xla_gpu_graph_min_graph_size": "1000000000"}
"""Compiler options: no sequence of kernels is long enough for a graph."""

_COMPUTATION = re.compile(r"(?:ENTRY )?%?([\w.\-]+) .*\{$")
_INSTRUCTION = re.compile(r"\s*(?:ROOT )?%?([\w.\-]+) = (.*?) ([a-z][\w\-]*)\((.*)$")
_INDEX = re.compile(r"(s32|u32|pred)\[\]")
_MOVES = {"bitcast", "broadcast", "constant", "convert", "copy", "copy-start", "dynamic-slice"}
_MOVES |= {"dynamic-update-slice", "pad", "parameter", "reshape", "slice", "transpose", "tuple"}


@dataclasses.dataclass(frozen=True)
class Instruction:
    """One instruction of a compiled program.

    Attributes:
        opcodes: its opcode, or those of the computation that it calls.
        target: the custom calls in it, joined; empty if there are none.
        source: path of the JAX operation that it comes from; empty for those that XLA added.
    """

    opcodes: frozenset[str]
    target: str
    source: str


def instructions(text: str) -> dict[str, Instruction]:
    """Parse the text of a compiled program; return its instructions by name."""
    computations: dict[str, list[tuple[str, str, str]]] = collections.defaultdict(list)
    current = ""
    for line in text.splitlines():
        if head := _COMPUTATION.match(line):
            current = head[1]
        elif (found := _INSTRUCTION.match(line)) and not _INDEX.match(found[2]):
            computations[current].append((found[1], found[3], found[4]))
    parsed = {}
    for body in computations.values():
        for name, opcode, rest in body:
            called = re.search(r"calls=%?([\w.\-]+)", rest)
            inner = computations[called[1]] if called else [(name, opcode, rest)]
            targets = re.findall(r'custom_call_target="([^"]+)"', " ".join(r for *_, r in inner))
            source = re.search(r'op_name="([^"]*)"', rest)
            opcodes = frozenset(op for _, op, _ in inner)
            parsed[name] = Instruction(opcodes, " ".join(targets), source[1] if source else "")
    return parsed


def kind(instruction: Instruction) -> str:
    """Return the row of the table that an instruction's kernels belong to."""
    target, opcodes, source = instruction.target, instruction.opcodes, instruction.source
    if "$f8" in target:
        return "matmuls in float8"
    if "matmul" in target or "gemm" in target or "dot" in opcodes:
        return "matmuls"
    if "fmha" in target or "short_attention" in source:
        return "attention"
    if target:  # Pallas
        return "router and gate"
    if any(name.startswith(("all-", "reduce-scatter", "collective")) for name in opcodes):
        return "collectives"
    if opcodes <= _MOVES:
        return "copies"
    if opcodes <= _MOVES | {"concatenate"}:
        return "joins"
    if "train_step" in source and "jvp(" not in source:
        return "optimizer"
    return "norms and sums" if "reduce" in opcodes else "elementwise"


def kernels(trace: Path) -> Iterable[tuple[str, str, int, int]]:
    """Yield (instruction, kernel, start, end) of a trace in ns, on its first device."""
    (file,) = trace.rglob("*.xplane.pb")
    planes = {plane.name: plane for plane in ProfileData.from_file(str(file)).planes}
    devices = sorted(name for name in planes if name.startswith("/device:GPU"))
    for line in planes[devices[0] if devices else "/host:CPU"].lines:
        for event in line.events:
            if name := dict(event.stats).get("hlo_op"):
                yield str(name), event.name, int(event.start_ns), int(event.end_ns)


def covered(spans: Iterable[tuple[int, int]]) -> int:
    """Return the length of the union of intervals."""
    total = end = 0
    for start, stop in sorted(spans):
        total += max(0, stop - max(start, end))
        end = max(end, stop)
    return total


def profile(step: Step, steps: int) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Trace steps; return the time by kind, and by kernel for the slowest ones.

    Kernels of kind "other" are not in the compiled program.
    """
    jax.block_until_ready([step() for _ in range(2)])
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready([step() for _ in range(steps)])
        events = list(kernels(Path(folder)))
    program = instructions(step.compiled.as_text() or "")
    spans = [event[2:] for event in events]
    wall = max(end for _, end in spans) - min(start for start, _ in spans)
    kinds, counts, names = (collections.Counter() for _ in range(3))
    for name, kernel, start, end in events:
        found = kind(program[name]) if name in program else "other"
        kinds[found] += end - start
        counts[found] += 1
        names[found, kernel] += end - start
    kinds["idle"] = wall - covered(spans)

    def row(labels: dict[str, Any], time: int) -> dict[str, Any]:
        return {**labels, "ms": time / steps / 1e6, "%": 100 * time / wall}

    by_kind = [row({"kind": k, "kernels": counts[k] // steps}, t) for k, t in kinds.most_common()]
    slowest = [row({"kind": k, "kernel": n[:80]}, t) for (k, n), t in names.most_common(SLOWEST)]
    return by_kind, slowest


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--backbones", nargs="+", default=list(CAMERAS))
    parser.add_argument("--size", default="base", help="nano, small or base")
    parser.add_argument("--batch", type=int, default=32)
    add_options(parser)
    options = parser.parse_args()
    console = Console(soft_wrap=True)
    results: dict[str, Any] = {"machine": machine("jax")}
    console.print(f"{results['machine']}; {options.size}, rank {options.rank}, {options.dtype}")
    method = peft.LoRASP(rank=options.rank)
    run = run_config(method, ("all-linear",), options.batch, options.base_dtype)
    for name in options.backbones:
        config = sized(name, options, options.remat)
        step = Step(config, run, options=WITHOUT_GRAPHS).load(*arrays(config, run)[1:])
        by_kind, slowest = profile(step, options.calls)
        print_table(console, by_kind, f"{name}: {100 * by_kind[0]['ms'] / by_kind[0]['%']:.4g} ms")
        results[name] = {"kinds": by_kind, "slowest": slowest}
        write_json(options.json, results)


if __name__ == "__main__":
    main()
