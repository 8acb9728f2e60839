"""Check the values in a JSON file against what they should be."""

from collections.abc import Mapping
from typing import Any

LARGEST = 1e38
"""No number in a file is larger: they are counts, checksums, and sums and means of fp32."""
_NAMES: dict[Any, str] = {str: "a text", int: "a whole number", float: "a number", bool: "a flag"}


def check(value: Any, kind: Any, name: str = "") -> None:
    """Raise ValueError unless a JSON value is of a kind.

    Args:
        value: what was read.
        kind: a type; [kind] for a list of any length, (kind, kind) for one of two; {"a": kind} for
            an object that has "a", among others; {str: kind} for one whose other values are such.
        name: of the value, with those that it lies in.
    """
    if isinstance(kind, type):
        if not _is(value, kind):
            raise ValueError(f"{name} must be {_NAMES[kind]}, not {_shown(value)}")
    elif isinstance(kind, Mapping):
        if not isinstance(value, dict):
            raise ValueError(f"{name or 'it'} must be an object, not {_shown(value)}")
        if missing := [key for key in kind if key is not str and key not in value]:
            raise ValueError(f"{name or 'it'} lacks {missing[0]!r}")
        for key, item in value.items():
            if (wanted := kind.get(key, kind.get(str))) is not None:
                check(item, wanted, f"{name}.{key}".lstrip("."))
    else:
        if not isinstance(value, list) or (isinstance(kind, tuple) and len(value) != len(kind)):
            count = f" of {len(kind)}" if isinstance(kind, tuple) else ""
            raise ValueError(f"{name} must be a list{count}, not {_shown(value)}")
        for number, item in enumerate(value):
            check(item, kind[0], f"{name}[{number}]")


def _is(value: Any, kind: type) -> bool:
    """Whether a value is of a type, as in JSON: a whole number is a number, a flag is none."""
    if not isinstance(value, int | float if kind is float else kind):
        return False
    return isinstance(value, bool) == (kind is bool) and (kind is str or abs(value) <= LARGEST)


def _shown(value: Any) -> str:
    """The beginning of a value that may be long."""
    return repr(value)[:40]
