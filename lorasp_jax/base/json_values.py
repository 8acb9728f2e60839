"""Check JSON values against a schema."""

from collections.abc import Mapping
from typing import Any

MAX_NUMBER = 1e38
"""Upper bound on the magnitude of numbers in our files: counts, checksums, fp32 sums and means."""
_NAMES: dict[Any, str] = {
    str: "a string",
    int: "a whole number",
    float: "a number",
    bool: "true or false",
}


def check(value: Any, kind: Any, name: str = "", *, nulls: bool = False) -> None:
    """Raise ValueError unless a JSON value matches a schema.

    Args:
        value: parsed JSON value.
        kind: the schema: a type, [kind] for a list of any length, (kind, kind) for a list of two,
            or {"a": kind, "b?": kind} for an object with at least the key "a", which may also have
            "b". Other keys may have any value; if the schema has the type `str` as a key, they must
            match its kind.
        name: dotted path of the value, for the error message.
        nulls: whether optional keys may be null, as in other projects' files.
    """
    if isinstance(kind, type):
        if not _is(value, kind):
            raise ValueError(f"{name} must be {_NAMES[kind]}, got {_truncated(value)}")
    elif isinstance(kind, Mapping):
        if not isinstance(value, dict):
            raise ValueError(f"{name or 'it'} must be an object, got {_truncated(value)}")
        required = [key for key in kind if key is not str and not key.endswith("?")]
        if missing := [key for key in required if key not in value]:
            raise ValueError(f"{name or 'it'} lacks {missing[0]!r}")
        for key, item in value.items():
            item_kind = kind.get(key, kind.get(f"{key}?", kind.get(str)))
            is_null = nulls and item is None and f"{key}?" in kind
            if item_kind is not None and not is_null:
                check(item, item_kind, f"{name}.{key}".lstrip("."), nulls=nulls)
    else:
        if not isinstance(value, list) or (isinstance(kind, tuple) and len(value) != len(kind)):
            count = f" of {len(kind)}" if isinstance(kind, tuple) else ""
            raise ValueError(f"{name} must be a list{count}, got {_truncated(value)}")
        for index, item in enumerate(value):
            check(item, kind[0], f"{name}[{index}]", nulls=nulls)


def _is(value: Any, kind: type) -> bool:
    """Return whether a value has a JSON type; integers count as numbers, booleans do not."""
    if not isinstance(value, int | float if kind is float else kind):
        return False
    return isinstance(value, bool) == (kind is bool) and (kind is str or abs(value) <= MAX_NUMBER)


def _truncated(value: Any) -> str:
    return repr(value)[:40]
