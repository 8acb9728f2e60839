"""Validate arguments before any computation."""

import math
import os
import pathlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen, nnx

from lorasp_jax.peft import Method
from lorasp_jax.peft.fields import checked_key, positive_int, short
from lorasp_jax.peft.method import MAX_SIZE, check_params

MAX_NAME_BYTES = 255
"""Maximum length of a file or folder name [bytes]."""


def size(name: str, value: Any) -> int:
    """Return a width; raise ValueError unless it is an integer from 1 to `MAX_SIZE`."""
    return positive_int(name, value, MAX_SIZE)


def method(value: Any) -> Method | None:
    """Return a method or None; raise ValueError for anything else."""
    if value is not None and not isinstance(value, Method):
        hint = f": write {value.__name__}()" if isinstance(value, type) else ""
        raise ValueError(
            f"method must be None or a Method such as LoRA(rank=8), got {short(value)}{hint}; "
            "`peft.create` creates one by name"
        )
    return value


def rngs(value: Any) -> nnx.Rngs:
    """Return `nnx.Rngs`; raise ValueError unless it has a stream for parameters."""
    if not isinstance(value, nnx.Rngs) or not {"params", "default"} & set(value):
        actual = list(value) if isinstance(value, nnx.Rngs) else type(value).__name__
        raise ValueError(
            "rngs must be nnx.Rngs with a params or default stream, such as nnx.Rngs(0), got "
            f"{actual}"
        )
    return value


def array(x: Any) -> Any:
    """Return x; raise ValueError unless it is a numeric or bool array with at least one axis."""
    has_axes = isinstance(x, jax.Array | np.ndarray) and x.ndim
    if not has_axes or not (x.dtype == bool or jnp.issubdtype(x.dtype, jnp.number)):
        raise ValueError(f"x must be an array [...tokens, I], got {short(x)}")
    return x


def floating_dtype(name: str, dtype: Any) -> None:
    """Raise ValueError unless `dtype` is a floating-point dtype."""
    try:
        is_floating = jnp.issubdtype(jnp.dtype(dtype), jnp.floating)
    except TypeError:
        is_floating = False
    if not is_floating:
        raise ValueError(f"{name} must be a floating-point dtype, got {short(dtype)}")


def layer(arrays: Any) -> None:
    """Raise ValueError unless the arrays, method and key of a `DenseLayer` fit together."""
    shape = getattr(arrays.kernel, "shape", ())
    if len(shape) < 2:
        raise ValueError(f"kernel must be an array [I, *O], got {short(arrays.kernel)}")
    bias = tuple(getattr(arrays.bias, "shape", (0,) * len(shape)))
    trailing = zip(bias[::-1], shape[::-1], strict=False)
    if arrays.bias is not None and not (
        len(bias) < len(shape) and all(b in (1, o) for b, o in trailing)
    ):
        raise ValueError(f"bias must be an array {list(shape[1:])}, got {short(arrays.bias)}")
    adapter_method = method(arrays.method)
    if (arrays.params is None) != (adapter_method is None or adapter_method.trains_base):
        raise ValueError("params and method must be given together")
    if arrays.params is not None:
        check_params(arrays.method, arrays.params, (shape[0], math.prod(shape[1:])))
    if arrays.dropout_key is not None:
        checked_key(arrays.dropout_key)


def module(model: Any) -> Any:
    """Return the model; raise ValueError unless it is an NNX module."""
    if not isinstance(model, nnx.Module):
        hint = "; for a Linen module use LinenAdapter" if isinstance(model, linen.Module) else ""
        raise ValueError(f"the model must be an NNX module, got {type(model).__name__}{hint}")
    return model


def with_values(model: Any) -> Any:
    """Return an NNX module; raise ValueError if it holds shapes instead of arrays."""
    leaves = jax.tree.leaves(nnx.state(module(model)))
    if any(isinstance(leaf, jax.ShapeDtypeStruct) for leaf in leaves):
        raise ValueError(
            "the model holds shapes without values: initialize it, or call this inside "
            "nnx.eval_shape"
        )
    return model


def variables(value: Any) -> Any:
    """Return the variables of a Linen model; raise ValueError for an invalid structure or leaf."""
    for name in ("params", "adapters"):
        collection = value.get(name, {}) if isinstance(value, Mapping) else None
        if not isinstance(collection, Mapping) or (name == "params" and name not in value):
            actual = sorted(map(str, value)) if isinstance(value, Mapping) else type(value).__name__
            raise ValueError(
                f'variables must be a dict whose "params" is a dict, got {short(actual)}'
            )
        leaves = jax.tree_util.tree_leaves_with_path(collection, is_leaf=lambda x: x is None)
        for path, leaf in leaves:
            is_numeric = isinstance(leaf, jax.Array | np.ndarray | np.generic | float | int)
            if not is_numeric or getattr(leaf, "dtype", None) == np.dtype(object):
                location = jax.tree_util.keystr(path, simple=True, separator="/")
                raise ValueError(f'"{name}" must hold arrays, got {short(leaf)} at {location}')
    return value


def folder(value: Any) -> pathlib.Path:
    """Return a local folder's path, existing or not; raise ValueError if it is invalid."""
    text = os.fspath(value) if isinstance(value, str | os.PathLike) else None
    if not isinstance(text, str) or not text or "\0" in text:
        raise ValueError(f"folder must be a str or path, got {short(value)}")
    path = pathlib.Path(text)
    if len(path.parts) > 1 and path.parts[0].endswith(":"):  # Path collapses the // of a URL
        raise ValueError(f"{text} is a URL; adapters must be in a local folder")
    if any(len(part.encode(errors="replace")) > MAX_NAME_BYTES for part in path.parts):
        raise ValueError(
            f"path components must have at most {MAX_NAME_BYTES} bytes, got {short(text)}"
        )
    if path.exists() and not path.is_dir():
        raise ValueError(f"{path} is not a folder")
    return path
