"""Check what a user passes: fields of a dataclass, numbers, keys and kernels."""

import dataclasses
import difflib
import types
import typing
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

MAX_FLOAT32 = (2 - 2**-23) * 2.0**127
MAX_QUOTED = 300
"""Maximum length of a value quoted in an error message [characters]."""
MAX_INT = 2**31 - 1
"""Default upper bound for integers: the int32 maximum."""


def check_fields(owner: Any, prefix: str = "", maximum: int = MAX_INT) -> None:
    """Check field values against their annotations.

    An int is a valid float; a bool is neither.

    Args:
        owner: a dataclass instance. Only annotations that are classes, unions, `Literal` or
            homogeneous tuples are checked.
        prefix: prefix of field names in messages, such as "optim.".
        maximum: bound on the magnitude of integers whose field's metadata has no "max".

    Raises:
        ValueError: a value has the wrong type, a number is not finite in fp32, or an integer is
            too large.
    """
    fields = dataclasses.fields(owner) if dataclasses.is_dataclass(owner) else ()
    bounds = {field.name: field.metadata.get("max", maximum) for field in fields}
    for name, kind in typing.get_type_hints(type(owner)).items():
        if typing.get_origin(kind) is typing.ClassVar:
            continue
        value = getattr(owner, name)
        if not _fits(value, kind):
            raise ValueError(f"{prefix}{name} must be {_describe(kind)}, got {short(value)}")
        if type(value) is int and abs(value) > bounds[name]:
            bound = f"at most {bounds[name]}" if value > 0 else f"at least -{bounds[name]}"
            raise ValueError(f"{prefix}{name} must be {bound}, got {value}")


def check_names(cls: type, name: str, values: Sequence[Any], fields: Iterable[str]) -> None:
    """Raise ValueError for too many positional values, or for an unknown field name."""
    valid = [field.name for field in dataclasses.fields(cls)]
    if len(values) > len(valid):
        names = ", ".join(valid)
        raise ValueError(f"{name} takes at most {len(valid)} values ({names}), got {len(values)}")
    for field in fields:
        if field not in valid:
            close = difflib.get_close_matches(field, valid, n=1, cutoff=0.4)
            hint = f" (did you mean {close[0]!r}?)" if close else ""
            raise ValueError(
                f"{name} has no field {short(field)}{hint}; valid fields are {', '.join(valid)}"
            )


def at_least(low: int, owner: object, *names: str, prefix: str = "") -> None:
    """Raise ValueError if any of the named fields is below `low`."""
    for name in names:
        value = getattr(owner, name)
        require(value >= low, f"{prefix}{name} must be at least {low}", value)


def require(holds: bool, rule: str, value: object) -> None:
    """Raise ValueError unless the rule holds for the value."""
    if not holds:
        raise ValueError(f"{rule}, got {value}")


def positive_int(name: str, value: Any, maximum: int = MAX_INT) -> int:
    """Return the value; raise ValueError unless it is an integer from 1 to `maximum`."""
    if type(value) is not int or not 1 <= value <= maximum:
        raise ValueError(f"{name} must be an integer from 1 to {maximum}, got {short(value)}")
    return value


def checked_key(value: Any) -> jax.Array:
    """Return a single `jax.random` key; raise ValueError for anything else."""
    dtype, shape = (value.dtype, value.shape) if is_array(value) else (None, None)
    typed = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key) and shape == ()
    # Raw keys: threefry has 2 words, rbg 4.
    if not typed and (dtype != jnp.uint32 or shape not in ((2,), (4,))):
        raise ValueError(f"key must be a PRNG key such as jax.random.key(0), got {short(value)}")
    return value


def check_kernel(kernel: Any) -> None:
    """Raise ValueError unless the kernel is a floating-point matrix, or the shape of one."""
    shape, dtype = getattr(kernel, "shape", ()), getattr(kernel, "dtype", int)
    if len(shape) != 2 or 0 in shape or not jnp.issubdtype(dtype, jnp.floating):
        actual = f"{dtype} {list(shape)}" if hasattr(kernel, "dtype") else type(kernel).__name__
        raise ValueError(f"an adapter needs a floating-point kernel [I, O], got {actual}")


def short(value: Any) -> str:
    """Abbreviate a value for an error message, on one line."""
    if is_array(value):
        return f"{value.dtype} {list(value.shape)}"
    text = " ".join(repr(value).split())
    return text if len(text) <= MAX_QUOTED else f"{text[:MAX_QUOTED]}..."


def is_array(value: Any) -> bool:
    """Whether a value has a dtype and a shape tuple. (`nnx.Rngs` can have any attribute.)"""
    return hasattr(value, "dtype") and isinstance(getattr(value, "shape", None), tuple)


def _fits(value: Any, kind: Any) -> bool:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, member) for member in arguments)
    if origin is typing.Literal:
        return any(type(value) is type(option) and value == option for option in arguments)
    if origin is tuple:
        return isinstance(value, tuple) and all(_fits(item, arguments[0]) for item in value)
    if kind is float:
        real = isinstance(value, int | float) and type(value) is not bool
        return real and abs(value) <= MAX_FLOAT32
    if kind is int:
        return isinstance(value, int) and type(value) is not bool
    return isinstance(value, kind) if isinstance(kind, type) else True


def _describe(kind: Any) -> str:
    """Describe an annotation for an error message."""
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        return " or ".join(map(_describe, typing.get_args(kind)))
    if kind is types.NoneType:
        return "None"
    if typing.get_origin(kind) is typing.Literal:
        return f"one of {', '.join(map(repr, typing.get_args(kind)))}"
    if kind is float:
        return "a finite number"
    return kind.__name__ if isinstance(kind, type) else str(kind).replace("typing.", "")
