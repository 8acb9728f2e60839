"""Tables that say what an adapted model consists of."""

from typing import Any

from flax import nnx

from lorasp_jax.adaptation import Counts, count, places
from lorasp_jax.dense import AdapterParam, Dense

Row = tuple[str, str, str, str, str, str]


def summary(model: nnx.Module) -> str:
    """A table of the dense layers and of every other parameter that trains, with totals.

    Columns: path, method, kernel shape, rank, parameters (base and adapter), trainable ones.
    """
    holder = nnx.List([model])
    rows = [("path", "method", "shape", "rank", "parameters", "trainable")]
    inside = set()
    for path, _, _, layer in places(holder, (Dense, nnx.Linear)):
        inside |= {id(v) for v in vars(layer).values() if isinstance(v, nnx.Variable)}
        method, counts = getattr(layer, "method", None), count(layer)
        name = method.name if method else "full" if counts.trainable else "-"
        rank = getattr(method, "rank", "-")
        rows.append(_row(path, name, layer.kernel.get_value(), rank, counts))
    for path, _, _, variable in places(holder, AdapterParam):
        if id(variable) not in inside:
            counts = Counts(variable.get_value().size, variable.get_value().size)
            rows.append(_row(path, "full", variable.get_value(), "-", counts))
    trainable, total = count(model)
    rows.append(("total", "", "", "", f"{total:,}", f"{trainable:,}"))
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = ["  ".join(_align(row, widths)).rstrip() for row in rows]
    rule = "-" * max(map(len, lines))
    share = f"{trainable / max(total, 1):.2%} of all parameters train"
    return "\n".join([lines[0], rule, *lines[1:-1], rule, lines[-1], share])


def _row(path: str, method: str, kernel: Any, rank: Any, counts: Counts) -> Row:
    shape = "x".join(map(str, kernel.shape))
    return path, method, shape, str(rank), f"{counts.total:,}", f"{counts.trainable:,}"


def _align(row: Row, widths: list[int]) -> list[str]:
    left, right = zip(row[:3], widths[:3], strict=True), zip(row[3:], widths[3:], strict=True)
    return [cell.ljust(w) for cell, w in left] + [cell.rjust(w) for cell, w in right]
