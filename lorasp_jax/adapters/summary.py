"""What an adapted model consists of, as a table, and what its layers reported."""

import math
from collections.abc import Mapping
from typing import Any

import flax.traverse_util
from flax import nnx

from lorasp_jax.adapters.adaptation import Counts, count
from lorasp_jax.adapters.layers.nnx_layers import kernel_of
from lorasp_jax.adapters.paths import EINSUMS_HINT, locate, locate_layers, locate_other_matrices
from lorasp_jax.dense import AUX_NAME, AdapterAux, AdapterParam, validate
from lorasp_jax.peft import Aux
from lorasp_jax.peft._fields import short

Row = tuple[str, ...]


def summary(model: nnx.Module, aux: Mapping[str, Aux] | None = None) -> str:
    """A table of the layers, of every other parameter that trains and every other matrix.

    Columns: path, method, kernel shape, rank, parameters (base and adapter), trainable ones, and
    with `aux` the mean active rank. Below it, the share that trains and what is frozen.

    Args:
      model: adapted or not.
      aux: what `collect_aux` returned after a call of the model, by path.

    Raises:
      ValueError: aux of a layer that the model lacks.
    """
    rows = _rows(validate.module(model))
    if aux is not None and not (
        isinstance(aux, Mapping) and all(isinstance(one, Aux) for one in aux.values())
    ):
        raise ValueError(f"aux is what collect_aux returned, got {short(aux)}.")
    if aux is not None:
        if unknown := aux.keys() - {row[0] for row in rows}:
            raise ValueError(
                f"there is aux for {short(min(unknown, key=str))}, which is no layer of the model."
            )
        rows = [(*row, _active_rank(aux.get(row[0]))) for row in rows]
    trainable, total = count(model)
    head = ("path", "method", "shape", "rank", "parameters", "trainable", "active rank")
    last = ("total", "", "", "", f"{total:,}", f"{trainable:,}", "")
    columns = 6 if aux is None else 7
    table = [head[:columns], *rows, last[:columns]]
    widths = [max(len(row[i]) for row in table) for i in range(columns)]
    lines = ["  ".join(_align(row, widths)).rstrip() for row in table]
    rule = "-" * max(map(len, lines))
    below = [lines[-1], trained_share(model), *_others(model)]
    return "\n".join([lines[0], rule, *lines[1:-1], rule, *below])


def trained_share(model: nnx.Module) -> str:
    """One line: which share of the parameters trains, and which parts of the model are frozen."""
    trainable, total = count(model)
    root = nnx.List([model])
    parts = dict.fromkeys(location.path.split("/")[0] for location in locate(root, nnx.Param))
    touched = {location.path.split("/")[0] for location in locate(root, AdapterParam)}
    frozen = ", ".join(part for part in parts if part not in touched)
    share = f"{trainable / max(total, 1):.2%} of all parameters train, {trainable:,} of {total:,}"
    if trainable == total:
        return f"{share}; nothing is frozen"
    return f"{share}; the others are frozen" + (f", all of {frozen} among them" if frozen else "")


def _rows(model: nnx.Module) -> list[Row]:
    """Of each layer, each other parameter that trains, and each matrix outside of such layers."""
    root, rows, inside = nnx.List([model]), [], set()
    for path, _, _, layer in locate_layers(root):
        inside |= {id(v) for v in vars(layer).values() if isinstance(v, nnx.Variable)}
        method, counts = getattr(layer, "method", None), count(layer)
        name = method.name if method else "full" if counts.trainable else "-"
        rank = getattr(method, "rank", "-")
        rows.append(_row(path, name, kernel_of(layer).get_value(), rank, counts))
    for path, _, _, variable in locate(root, AdapterParam):
        if id(variable) not in inside:
            counts = Counts(variable.get_value().size, variable.get_value().size)
            rows.append(_row(path, "full", variable.get_value(), "-", counts))
    for path, _, _, variable in locate_other_matrices(root):
        if not isinstance(variable, AdapterParam):
            value = variable.get_value()
            rows.append(_row(path, "-", value, "-", Counts(0, math.prod(value.shape))))
    return rows


def _others(model: nnx.Module) -> list[str]:
    """A line on the classes that adapters do not apply to, if there are matrices in some."""
    found = locate_other_matrices(nnx.List([model]))
    classes = dict.fromkeys(type(location.parent).__name__ for location in found)
    if not classes:
        return []
    return [f"no adapter applies by itself to {', '.join(classes)}. {EINSUMS_HINT}."]


def _active_rank(aux: Aux | None) -> str:
    mean = None if aux is None else aux.mean_active_rank()
    return "-" if mean is None else f"{float(mean):.1f}"


def _row(path: str, method: str, kernel: Any, rank: Any, counts: Counts) -> Row:
    shape = "x".join(map(str, kernel.shape))
    return path, method, shape, str(rank), f"{counts.total:,}", f"{counts.trainable:,}"


def _align(row: Row, widths: list[int]) -> list[str]:
    """The first three cells to the left, numbers to the right."""
    left, right = zip(row[:3], widths[:3], strict=True), zip(row[3:], widths[3:], strict=True)
    return [cell.ljust(w) for cell, w in left] + [cell.rjust(w) for cell, w in right]


def collect_aux(model: nnx.Module | Mapping[str, Any]) -> dict[str, Aux]:
    """What the drop-in layers of a model kept in the last call, by layer path; taken out of it.

    Args:
      model: an NNX model that was just called, or the variables a Linen model returned from
        `apply(..., mutable=["intermediates"])`.

    Returns:
      Aux by "/"-joined path of the layer.

    Raises:
      ValueError: no adapted layer kept anything.
    """
    if isinstance(model, nnx.Module):
        kept = nnx.to_flat_state(nnx.pop(model, AdapterAux))
        found = {path[:-1]: variable.get_value() for path, variable in kept}
    else:
        sown: dict[tuple[str, ...], Any]
        kept = model.get("intermediates", {}) if isinstance(model, Mapping) else None
        if not isinstance(kept, Mapping):
            raise ValueError(
                "the model must be an NNX module or the variables that a Linen model returned, got "
                f"{short(model)}."
            )
        sown = flax.traverse_util.flatten_dict(kept)  # type: ignore
        sown = {path: kept for path, kept in sown.items() if path[-1] == AUX_NAME}
        found = {path[:-1]: kept[-1] for path, kept in sown.items() if isinstance(kept, tuple)}
    if not found:
        raise ValueError(
            "no adapted layer kept anything: call the model first, inside the same traced function "
            "(NNX) or with mutable=['intermediates'] (Linen)."
        )
    return {"/".join(map(str, path)): aux for path, aux in found.items()}
