"""Checks of arguments; each error message is one sentence."""

import math
import numbers
from typing import Any

import jax
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
    if number < minimum:
        raise ValueError(f"{name} must be at least {minimum}, got {number}")
    if number > maximum:
        raise ValueError(f"{name} must be at most {maximum:,}, got {number:,}")
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


def key(value: Any) -> Any:
    """Check that a value is a key from `jax.random.key` or `jax.random.PRNGKey`, and return it.

    Raises:
        TypeError: the value is not a key, or is an array of keys.
    """
    dtype, shape = getattr(value, "dtype", None), getattr(value, "shape", None)
    if dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key):
        if shape != ():
            raise TypeError(f"key must be a single key, got an array of keys of shape {shape}")
    elif dtype != jnp.uint32 or shape not in ((2,), (4,)):  # raw keys of threefry and rbg
        raise TypeError(f"key must be a JAX key such as jax.random.key(0), got {short(value)}")
    return value


def action(value: Any, shape: tuple[int, ...]) -> Any:
    """Check that a value is a numeric array of this shape, and return it.

    Raises:
        TypeError: the value is not a numeric array.
        ValueError: the array has a different shape.
    """
    if not is_numeric(value):
        raise TypeError(
            f"action must be a numeric array of shape {list(shape)}, got {short(value)}"
        )
    if value.shape != shape:
        raise ValueError(f"action must have shape {shape}, got {value.shape}")
    return value


def instance(name: str, value: Any, kind: type, expected: str) -> None:
    """Raise a TypeError that asks for `expected` if a value is not an instance of `kind`."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be {expected}, got {short(value)}")


def is_numeric(value: Any) -> bool:
    """Return whether a value is an array (not a list) of integers or floats."""
    dtype = getattr(value, "dtype", None)
    return dtype is not None and (
        jnp.issubdtype(dtype, jnp.integer) or jnp.issubdtype(dtype, jnp.floating)
    )


def short(value: Any) -> str:
    """Describe a value briefly, for error messages."""
    if hasattr(value, "dtype"):
        return f"an array of {value.dtype}, shape {getattr(value, 'shape', ())}"
    text = repr(value)
    return text if len(text) <= 40 else f"a {type(value).__name__}"
