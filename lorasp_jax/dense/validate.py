"""What callers hand over: one sentence for what cannot be meant, before anything is computed."""

import os
import pathlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen, nnx

from lorasp_jax.peft import Method, _arguments, _fields
from lorasp_jax.peft._fields import short
from lorasp_jax.peft._method import MAX_SIZE

MAX_NAME_BYTES = 255
"""Bytes of the name of a file or folder."""


def size(name: str, value: Any) -> int:
    """A width; raises a ValueError for what is no whole number from 1 to `MAX_SIZE`."""
    return _fields.positive_int(name, value, MAX_SIZE)


def method(value: Any) -> Method | None:
    """A method or None; raises a ValueError for anything else."""
    if value is not None and not isinstance(value, Method):
        hint = f": write {value.__name__}()" if isinstance(value, type) else ""
        raise ValueError(
            f"a method is None or one such as LoRA(rank=8), got {short(value)}{hint}; "
            "`peft.create` finds one by its name."
        )
    return value


def rngs(value: Any) -> nnx.Rngs:
    """`nnx.Rngs` with a stream for parameters; raises a ValueError for anything else."""
    if not isinstance(value, nnx.Rngs) or not {"params", "default"} & set(value):
        found = list(value) if isinstance(value, nnx.Rngs) else type(value).__name__
        raise ValueError(f"rngs must be nnx.Rngs(a seed or key) with params, got {found}.")
    return value


def array(x: Any) -> Any:
    """An array of numbers; raises a ValueError for what is none, or has no axes."""
    known = isinstance(x, jax.Array | np.ndarray) and x.ndim
    if not known or not (x.dtype == bool or jnp.issubdtype(x.dtype, jnp.number)):
        raise ValueError(f"x must be an array [...tokens, I], got {short(x)}.")
    return x


def floating_dtype(name: str, dtype: Any) -> None:
    """Raises a ValueError for a type that weights cannot have, or computations with them."""
    try:
        fits = jnp.issubdtype(jnp.dtype(dtype), jnp.floating)
    except TypeError:
        fits = False
    if not fits:
        raise ValueError(f"{name} must be a floating-point type, got {short(dtype)}.")


def layer(found: Any, width: int) -> None:
    """Raises a ValueError for a `DenseLayer` that x [...tokens, width] cannot pass."""
    shape = getattr(found.kernel, "shape", ())
    if len(shape) < 2:
        raise ValueError(f"a kernel must be an array [I, *O], got {short(found.kernel)}.")
    if width != shape[0]:
        raise ValueError(f"input of width {width} meets a kernel {tuple(shape)}.")
    bias = tuple(getattr(found.bias, "shape", (0,) * len(shape)))
    ends = zip(bias[::-1], shape[::-1], strict=False)
    if found.bias is not None and not (
        len(bias) < len(shape) and all(b in (1, o) for b, o in ends)
    ):
        raise ValueError(f"a bias must be an array {list(shape[1:])}, got {short(found.bias)}.")
    own = method(found.method)
    if (found.params is None) != (own is None or own.trains_base):
        raise ValueError("an adapter's parameters come with their method, and it with them.")
    if found.dropout_key is not None:
        _arguments.key(found.dropout_key)


def module(model: Any) -> Any:
    """The model; raises a ValueError for what is no NNX module."""
    if not isinstance(model, nnx.Module):
        hint = "; see LinenAdapter for Linen's" if isinstance(model, linen.Module) else ""
        raise ValueError(f"the model must be an NNX module, got {type(model).__name__}{hint}.")
    return model


def with_values(model: Any) -> Any:
    """The module; raises a ValueError for one of shapes alone, and what is no NNX module."""
    leaves = jax.tree.leaves(nnx.state(module(model)))
    if any(isinstance(leaf, jax.ShapeDtypeStruct) for leaf in leaves):
        raise ValueError(
            "the model holds shapes without values: make it, or call this within nnx.eval_shape."
        )
    return model


def variables(value: Any) -> Any:
    """Variables of a Linen model; raises a ValueError for what holds no "params", or no arrays."""
    for part in ("params", "adapters"):
        held = value.get(part, {}) if isinstance(value, Mapping) else None
        if not isinstance(held, Mapping) or (part == "params" and part not in value):
            found = sorted(map(str, value)) if isinstance(value, Mapping) else type(value).__name__
            raise ValueError(
                f'variables are a dictionary with "params", a dictionary too, got {short(found)}.'
            )
        for path, leaf in jax.tree_util.tree_leaves_with_path(held, is_leaf=lambda x: x is None):
            known = isinstance(leaf, jax.Array | np.ndarray | np.generic | float | int)
            if not known or getattr(leaf, "dtype", None) == np.dtype(object):
                place = jax.tree_util.keystr(path, simple=True, separator="/")
                raise ValueError(f'"{part}" must hold arrays, got {short(leaf)} at {place}.')
    return value


def folder(value: Any) -> pathlib.Path:
    """A folder's path; raises a ValueError for what no file system takes as one."""
    text = os.fspath(value) if isinstance(value, str | os.PathLike) else None
    if not isinstance(text, str) or not text or "\0" in text:
        raise ValueError(f"a folder is a text or a path, got {short(value)}.")
    path = pathlib.Path(text)
    if len(path.parts) > 1 and path.parts[0].endswith(":"):  # of a Path, which has one slash
        raise ValueError(f"{text} is a URL; a folder of adapters lies on this machine.")
    if any(len(part.encode(errors="replace")) > MAX_NAME_BYTES for part in path.parts):
        raise ValueError(f"a name in a path has {MAX_NAME_BYTES} bytes at most, got {short(text)}.")
    if path.exists() and not path.is_dir():
        raise ValueError(f"{path} is no folder.")
    return path
