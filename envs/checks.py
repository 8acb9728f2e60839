"""Checks of arguments; each error message is one sentence."""

import math
import numbers
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np


def count(name: str, value: Any, maximum: int, minimum: int = 1) -> int:
    """Check that a value is an integer from `minimum` to `maximum`, and return it as an int.

    Raises:
        TypeError: the value is not an integer.
        ValueError: the value is out of range.
    """
    if isinstance(value, bool | np.bool_) or not isinstance(value, numbers.Integral):
        raise TypeError(f"{name} must be an integer, got {value!r}")
    number = int(value)
    if not minimum <= number <= maximum:
        raise ValueError(f"{name} must be {minimum} to {maximum:,}, got {number:,}")
    return number


def number(name: str, value: Any) -> float:
    """Check that a value is a finite real number or scalar array, and return it as a float.

    Raises:
        TypeError: the value is not a real number.
        ValueError: the value is not finite.
    """
    real = isinstance(value, numbers.Real) and not isinstance(value, bool)
    if not real and not (is_numeric(value) and value.shape == ()):
        raise TypeError(f"{name} must be a number, got {value!r}")
    if not math.isfinite(value):
        raise ValueError(f"{name} must be finite, got {value!r}")
    return float(value)


def choice(name: str, value: Any, known: Sequence[str]) -> None:
    """Raise a ValueError that lists the known values unless `value` is one of them."""
    if value not in known:
        raise ValueError(f"unknown {name} {value!r}: choose from {', '.join(known)}")


def action(value: Any, shape: tuple[int, ...]) -> Any:
    """Return an array of actions; raise a ValueError unless it has this shape."""
    if np.shape(value) != shape:
        raise ValueError(f"action must have shape {shape}, got {np.shape(value)}")
    return value


def is_numeric(value: Any) -> bool:
    """Return whether a value is an array (not a list) of integers or floats."""
    dtype = getattr(value, "dtype", None)
    return dtype is not None and (
        jnp.issubdtype(dtype, jnp.integer) or jnp.issubdtype(dtype, jnp.floating)
    )
