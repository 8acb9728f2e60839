"""Validate the arrays, keys and parameters passed to a method."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.peft._fields import is_array, short

Shapes = dict[str, tuple[int, ...]]
"""Shapes of parameters by path, such as "router/w2"."""


def key(value: Any) -> jax.Array:
    """Return a single `jax.random` key; raise ValueError for anything else."""
    dtype, shape = (value.dtype, value.shape) if is_array(value) else (None, None)
    typed = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key) and shape == ()
    # Raw keys: threefry has 2 words, rbg 4.
    if not typed and (dtype != jnp.uint32 or shape not in ((2,), (4,))):
        raise ValueError(f"key must be a PRNG key such as jax.random.key(0), got {short(value)}")
    return value


def tokens(x: Any, token_mask: Any) -> None:
    """Raise ValueError unless x is floating [...tokens, I] and mask is None or bool [...tokens]."""
    if not (is_array(x) and x.shape and jnp.issubdtype(x.dtype, jnp.floating)):
        actual = f"{x.dtype} {list(x.shape)}" if is_array(x) else type(x).__name__
        raise ValueError(f"x must be a floating-point array [...tokens, I], got {actual}")
    if token_mask is not None:
        actual = getattr(token_mask, "dtype", type(token_mask).__name__), np.shape(token_mask)
        if actual != (bool, x.shape[:-1]):
            expected = f"token_mask must be bool {list(x.shape[:-1])}"
            raise ValueError(f"{expected}, got {actual[0]} {list(actual[1])}")


def params(method: Any, values: Any, shape: tuple[int, ...]) -> None:
    """Raise ValueError if the parameters do not fit the method and a kernel [I, O].

    Without this check, parameters of a different rank could silently get the wrong scale.
    """
    actual = _shapes(values)
    for name, expected in method.shapes(_initial_shapes(method, shape), actual).items():
        if actual.get(name) != expected:
            raise ValueError(
                f"{method.name} for a kernel {list(shape)} needs {name} {list(expected)}, got "
                f"{list(actual[name]) if name in actual else 'none'}"
            )


def matrix(kernel: Any) -> None:
    """Raise ValueError unless the kernel is a floating-point matrix, or the shape of one."""
    shape, dtype = getattr(kernel, "shape", ()), getattr(kernel, "dtype", int)
    if len(shape) != 2 or 0 in shape or not jnp.issubdtype(dtype, jnp.floating):
        actual = f"{dtype} {list(shape)}" if hasattr(kernel, "dtype") else type(kernel).__name__
        raise ValueError(f"an adapter needs a floating-point kernel [I, O], got {actual}")


@functools.lru_cache(maxsize=1024)  # a model's layers share shapes and are traced repeatedly
def _initial_shapes(method: Any, shape: tuple[int, ...]) -> Shapes:
    return _shapes(jax.eval_shape(lambda: method.init_params(jax.random.key(0), *shape)))


def _shapes(params: Any) -> Shapes:
    leaves = jax.tree_util.tree_leaves_with_path(params)
    return {
        jax.tree_util.keystr(path, simple=True, separator="/"): jnp.shape(leaf)
        for path, leaf in leaves
    }
