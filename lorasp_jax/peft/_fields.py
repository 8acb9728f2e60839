"""Whether values are of the kinds that the fields of a dataclass, or arguments, must have."""

import dataclasses
import functools
import types
import typing
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

LARGEST_REAL = (2 - 2**-23) * 2.0**127
"""Largest number of fp32."""
LONGEST = 300
"""Characters that are quoted of a value."""
LARGEST = 2**31 - 1
"""Largest whole number that arrays and their sizes take everywhere."""


def check_fields(owner: Any, prefix: str = "") -> None:
    """Compares a dataclass with its annotations; an int is a float, a bool is no number.

    Args:
        owner: an instance; of its fields' types, classes, unions, `Literal` and tuples of one type
            are looked at.
        prefix: what the fields' names begin with, such as "optim.".

    Raises:
        ValueError: a value of another kind, a number that is not finite, or a whole one beyond
            `LARGEST`, or beyond what its field's metadata gives as "most".
    """
    fields = dataclasses.fields(owner) if dataclasses.is_dataclass(owner) else ()
    most = {field.name: field.metadata.get("most", LARGEST) for field in fields}
    for name, kind in typing.get_type_hints(type(owner)).items():
        if typing.get_origin(kind) is typing.ClassVar:
            continue
        value = getattr(owner, name)
        if not _fits(value, kind):
            raise ValueError(f"{prefix}{name} must be {_called(kind)}, got {short(value)}")
        if type(value) is int and abs(value) > most.get(name, LARGEST):
            raise ValueError(f"{prefix}{name} must be at most {most[name]}, got {value}")


def whole(name: str, value: Any, most: int = LARGEST) -> int:
    """The value; raises a ValueError for what is no whole number from 1 to `most`."""
    if type(value) is not int or not 1 <= value <= most:
        raise ValueError(f"{name} must be a whole number from 1 to {most}, got {short(value)}.")
    return value


def key(value: Any) -> jax.Array:
    """One key of `jax.random`; raises a ValueError for anything else."""
    dtype, shape = (value.dtype, value.shape) if _is_array(value) else (None, None)
    typed = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key) and shape == ()
    if not typed and (dtype != jnp.uint32 or shape not in ((2,), (4,))):  # raw, threefry's, rbg's
        raise ValueError(f"key must be one such as jax.random.key(0), got {short(value)}.")
    return value


def tokens(x: Any, token_mask: Any) -> None:
    """Raises a ValueError unless x is inexact [...tokens, I] and a mask bool [...tokens]."""
    if not (_is_array(x) and x.shape and jnp.issubdtype(x.dtype, jnp.inexact)):
        shown = f"{x.dtype} {list(x.shape)}" if _is_array(x) else type(x).__name__
        raise ValueError(f"x must be floating-point numbers [...tokens, I], got {shown}.")
    if token_mask is not None:
        found = getattr(token_mask, "dtype", type(token_mask).__name__), np.shape(token_mask)
        if found != (bool, x.shape[:-1]):
            wanted = f"token_mask must be bool {list(x.shape[:-1])}"
            raise ValueError(f"{wanted}, got {found[0]} {list(found[1])}.")


def check_params(method: Any, found: Any, shape: tuple[int, ...]) -> None:
    """Raises a ValueError for parameters that a method would not make for a kernel [I, O].

    Some would be taken without an error, and computed with the scale of another rank.
    """
    held = _shapes(found)
    for name, wanted in _made_shapes(method, shape).items():
        if held.get(name) != wanted:
            raise ValueError(
                f"{method.name} of a kernel {list(shape)} needs {name} {list(wanted)}, got "
                f"{held.get(name)}."
            )


def short(value: Any) -> str:
    """What a message says of a value: it on one line, cut where it is long, as a model may be."""
    if _is_array(value):
        return f"{value.dtype} {list(value.shape)}"
    text = " ".join(repr(value).split())
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


@functools.lru_cache(maxsize=1024)  # layers of a model are alike, and traced again and again
def _made_shapes(method: Any, shape: tuple[int, ...]) -> dict[str, tuple[int, ...]]:
    return _shapes(jax.eval_shape(lambda: method.init_params(jax.random.key(0), *shape)))


def _shapes(params: Any) -> dict[str, tuple[int, ...]]:
    leaves = jax.tree_util.tree_leaves_with_path(params)
    return {jax.tree_util.keystr(path): jnp.shape(leaf) for path, leaf in leaves}


def _is_array(value: Any) -> bool:
    """Whether it has a type and a shape; `nnx.Rngs` has an attribute of every name."""
    return hasattr(value, "dtype") and isinstance(getattr(value, "shape", None), tuple)


def _fits(value: Any, kind: Any) -> bool:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, one) for one in arguments)
    if origin is typing.Literal:
        return any(type(value) is type(one) and value == one for one in arguments)
    if origin is tuple:
        return isinstance(value, tuple) and all(_fits(item, arguments[0]) for item in value)
    if kind is float:
        real = isinstance(value, int | float) and type(value) is not bool
        return real and abs(value) <= LARGEST_REAL
    if kind is int:
        return isinstance(value, int) and type(value) is not bool
    return isinstance(value, kind) if isinstance(kind, type) else True


def _called(kind: Any) -> str:
    """A kind in words."""
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        return " or ".join(map(_called, typing.get_args(kind)))
    if kind is types.NoneType:
        return "None"
    if typing.get_origin(kind) is typing.Literal:
        return f"one of {', '.join(map(repr, typing.get_args(kind)))}"
    if kind is float:
        return "a finite number"
    return kind.__name__ if isinstance(kind, type) else str(kind).replace("typing.", "")
