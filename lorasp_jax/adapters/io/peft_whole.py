"""Biases and modules that Hugging Face PEFT trains in full, and how its folders hold them.

`bias` "all" and "lora_only" free biases: those of layers with an adapter are named
<module>.base_layer.bias, others <module>.bias. `modules_to_save` frees whole modules, whose weights
are in torch's layout, a dense layer's [out, in].
"""

import math
import pathlib
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np
from flax import nnx

from lorasp_jax.adapters import paths
from lorasp_jax.adapters.io.peft_folders import PREFIX, Adapter, Whole
from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.dense import AdapterParam, Dense
from lorasp_jax.peft._fields import short

Names = Callable[[str, tuple[int, ...]], str]
_TORCH_NAMES = {"kernel": "weight", "embedding": "weight", "scale": "weight", "bias": "bias"}
_AXES = {"embedding": 2, "scale": 1, "bias": 1}  # outside of layers that multiply; more are stacks


def whole_parameters(
    folder: pathlib.Path,
    full: Whole,
    shapes: Mapping[str, Sequence[int]],
    sizes: Mapping[str, Sequence[int]],
    names: Names,
) -> Adapter:
    """By path, the parameters that a folder trained in full, in the model's layout.

    Raises:
      ValueError: one that the model lacks or has in another shape.
    """
    found, left = {}, dict(full)
    for path, size in sizes.items() if full else ():
        module, _, name = path.rpartition("/")
        kind = _TORCH_NAMES.get(name, "")
        leading = _stack(name, size, shapes.get(module))
        wanted = [(names(module, index), kind) for index in np.ndindex(*leading)]
        parts = [left.pop(key) for key in wanted if key in left]
        if not parts:
            continue
        if len(parts) < len(wanted):
            raise ValueError(f"{folder} holds {kind} of only some layers of the stack {module}.")
        value = np.stack([_from_torch(part) if name == "kernel" else part for part in parts])
        rows = value.shape[1:] if name == "kernel" else (value[0].size,)
        own = tuple(size[len(leading) :])
        if rows != (own if name == "kernel" else (math.prod(own),)):
            raise ValueError(f"{folder} holds {path} as {rows}, the model as {own}.")
        found[path] = value.reshape(tuple(size))
    if left:
        module, kind = min(left)
        raise ValueError(f"{folder} holds the {kind} of {short(module)}, which the model lacks.")
    return found


def check_biases(
    folder: pathlib.Path,
    bias: str,
    full: Whole,
    sizes: Collection[str],
    adapted: Collection[str],
) -> None:
    """Raise if a folder says that it trained biases that the model has, and holds none.

    Args:
      folder: of PEFT.
      bias: "none", "all" or "lora_only".
      full: what it holds in full.
      sizes: paths of the model's parameters.
      adapted: paths of layers that the folder adapts.

    Raises:
      ValueError: it does.
    """
    own = [path.rpartition("/")[0] for path in sizes if path.rpartition("/")[2] == "bias"]
    there = own if bias == "all" else set(own) & set(adapted)
    if bias != "none" and there and not any(kind == "bias" for _, kind in full):
        raise ValueError(f"{folder} was trained with bias {bias!r}, but holds no bias.")


def exported_whole(
    model: nnx.Module, adapted: Collection[str], names: Names
) -> tuple[Adapter, dict[str, Any]]:
    """Tensors of what trains in full in a model, by PEFT's name, and what its config says of them.

    Raises:
      ValueError: a parameter that PEFT has no counterpart for.
    """
    locations = [p for p in paths.locate(nnx.List([model]), nnx.Param) if p.name != "adapter"]
    free = [location for location in locations if isinstance(location.child, AdapterParam)]
    saved = {_module(location) for location in free if location.name != "bias"}
    biases = {_module(location) for location in free} - saved
    locate_matmul_layers = paths.locate_matmul_layers(nnx.List([model]))
    shapes = {
        location.path: nnx_layers.matrices_shape(location.child, {})
        for location in locate_matmul_layers
    }
    tensors: Adapter = {}
    for location in locations:
        module = _module(location)
        if module in saved or location in free:
            middle = ".base_layer" if module in adapted else ""
            for index, value in _parts(location, shapes.get(module)):
                name = f"{names(module, index)}{middle}.{_TORCH_NAMES[location.name]}"
                tensors[PREFIX + name] = value
    stems = {name.removeprefix(PREFIX).rpartition(".")[0] for name in tensors}
    kept = sorted(stem for stem in stems if f"{PREFIX}{stem}.weight" in tensors)
    bias = "none" if not biases else "lora_only" if biases <= set(adapted) else "all"
    return tensors, {"bias": bias, "modules_to_save": kept or None}


def _module(location: paths.Location) -> str:
    return location.path.rpartition("/")[0]


def _stack(name: str, size: Sequence[int], matrices: Sequence[int] | None) -> tuple[int, ...]:
    """Axes of a stack of layers in a parameter of this size.

    Args:
      name: of the parameter.
      size: its shape.
      matrices: [..., I, O] of its layer's kernel, if that multiplies its input by matrices.
    """
    if matrices is not None:
        return tuple(matrices[:-2])
    return tuple(size[: -_AXES[name]]) if name in _AXES else ()


def _from_torch(kernel: np.ndarray) -> np.ndarray:
    """[I, O] of torch's [out, in], and a convolution's [*sizes, I, O] of [out, in, *sizes]."""
    return kernel.transpose(*range(2, kernel.ndim), 1, 0)


def _parts(
    location: paths.Location, matrices: Sequence[int] | None
) -> list[tuple[tuple[int, ...], np.ndarray]]:
    """Index in a stack and value in torch's layout, of each layer that shares a parameter."""
    value, name = np.asarray(location.child.get_value(), np.float32), location.name
    dense = isinstance(location.parent, nnx.Linear | Dense)
    if name not in _TORCH_NAMES or (name == "kernel" and not dense):
        raise ValueError(f"{location.path} trains in full, which a PEFT folder cannot hold.")
    found = []
    for index in np.ndindex(*_stack(name, value.shape, matrices)):
        part = value[index]
        part = part.T if name == "kernel" else part if name == "embedding" else part.ravel()
        found.append((index, np.ascontiguousarray(part)))
    return found
