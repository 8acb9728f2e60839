"""Estimate the memory for recomputing a layer in the backward pass, from a jaxpr.

With rematerialization, the backward pass of a layer first repeats its forward pass. What it holds
meanwhile is freed before the next layer, so one layer at a time adds to what was saved.

Matmuls, kernels and loops store their results, and read their operands from memory. All else is
fused: it stores only what one of them reads. Memory that fusion frees or duplicates is not modeled.
"""

import collections
import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from lorasp_jax.training.cost.flops import bodies

_STORING = {
    "concatenate",
    "cond",
    "conv_general_dilated",
    "dot_general",
    "dot_product_attention_bwd_wrapper",
    "dot_product_attention_fwd_wrapper",
    "gather",
    "pallas_call",
    "scan",
    "scatter-add",
    "sort",
    "while",
}
"""Primitives whose operands and results are in memory."""


class _Operation(NamedTuple):
    """An equation without inner functions; values are numbered."""

    name: str
    inputs: list[int]
    outputs: list[int]


def largest(jaxpr: Any) -> int:
    """Return the most bytes that a layer takes to recompute, from the jaxpr of a gradient.

    Without rematerialization, the result is 0.
    """
    return max(map(_peak, _recomputed(jaxpr)), default=0)


def _recomputed(jaxpr: Any) -> Iterator[Any]:
    """Yield the backward passes that recompute: the bodies of differentiated `jax.checkpoint`s."""
    for equation in jaxpr.eqns:
        if equation.params.get("differentiated"):
            yield equation.params["jaxpr"]
        else:
            for inner in bodies(equation):
                yield from _recomputed(inner)


def _peak(jaxpr: Any) -> int:
    """Return the most bytes that are stored at once, without arguments and results."""
    sizes, operations, results = _flatten(jaxpr)
    read = {v for op in operations if op.name in _STORING for v in op.inputs}
    made = {v for op in operations for v in op.outputs if op.name in _STORING or v in read}
    stored = made - results - _accumulated(operations)
    last: dict[int, int] = {}
    for time, op in reversed([*enumerate(operations)]):
        fused = not any(v in stored for v in op.outputs)
        until = max([last.get(v, time) for v in op.outputs if fused], default=time)
        for value in op.inputs:
            last[value] = max(last.get(value, 0), until)
    changes: collections.Counter[int] = collections.Counter()
    for time, op in enumerate(operations):
        for value in stored.intersection(op.outputs):
            changes[time] += sizes[value]
            changes[last.get(value, time) + 1] -= sizes[value]
    return max(itertools.accumulate(changes[time] for time in range(len(operations))), default=0)


def _accumulated(operations: Sequence[_Operation]) -> set[int]:
    """Return the products that are only added to another one, which a matmul does in place."""
    products = {v for op in operations if op.name == "dot_general" for v in op.outputs}
    uses = collections.Counter(v for op in operations for v in op.inputs)
    sums = [op.inputs for op in operations if op.name in ("add", "add_any")]
    return {
        pair[1]
        for pair in sums
        if len({*pair} & products) == 2 and uses[pair[0]] == uses[pair[1]] == 1
    }


def _is_called(equation: Any, inner: Sequence[Any]) -> bool:
    """Return whether an equation passes its operands to one jaxpr and returns its results."""
    if len(inner) != 1:
        return False
    pairs = (equation.invars, inner[0].invars), (equation.outvars, inner[0].outvars)
    return all(len(outside) == len(inside) for outside, inside in pairs)


def _flatten(jaxpr: Any) -> tuple[list[int], list[_Operation], set[int]]:
    """Inline called functions; return the bytes of each value, the operations and the results."""
    sizes: list[int] = []
    operations: list[_Operation] = []

    def new(variable: Any) -> int:
        dtype = getattr(variable.aval, "dtype", None)
        sizes.append(variable.aval.size * dtype.itemsize if dtype is not None else 0)
        return len(sizes) - 1

    def visit(jaxpr: Any, arguments: Sequence[int | None]) -> list[int | None]:
        values = dict(zip(jaxpr.invars, arguments, strict=True))
        values |= {variable: new(variable) for variable in jaxpr.constvars}

        def read(atoms: Sequence[Any]) -> list[int | None]:
            return [None if hasattr(atom, "val") else values[atom] for atom in atoms]  # literals

        for equation in jaxpr.eqns:
            name, inputs, inner = equation.primitive.name, read(equation.invars), bodies(equation)
            if name not in _STORING and _is_called(equation, inner):
                outputs = visit(inner[0], inputs)
            else:
                outputs = [new(variable) for variable in equation.outvars]
                known = [value for value in inputs if value is not None]
                operations.append(_Operation(name, known, outputs))
            values |= zip(equation.outvars, outputs, strict=True)
        return read(jaxpr.outvars)

    results = visit(jaxpr, [new(variable) for variable in jaxpr.invars])
    return sizes, operations, {value for value in results if value is not None}
