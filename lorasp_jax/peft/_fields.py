"""Whether values are of the kinds that the fields of a dataclass must have."""

import dataclasses
import difflib
import types
import typing
from collections.abc import Iterable, Sequence
from typing import Any

MAX_FLOAT32 = (2 - 2**-23) * 2.0**127
"""Largest number of fp32."""
MAX_QUOTED = 300
"""Characters that are quoted of a value."""
MAX_INT = 2**31 - 1
"""Largest whole number that arrays and their sizes take everywhere."""


def check_fields(owner: Any, prefix: str = "") -> None:
    """Compares a dataclass with its annotations; an int is a float, a bool is no number.

    Args:
        owner: an instance; of its fields' types, classes, unions, `Literal` and tuples of one type
            are looked at.
        prefix: what the fields' names begin with, such as "optim.".

    Raises:
        ValueError: a value of another kind, a number that is not finite, or a whole one beyond
            `MAX_INT`, or beyond what its field's metadata gives as "most".
    """
    fields = dataclasses.fields(owner) if dataclasses.is_dataclass(owner) else ()
    most = {field.name: field.metadata.get("most", MAX_INT) for field in fields}
    for name, kind in typing.get_type_hints(type(owner)).items():
        if typing.get_origin(kind) is typing.ClassVar:
            continue
        value = getattr(owner, name)
        if not _fits(value, kind):
            raise ValueError(f"{prefix}{name} must be {_called(kind)}, got {short(value)}")
        if type(value) is int and abs(value) > most.get(name, MAX_INT):
            raise ValueError(f"{prefix}{name} must be at most {most[name]}, got {value}")


def check_names(cls: type, name: str, values: Sequence[Any], fields: Iterable[str]) -> None:
    """Raises a ValueError unless these are values and names for the fields of a class."""
    valid = [field.name for field in dataclasses.fields(cls)]
    if len(values) > len(valid):
        raise ValueError(f"{name} has {len(valid)} fields, not {len(values)}: {', '.join(valid)}.")
    for field in fields:
        if field not in valid:
            close = difflib.get_close_matches(field, valid, n=1, cutoff=0.4)
            hint = f" (did you mean {close[0]!r}?)" if close else ""
            raise ValueError(
                f"{name} has no field {short(field)}{hint}; valid are {', '.join(valid)}."
            )


def positive_int(name: str, value: Any, most: int = MAX_INT) -> int:
    """The value; raises a ValueError for what is no whole number from 1 to `most`."""
    if type(value) is not int or not 1 <= value <= most:
        raise ValueError(f"{name} must be a whole number from 1 to {most}, got {short(value)}.")
    return value


def short(value: Any) -> str:
    """What a message says of a value: it on one line, cut where it is long, as a model may be."""
    if is_array(value):
        return f"{value.dtype} {list(value.shape)}"
    text = " ".join(repr(value).split())
    return text if len(text) <= MAX_QUOTED else f"{text[:MAX_QUOTED]}..."


def is_array(value: Any) -> bool:
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
        return real and abs(value) <= MAX_FLOAT32
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
