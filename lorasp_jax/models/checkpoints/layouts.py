"""Convert between this project's parameter layout ("ours") and other projects' ("theirs").

A layout is a list of rules; each maps some of their leaves to some of ours, and back. Values are
only sliced, transposed, stacked and reshaped, so the conversion is exact. Shapes are checked before
reshaping, because models with different head counts can have the same number of elements.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

Shape = tuple[int, ...]


class ModelMismatchError(ValueError):
    """The checkpoint belongs to a different model or model size."""


class Rule(NamedTuple):
    """A set of our leaves and the set of their leaves that holds the same values."""

    ours: tuple[str, ...]
    theirs: tuple[str, ...]
    shapes: Callable[..., Sequence[Shape]]
    """Shapes of our leaves -> shapes of theirs."""
    to_ours: Callable[[Iterator[np.ndarray]], Sequence[np.ndarray]]
    """Iterator over their arrays, each read when requested -> our arrays."""
    to_theirs: Callable[..., Sequence[np.ndarray]]
    """Our arrays -> their arrays."""


def copied(ours: str, theirs: str) -> Rule:
    """Rule for an array that they store unchanged under another name."""
    return Rule((ours,), (theirs,), lambda shape: [shape], list, lambda a: [a])


def reshaped(ours: str, theirs: str, ours_shape: Shape, theirs_shape: Shape) -> Rule:
    """Rule for an array that they store in the same order of elements but a different shape."""
    return Rule(
        (ours,),
        (theirs,),
        lambda _: [theirs_shape],
        lambda arrays: [a.reshape(ours_shape) for a in arrays],
        lambda a: [a.reshape(theirs_shape)],
    )


def transposed(ours: str, theirs: str) -> Rule:
    """Rule for our matrix `[I, O]` stored as `[O, I]`, as in PyTorch's linear layers."""
    return Rule(
        (ours,),
        (theirs,),
        lambda shape: [shape[::-1]],
        lambda arrays: [a.T for a in arrays],
        lambda a: [a.T],
    )


def stacked(ours: str, theirs: Iterable[str], *, transpose: bool = False) -> Rule:
    """Rule for our array `[L, ...]` stored as one array per layer, optionally transposed."""
    names = tuple(theirs)

    def stack_layers(layers: Iterator[np.ndarray]) -> list[np.ndarray]:
        first = maybe_transpose(next(layers))
        stack = np.empty((len(names), *first.shape), first.dtype)
        stack[0] = first
        for i, layer in enumerate(layers):
            stack[i + 1] = maybe_transpose(layer)
        return [stack]

    def maybe_transpose(array: np.ndarray) -> np.ndarray:
        return array.T if transpose else array

    def shapes(shape: Shape) -> list[Shape]:
        return [shape[:0:-1] if transpose else shape[1:]] * len(names)

    def unstack_layers(stack: np.ndarray) -> list[np.ndarray]:
        return [maybe_transpose(layer) for layer in stack]

    return Rule((ours,), names, shapes, stack_layers, unstack_layers)


def to_ours(
    rules: Sequence[Rule],
    theirs: MutableMapping[str, Any],
    shapes: Mapping[str, Shape],
    source: str,
    convert: Callable[[str, np.ndarray], Any],
) -> dict[str, Any]:
    """Convert their leaves to ours.

    Args:
        rules: the layout.
        theirs: their leaves by name; each is popped when it is read, to free its memory.
        shapes: shapes of our leaves by path.
        source: name of the checkpoint in error messages.
        convert: (path, array) -> leaf to return, called as soon as a rule's arrays are read.

    Returns:
        Our leaves by path.

    Raises:
        ModelMismatchError: missing, unexpected or wrongly shaped leaves.
        ValueError: a leaf is not floating point or not finite.
    """
    missing = [name for rule in rules for name in rule.theirs if name not in theirs]
    unexpected = theirs.keys() - {name for rule in rules for name in rule.theirs}
    for problem, names in (("lacks", missing), ("has unexpected leaves", sorted(unexpected))):
        if names:
            raise ModelMismatchError(f"{source} {problem} {', '.join(names[:8])}")

    def pop(name: str, shape: Shape) -> np.ndarray:
        array = np.asarray(theirs.pop(name))
        if array.shape != shape:
            raise ModelMismatchError(f"{name} of {source} is {array.shape}, expected {shape}")
        if array.dtype == np.float64:
            with np.errstate(over="ignore"):  # overflows to inf, which is refused
                array = array.astype(np.float32)
        if not jnp.issubdtype(array.dtype, jnp.floating) or not np.isfinite(array).all():
            raise ValueError(f"{name} of {source} must be floating point and finite")
        return array

    converted: dict[str, Any] = {}
    for rule in rules:
        expected = rule.shapes(*(shapes[name] for name in rule.ours))
        ours = rule.to_ours(pop(*leaf) for leaf in zip(rule.theirs, expected, strict=True))
        converted |= {name: convert(name, a) for name, a in zip(rule.ours, ours, strict=True)}
        del ours  # free them before the next rule reads more
    return converted


def to_theirs(rules: Sequence[Rule], ours: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Convert our leaves to theirs, as contiguous arrays."""
    theirs: dict[str, np.ndarray] = {}
    for rule in rules:
        arrays = rule.to_theirs(*(np.asarray(ours[name]) for name in rule.ours))
        theirs |= {
            name: np.ascontiguousarray(a) for name, a in zip(rule.theirs, arrays, strict=True)
        }
    return theirs
