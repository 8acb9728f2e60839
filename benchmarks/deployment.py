"""Latency of deployed policies of published sizes with random weights, by form of the adapters.

    python -m benchmarks.deployment > deployment.jsonl
    python -m benchmarks.deployment --size dummy --dtype float32 --repeats 2    # on a CPU

Prints one JSON object per line as soon as it is measured: one policy call at batch size 1, from
images to action chunk. "adapters" is one of

- none: the base alone;
- whole: LoRA-SP on every linear layer;
- half: the same, pruned to half of the bank; the router keeps all of its scores;
- merged: LoRA as distilled from LoRA-SP, merged into the kernels. It runs the program of "none".

"ratio" divides by the milliseconds of "none". Rows with one flow step instead of ten ("steps")
show how much of a call is its prefix. "change" names what differs from the sampler as it is:

- separate: q, k, v and gate, up of layers without adapters are separate matmuls in the flow steps;
- graph: XLA also records loops as CUDA graphs;
- cudnn (π0): cuDNN also computes attention for few queries;
- short (SmolVLA): `kernels.short_attention` also computes attention for more keys.

All programs of the rows by adapters are compiled at once in threads, then measured one by one. The
same follows for the rows with one step or a change. A program that fails gives a row with its
"error", and exit code 1.
"""

import argparse
import contextlib
import dataclasses
import functools
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
from flax import nnx

from benchmarks import measuring
from benchmarks.backbones import CAMERAS, noise, of_size, run_config
from benchmarks.measuring import best, machine
from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.adapters.layers import prepared
from lorasp_jax.dense import AdaptedLayer, AdapterParam
from lorasp_jax.extras.serving.exported import sampling_options
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.sampling import Sampler
from lorasp_jax.models.transformer import attention
from lorasp_jax.peft import LoRA, LoRASP
from lorasp_jax.training.cost import preflight

STEPS = 10
GRAPH_OPTIONS = {
    "xla_gpu_enable_command_buffer": "FUSION,CUBLAS,CUBLASLT,CUSTOM_CALL,CUDNN,"
    "DYNAMIC_SLICE_FUSION,CONDITIONAL,WHILE"
}
CHANGES: dict[str, Callable[[], contextlib.AbstractContextManager]] = {
    "": contextlib.nullcontext,
    "separate": lambda: mock.patch.object(prepared, "_is_plain", return_value=False),
    "graph": contextlib.nullcontext,
    "cudnn": lambda: mock.patch.object(attention, "CUDNN_MIN_QUERIES", 1),
    "short": lambda: mock.patch.object(attention, "MAX_KEY_ELEMENTS", 2**14),
}
"""What to change while a program is traced."""


class Case(NamedTuple):
    """One row."""

    backbone: str
    adapters: str
    steps: int = STEPS
    change: str = ""


def cases(backbones: Sequence[str]) -> tuple[list[Case], list[Case]]:
    """Return the rows of the table of adapters, and those with one step or a change."""
    table = [Case(name, a) for name in backbones for a in ("none", "merged", "whole", "half")]
    others = []
    for name in backbones:
        others += [Case(name, adapters, steps=1) for adapters in ("none", "whole")]
        special = "short" if name == "smolvla" else "cudnn"
        others += [Case(name, "none", change=change) for change in ("separate", "graph", special)]
        others.append(Case(name, "whole", change="graph"))
    return table, sorted(others, key=lambda case: case[:2])  # equal weights follow each other


def abstract_sampler(case: Case, config: BackboneConfig, rank: int) -> Sampler:
    """Return the shapes of a sampler."""

    def make() -> Sampler:
        key = jax.random.key(0)
        if case.adapters == "none":
            return config.create(nnx.Rngs(key)).sampler()
        method = LoRA(rank=rank) if case.adapters == "merged" else LoRASP(rank=rank)
        model = preflight.adapted_model(run_config(method, ("all-linear",), 1), config, key)
        if case.adapters == "merged":
            model = adaptation.merge(model)
        elif case.adapters == "half":
            halve(model)
        return model.sampler()

    with CHANGES[case.change]():
        return jax.eval_shape(make)


def halve(model: Backbone) -> None:
    """Keep the first half of the bank of every LoRA-SP layer, as `prune` keeps the most used."""
    for location in paths.locate(nnx.List([model]), AdaptedLayer):
        layer = location.child
        if layer.adapter is None:
            continue
        method, params = layer.method_and_params()
        rank = method.rank // 2
        bank = {"u": params["bank"]["u"][..., :rank, :], "v": params["bank"]["v"][..., :rank]}
        layer.method = dataclasses.replace(method, rank=rank, alpha=method.scale * rank)
        layer.adapter = AdapterParam({**params, "bank": bank})


class Program(NamedTuple):
    """A program that is being compiled, and the shapes of its arguments."""

    sampler: Sampler
    observation: Any
    compiled: Future


def lowered(case: Case, config: BackboneConfig, rank: int) -> tuple[Sampler, Any, Any]:
    """Trace a program; return the shapes of its arguments, and the lowered program."""
    sampler = abstract_sampler(case, config, rank)
    observation = preflight.abstract_batch(config, 1).observation

    def sample(sampler: Sampler, observation: Any) -> jax.Array:
        return sampler.sample_actions(jax.random.key(0), observation, num_steps=case.steps)

    with CHANGES[case.change]():
        return sampler, observation, jax.jit(sample).lower(sampler, observation)


def programs(table: Sequence[Case], options: argparse.Namespace) -> dict[Case, Program | Exception]:
    """Start to compile all programs at once; equal ones, as of "none" and "merged", once."""
    found: dict[Case, Program | Exception] = {}
    compiling: dict[tuple[bool, str], Future] = {}
    pool = ThreadPoolExecutor()
    for case in table:
        try:
            config = of_size(case.backbone, options, options.cameras)
            sampler, observation, program = lowered(case, config, options.rank)
        except Exception as error:
            found[case] = error
            continue
        is_graph = case.change == "graph"
        key = is_graph, program.as_text()
        if key not in compiling:
            chosen = (sampling_options() or {}) | (GRAPH_OPTIONS if is_graph else {})
            compiling[key] = pool.submit(program.compile, compiler_options=chosen)
        found[case] = Program(sampler, observation, compiling[key])
    pool.shutdown(wait=False)
    return found


def measured(
    table: Sequence[Case], options: argparse.Namespace, weights: dict[Any, Sampler]
) -> Iterator[dict[str, Any]]:
    """Yield a row for each case; `weights` keeps filled samplers for other tables."""
    found = programs(table, options)
    started = {case: p for case, p in found.items() if isinstance(p, Program)}
    keys = {
        case: (case.backbone, str(jax.tree.map(jnp.shape, p.sampler.weights)))
        for case, p in started.items()
    }
    for case, program in started.items():
        if keys[case] not in weights:
            weights[keys[case]] = measuring.random_weights(program.sampler)
    wait([program.compiled for program in started.values()])
    for case, program in found.items():
        row: dict[str, Any] = case._asdict()
        try:
            if isinstance(program, Exception):
                raise program
            inputs = weights[keys[case]], noise(program.observation)
            call = functools.partial(program.compiled.result(), *inputs)
            yield row | {"ms": 1e3 * best(call, repeats=options.repeats)}
        except Exception as error:
            yield row | {"error": f"{type(error).__name__}: {error}"[:300]}


def rows(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yield all rows, with the ratio to the base alone."""
    bases: dict[str, float] = {}
    weights: dict[Any, Sampler] = {}
    by_adapters, others = cases(options.backbones)
    for table in (by_adapters, [] if options.only_adapters else others):
        for row in measured(table, options, weights):
            if (row["adapters"], row["steps"], row["change"]) == ("none", STEPS, ""):
                bases |= {row["backbone"]: row["ms"]} if "ms" in row else {}
            if "ms" in row and row["backbone"] in bases:
                row["ratio"] = row["ms"] / bases[row["backbone"]]
            yield row


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark from the command line; return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--backbones", nargs="+", default=["pi0", "smolvla"], choices=list(CAMERAS))
    parser.add_argument("--size", default="base", help="dummy, nano, small or base")
    parser.add_argument("--rank", type=int, default=128)
    parser.add_argument("--dtype", default="bfloat16", choices=["bfloat16", "float32"])
    parser.add_argument("--cameras", type=int, default=0, help="default: π0 3, SmolVLA 2")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument(
        "--only-adapters", action="store_true", help="no rows with one step or a change"
    )
    options = parser.parse_args(arguments)
    failed = False
    print(json.dumps({"machine": machine("jax", "jaxlib"), **vars(options)}), flush=True)
    for row in rows(options):
        failed |= "error" in row
        print(json.dumps(row), flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
