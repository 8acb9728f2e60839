"""Summarize an adapted model in a table; collect the aux that its layers stored and its losses."""

import math
from collections.abc import Mapping
from typing import Any

import flax.traverse_util
import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.adapters.adaptation import Counts, count, penalties
from lorasp_jax.adapters.layers.nnx_layers import kernel_of
from lorasp_jax.adapters.paths import EINSUMS_HINT, locate, locate_layers, locate_other_matrices
from lorasp_jax.dense import AUX_NAME, AdapterAux, AdapterParam, validate
from lorasp_jax.peft import Aux
from lorasp_jax.peft.auxiliary import AUXILIARY_WEIGHTS, auxiliary_losses
from lorasp_jax.peft.fields import short

Row = tuple[str, ...]


def summary(model: nnx.Module, aux: Mapping[str, Aux] | None = None) -> str:
    """Format a table of a model's layers, other trainable parameters and other matrices.

    Columns: path, method, kernel shape, rank, parameters (base and adapter), trainable parameters,
    and, if `aux` of `collect_aux` is given, mean active rank. Lines below the table give the
    trainable share, the modules that are entirely frozen and any unsupported classes.

    Raises:
        ValueError: aux has a path that is not a layer of the model.
    """
    rows = _rows(validate.module(model))
    if aux is not None:
        if unknown := aux.keys() - {row[0] for row in rows}:
            raise ValueError(f"aux has {short(min(unknown))}, which is not a layer of the model")
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
    """One line with the trainable share and the top-level modules that are entirely frozen."""
    trainable, total = count(model)
    root = nnx.List([model])
    parts = dict.fromkeys(location.path.split("/")[0] for location in locate(root, nnx.Param))
    trained = {location.path.split("/")[0] for location in locate(root, AdapterParam)}
    frozen = ", ".join(part for part in parts if part not in trained)
    share = f"{trainable / max(total, 1):.2%} of parameters trainable ({trainable:,} of {total:,})"
    if trainable == total:
        return f"{share}; nothing is frozen"
    return share + (f"; entirely frozen: {frozen}" if frozen else "")


def _rows(model: nnx.Module) -> list[Row]:
    """Rows of layers, then of other trainable parameters, then of other matrices."""
    root, rows, inside = nnx.List([model]), [], set()
    for path, _, _, layer in locate_layers(root):
        inside |= {id(v) for v in vars(layer).values() if isinstance(v, nnx.Variable)}
        method, counts = getattr(layer, "method", None), count(layer)
        name = method.name if method else "full" if counts.trainable else "-"
        rank, ranks = getattr(method, "rank", "-"), getattr(method, "ranks", ())
        rank = f"{min(ranks)}-{max(ranks)}" if ranks else rank
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
    """Lines about unsupported classes that have matrices; empty if there are none."""
    matrices = locate_other_matrices(nnx.List([model]))
    classes = dict.fromkeys(type(location.parent).__name__ for location in matrices)
    if not classes:
        return []
    return [f"no built-in adapter support for {', '.join(classes)}. {EINSUMS_HINT}."]


def _active_rank(aux: Aux | None) -> str:
    mean = None if aux is None else aux.mean_active_rank()
    return "-" if mean is None else f"{float(mean):.1f}"


def _row(path: str, method: str, kernel: Any, rank: Any, counts: Counts) -> Row:
    shape = "x".join(map(str, kernel.shape))
    return path, method, shape, str(rank), f"{counts.total:,}", f"{counts.trainable:,}"


def _align(row: Row, widths: list[int]) -> list[str]:
    left, right = zip(row[:3], widths[:3], strict=True), zip(row[3:], widths[3:], strict=True)
    return [cell.ljust(w) for cell, w in left] + [cell.rjust(w) for cell, w in right]


def collect_aux(model: nnx.Module | Mapping[str, Any]) -> dict[str, Aux]:
    """Collect the aux that adapted layers stored in the model's last call.

    Args:
        model: an NNX model that was just called (its stored aux is removed), or the variables that
            a Linen model returned from `apply(..., mutable=["intermediates"])`.

    Returns:
        Aux of each layer, by "/"-joined path.

    Raises:
        ValueError: no adapted layer stored any aux.
    """
    if isinstance(model, nnx.Module):
        stored = nnx.to_flat_state(nnx.pop(model, AdapterAux))
        aux_by_path = {path[:-1]: variable.get_value() for path, variable in stored}
    else:
        sown: dict[tuple[str, ...], Any]
        sown = flax.traverse_util.flatten_dict(model.get("intermediates", {}))  # type: ignore
        sown = {path: values for path, values in sown.items() if path[-1] == AUX_NAME}
        aux_by_path = {path[:-1]: v[-1] for path, v in sown.items() if isinstance(v, tuple)}
    if not aux_by_path:
        raise ValueError(
            "no adapted layer stored any aux: call the model first, in the same traced function "
            "(NNX) or with mutable=['intermediates'] (Linen)"
        )
    return {"/".join(map(str, path)): aux for path, aux in aux_by_path.items()}


def auxiliary_loss(model: nnx.Module | Mapping[str, Any]) -> jax.Array:
    """Add up the auxiliary losses of the model's last call: add the result to your loss.

    Each loss is averaged over the layers that have it (`auxiliary_losses`), and weighted as in
    `AuxiliaryConfig`; the losses of the parameters alone (`penalties`) are included for NNX.

    Args:
        model: as for `collect_aux`, in the same traced function; an NNX model's stored aux is
            removed.

    Returns:
        f32 scalar; 0 if no method has auxiliary losses, as with LoRA.

    Raises:
        ValueError: no adapted layer stored any aux; full fine-tuning alone stores none.
    """
    losses = auxiliary_losses(collect_aux(model))
    if isinstance(model, nnx.Module):
        losses |= penalties(model)
    weighted = [AUXILIARY_WEIGHTS[name] * value for name, value in losses.items()]
    return jnp.asarray(sum(weighted), jnp.float32)
