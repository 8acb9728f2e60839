"""Whether arrays, keys and parameters can be what a method is called with."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.peft._fields import is_array, short

Shapes = dict[str, tuple[int, ...]]
"""Shapes of parameters by path, such as "router/w2"."""


def key(value: Any) -> jax.Array:
    """One key of `jax.random`; raises a ValueError for anything else."""
    dtype, shape = (value.dtype, value.shape) if is_array(value) else (None, None)
    typed = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key) and shape == ()
    if not typed and (dtype != jnp.uint32 or shape not in ((2,), (4,))):  # raw, threefry's, rbg's
        raise ValueError(f"key must be one such as jax.random.key(0), got {short(value)}.")
    return value


def tokens(x: Any, token_mask: Any) -> None:
    """Raises a ValueError unless x is inexact [...tokens, I] and a mask bool [...tokens]."""
    if not (is_array(x) and x.shape and jnp.issubdtype(x.dtype, jnp.inexact)):
        shown = f"{x.dtype} {list(x.shape)}" if is_array(x) else type(x).__name__
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
    for name, wanted in method.shapes(_made_shapes(method, shape), held).items():
        if held.get(name) != wanted:
            raise ValueError(
                f"{method.name} of a kernel {list(shape)} needs {name} {list(wanted)}, got "
                f"{held.get(name)}."
            )


def matrix(kernel: Any) -> None:
    """Raises a ValueError unless it is one of real numbers, or such a shape."""
    shape, dtype = getattr(kernel, "shape", ()), getattr(kernel, "dtype", int)
    if len(shape) != 2 or 0 in shape or not jnp.issubdtype(dtype, jnp.floating):
        found = f"{dtype} {list(shape)}" if hasattr(kernel, "dtype") else type(kernel).__name__
        raise ValueError(f"an adapter needs a kernel [I, O] of real numbers, got {found}.")


@functools.lru_cache(maxsize=1024)  # layers of a model are alike, and traced again and again
def _made_shapes(method: Any, shape: tuple[int, ...]) -> Shapes:
    return _shapes(jax.eval_shape(lambda: method.init_params(jax.random.key(0), *shape)))


def _shapes(params: Any) -> Shapes:
    leaves = jax.tree_util.tree_leaves_with_path(params)
    return {
        jax.tree_util.keystr(path, simple=True, separator="/"): jnp.shape(leaf)
        for path, leaf in leaves
    }
