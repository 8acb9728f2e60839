"""Other projects' layouts of a model's parameters: names and shapes, in and out.

A layout is a list of rules; each says how some of their leaves become some of ours and back. Values
are only sliced, transposed, stacked and reshaped, so they stay exact.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from typing import Any, NamedTuple

import numpy as np


class Rule(NamedTuple):
    """Some of our leaves and some of theirs that hold the same values."""

    ours: tuple[str, ...]
    theirs: tuple[str, ...]
    load: Callable[[Iterator[np.ndarray]], Sequence[np.ndarray]]
    """Their arrays, read as they are asked for -> ours."""
    save: Callable[..., Sequence[np.ndarray]]
    """Our arrays -> theirs."""


def copied(ours: str, theirs: str) -> Rule:
    """The same array under two names."""
    return Rule((ours,), (theirs,), list, lambda a: [a])


def reshaped(
    ours: str, theirs: str, ours_shape: Sequence[int], theirs_shape: Sequence[int]
) -> Rule:
    """The same values in the same order; shapes may hold one -1."""
    return Rule(
        (ours,),
        (theirs,),
        lambda arrays: [a.reshape(ours_shape) for a in arrays],
        lambda a: [a.reshape(theirs_shape)],
    )


def transposed(ours: str, theirs: str) -> Rule:
    """A matrix [I, O] that is theirs [O, I], as PyTorch's linear layers have it."""
    return Rule((ours,), (theirs,), lambda arrays: [a.T for a in arrays], lambda a: [a.T])


def stacked(ours: str, theirs: Iterable[str], *, transpose: bool = False) -> Rule:
    """One of our arrays [L, ...] that is theirs layer by layer, perhaps as in `transposed`."""
    names = tuple(theirs)

    def load(layers: Iterator[np.ndarray]) -> list[np.ndarray]:
        first = turned(next(layers))
        found = np.empty((len(names), *first.shape), first.dtype)
        found[0] = first
        for i, layer in enumerate(layers):
            found[i + 1] = turned(layer)
        return [found]

    def turned(array: np.ndarray) -> np.ndarray:
        return array.T if transpose else array

    return Rule((ours,), names, load, lambda a: [turned(layer) for layer in a])


def read(
    rules: Sequence[Rule],
    theirs: MutableMapping[str, Any],
    whose: str,
    place: Callable[[str, np.ndarray], Any],
) -> dict[str, Any]:
    """Their leaves as ours.

    Args:
        rules: the layout.
        theirs: their leaves by name; those that are used are taken out, to free their memory.
        whose: what to call them in an error.
        place: what to keep of each of our leaves (name, array), called as soon as it is read.

    Returns:
        What `place` gave, by path in our model.

    Raises:
        ValueError: a leaf is missing, some are left over, or one cannot be reshaped.
    """
    missing = [name for rule in rules for name in rule.theirs if name not in theirs]
    unexpected = theirs.keys() - {name for rule in rules for name in rule.theirs}
    for problem, names in (("lacks", missing), ("has, beyond this model,", sorted(unexpected))):
        if names:
            raise ValueError(f"{whose} {problem} {_some(names)}.")
    found: dict[str, Any] = {}
    for rule in rules:
        try:
            ours = rule.load(np.asarray(theirs.pop(name)) for name in rule.theirs)
        except (ValueError, IndexError) as error:
            raise ValueError(f"{whose} has another shape of {rule.theirs[0]}: {error}.") from error
        found |= {name: place(name, a) for name, a in zip(rule.ours, ours, strict=True)}
        del ours  # or it would stay beside what the next rule reads
    return found


def write(rules: Sequence[Rule], ours: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Our leaves under their names and in their shapes, contiguous."""
    found: dict[str, np.ndarray] = {}
    for rule in rules:
        arrays = rule.save(*(np.asarray(ours[name]) for name in rule.ours))
        found |= {
            name: np.ascontiguousarray(a) for name, a in zip(rule.theirs, arrays, strict=True)
        }
    return found


def _some(names: Sequence[str], most: int = 8) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
