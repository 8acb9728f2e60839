"""Other projects' layouts of a model's parameters: names and shapes, in and out.

A layout is a list of rules; each says how some of their leaves become some of ours and back. Values
are only sliced, transposed, stacked and reshaped, so they stay exact. A leaf of another shape is
refused before it is rearranged: as many values would fit into other heads, too.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

Shape = tuple[int, ...]


class OtherModelError(ValueError):
    """The leaves are those of another model, or of one of other sizes."""


class Rule(NamedTuple):
    """Some of our leaves and some of theirs that hold the same values."""

    ours: tuple[str, ...]
    theirs: tuple[str, ...]
    shapes: Callable[..., Sequence[Shape]]
    """Shapes of ours -> shapes of theirs."""
    to_ours: Callable[[Iterator[np.ndarray]], Sequence[np.ndarray]]
    """Their arrays, read as they are asked for -> ours."""
    to_theirs: Callable[..., Sequence[np.ndarray]]
    """Our arrays -> theirs."""


def copied(ours: str, theirs: str) -> Rule:
    """The same array under two names."""
    return Rule((ours,), (theirs,), lambda shape: [shape], list, lambda a: [a])


def reshaped(ours: str, theirs: str, ours_shape: Shape, theirs_shape: Shape) -> Rule:
    """The same values in the same order."""
    return Rule(
        (ours,),
        (theirs,),
        lambda _: [theirs_shape],
        lambda arrays: [a.reshape(ours_shape) for a in arrays],
        lambda a: [a.reshape(theirs_shape)],
    )


def transposed(ours: str, theirs: str) -> Rule:
    """A matrix [I, O] that is theirs [O, I], as PyTorch's linear layers have it."""
    return Rule(
        (ours,),
        (theirs,),
        lambda shape: [shape[::-1]],
        lambda arrays: [a.T for a in arrays],
        lambda a: [a.T],
    )


def stacked(ours: str, theirs: Iterable[str], *, transpose: bool = False) -> Rule:
    """One of our arrays [L, ...] that is theirs layer by layer, perhaps as in `transposed`."""
    names = tuple(theirs)

    def stacked_up(layers: Iterator[np.ndarray]) -> list[np.ndarray]:
        first = turned(next(layers))
        found = np.empty((len(names), *first.shape), first.dtype)
        found[0] = first
        for i, layer in enumerate(layers):
            found[i + 1] = turned(layer)
        return [found]

    def turned(array: np.ndarray) -> np.ndarray:
        return array.T if transpose else array

    def shapes(shape: Shape) -> list[Shape]:
        return [shape[:0:-1] if transpose else shape[1:]] * len(names)

    return Rule((ours,), names, shapes, stacked_up, lambda a: [turned(layer) for layer in a])


def read(
    rules: Sequence[Rule],
    theirs: MutableMapping[str, Any],
    shapes: Mapping[str, Shape],
    whose: str,
    place: Callable[[str, np.ndarray], Any],
) -> dict[str, Any]:
    """Their leaves as ours.

    Args:
        rules: the layout.
        theirs: their leaves by name; those that are used are taken out, to free their memory.
        shapes: of our leaves, by path in our model.
        whose: what to call them in an error.
        place: what to keep of each of our leaves (name, array), called as soon as it is read.

    Returns:
        What `place` gave, by path in our model.

    Raises:
        OtherModelError: a leaf is missing, some are left over, or one has another shape.
        ValueError: a leaf is not of finite real numbers.
    """
    missing = [name for rule in rules for name in rule.theirs if name not in theirs]
    unexpected = theirs.keys() - {name for rule in rules for name in rule.theirs}
    for problem, names in (("lacks", missing), ("has, beyond this model,", sorted(unexpected))):
        if names:
            raise OtherModelError(f"{whose} {problem} {_some(names)}.")

    def taken(name: str, shape: Shape) -> np.ndarray:
        array = np.asarray(theirs.pop(name))
        if array.shape != shape:
            found = f"{whose} has {name} of shape {array.shape}"
            raise OtherModelError(f"{found}, the model needs {shape}.")
        if not jnp.issubdtype(array.dtype, jnp.floating) or not np.isfinite(array).all():
            raise ValueError(f"{whose} has {name} of numbers that are not real or not finite.")
        return array

    found: dict[str, Any] = {}
    for rule in rules:
        wanted = rule.shapes(*(shapes[name] for name in rule.ours))
        ours = rule.to_ours(taken(*each) for each in zip(rule.theirs, wanted, strict=True))
        found |= {name: place(name, a) for name, a in zip(rule.ours, ours, strict=True)}
        del ours  # or it would stay beside what the next rule reads
    return found


def write(rules: Sequence[Rule], ours: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Our leaves under their names and in their shapes, contiguous."""
    found: dict[str, np.ndarray] = {}
    for rule in rules:
        arrays = rule.to_theirs(*(np.asarray(ours[name]) for name in rule.ours))
        found |= {
            name: np.ascontiguousarray(a) for name, a in zip(rule.theirs, arrays, strict=True)
        }
    return found


def _some(names: Sequence[str], most: int = 8) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
