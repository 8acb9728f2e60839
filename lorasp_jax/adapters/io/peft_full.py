"""Fully trained biases and modules in Hugging Face PEFT folders.

With `bias` "all" or "lora_only", PEFT trains biases. It stores them as <module>.base_layer.bias for
adapted layers and as <module>.bias for others. `modules_to_save` makes whole modules trainable.
Weights are stored in torch's layout, `[out, in]` for a dense layer.
"""

import math
import pathlib
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np
from flax import nnx

from lorasp_jax.adapters import paths
from lorasp_jax.adapters.io.peft_folders import (
    PREFIX,
    Adapter,
    FullTensors,
    PeftFolder,
    from_torch,
    is_saved,
)
from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.dense import AdapterParam, Dense
from lorasp_jax.peft.fields import short

Names = Callable[[str, tuple[int, ...]], str]
_TORCH_NAMES = {"kernel": "weight", "embedding": "weight", "scale": "weight", "bias": "bias"}
# Number of axes of a parameter outside dense layers and einsums; additional axes are stack axes.
_AXES = {"embedding": 2, "scale": 1, "bias": 1}


def base_parameters(
    folder: pathlib.Path,
    contents: PeftFolder,
    shapes: Mapping[str, Sequence[int]],
    sizes: Mapping[str, Sequence[int]],
    names: Names,
) -> tuple[Adapter, Adapter]:
    """A folder's fully trained and its frozen parameters, by path, in the model's layout.

    Args:
        folder: its path.
        contents: of the folder.
        shapes: `[..., I, O]` of the kernel matrices of the model's layers, by path.
        sizes: shapes of the model's parameters by path.
        names: as for `load_peft`.

    Raises:
        ValueError: the model lacks a parameter or has a different shape, or the folder covers only
            some layers of a stack.
    """
    trained, frozen, unused = {}, {}, contents.base | contents.trained
    for path, size in sizes.items() if unused else ():
        module, _, name = path.rpartition("/")
        if not (kind := _TORCH_NAMES.get(name)):
            continue
        leading = _stack(name, size, shapes.get(module))
        keys = [(names(module, index), kind) for index in np.ndindex(*leading)]
        found = [key for key in keys if key in unused]
        if not found:
            continue
        if len(found) < len(keys):
            raise ValueError(f"{folder} has the {kind} of only some layers of {module}")
        shape = tuple(size[len(leading) :])
        with paths.naming("load", folder):
            parts = [_from_torch(path, unused.pop(key), shape) for key in keys]
        is_trained = not contents.trained.keys().isdisjoint(keys)
        (trained if is_trained else frozen)[path] = np.stack(parts).reshape(tuple(size))
    # PEFT also stores an output layer that is tied to the embedding, which the model may not have.
    read = [value for key, value in contents.base.items() if key not in unused]
    for key, value in unused.items():
        if key in contents.trained or not any(np.array_equal(value, other) for other in read):
            raise ValueError(f"{folder} has the {key[1]} of {short(key[0])}, which the model lacks")
    return trained, frozen


def _from_torch(path: str, value: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Convert one layer's parameter; raise ValueError unless it has the model's shape."""
    name = path.rpartition("/")[2]
    if name == "kernel" and value.ndim > 1:
        value = from_torch(value)
    elif name in ("scale", "bias") and value.size == math.prod(shape):
        value = value.reshape(shape)  # ours may have head axes
    if value.shape != shape:
        raise ValueError(f"{path} must have shape {shape}, as in the model, got {value.shape}")
    return value


def check_biases(
    folder: pathlib.Path,
    bias: str,
    full: FullTensors,
    parameter_paths: Collection[str],
    adapted: Collection[str],
) -> None:
    """Raise ValueError if the folder has no biases, but its config says that some were trained.

    `bias` is the config's "none", "all" or "lora_only"; `adapted` are the paths of adapted layers.
    """
    modules = [
        path.rpartition("/")[0] for path in parameter_paths if path.rpartition("/")[2] == "bias"
    ]
    trained = modules if bias == "all" else set(modules) & set(adapted)
    if bias != "none" and trained and not any(kind == "bias" for _, kind in full):
        raise ValueError(f"{folder} was trained with bias {bias!r}, but has no bias tensors")


def check_saved(
    folder: pathlib.Path, entries: Sequence[str], full: FullTensors, modules: Collection[str]
) -> None:
    """Raise ValueError if the folder lacks a module of the model that `modules_to_save` names."""
    for entry in entries:
        lost = [name for name in modules if is_saved([entry], name)]
        if lost and not any(is_saved([entry], name) for name, _ in full):
            raise ValueError(f"{folder} lacks {short(lost[0])}, which is in its modules_to_save")


def export_full_parameters(
    model: nnx.Module, adapted: Collection[str], names: Names
) -> tuple[Adapter, dict[str, Any]]:
    """A model's fully trained parameters by PEFT name, and the PEFT config fields about them.

    Raises:
        ValueError: PEFT cannot store a parameter.
    """
    locations = [p for p in paths.locate(nnx.List([model]), nnx.Param) if p.name != "adapter"]
    trainable = [location for location in locations if isinstance(location.child, AdapterParam)]
    saved = {_module(location) for location in trainable if location.name != "bias"}
    biases = {_module(location) for location in trainable} - saved
    matmul_layers = paths.locate_matmul_layers(nnx.List([model]))
    shapes = {
        location.path: nnx_layers.matrices_shape(location.child, {}) for location in matmul_layers
    }
    tensors: Adapter = {}
    for location in locations:
        module = _module(location)
        if module in saved or location in trainable:
            infix = ".base_layer" if module in adapted else ""
            for index, value in _parts(location, shapes.get(module)):
                name = f"{names(module, index)}{infix}.{_TORCH_NAMES[location.name]}"
                tensors[PREFIX + name] = value
    stems = {name.removeprefix(PREFIX).rpartition(".")[0] for name in tensors}
    saved_modules = sorted(stem for stem in stems if f"{PREFIX}{stem}.weight" in tensors)
    bias = "none" if not biases else "lora_only" if biases <= set(adapted) else "all"
    return tensors, {"bias": bias, "modules_to_save": saved_modules or None}


def _module(location: paths.Location) -> str:
    return location.path.rpartition("/")[0]


def _stack(name: str, size: Sequence[int], matrices: Sequence[int] | None) -> tuple[int, ...]:
    """Sizes of the leading stack axes of a parameter.

    `size` is the parameter's shape. `matrices` is the shape `[..., I, O]` of its layer's kernel
    matrices, or None if the layer is neither dense nor an einsum.
    """
    if matrices is not None:
        return tuple(matrices[:-2])
    return tuple(size[: -_AXES[name]]) if name in _AXES else ()


def _parts(
    location: paths.Location, matrices: Sequence[int] | None
) -> list[tuple[tuple[int, ...], np.ndarray]]:
    """Index and value, in torch's layout, of each layer of a stacked parameter."""
    name = location.name
    dense = isinstance(location.parent, nnx.Linear | Dense)
    if name not in _TORCH_NAMES or (name == "kernel" and not dense):
        raise ValueError(f"{location.path} is fully trained, but PEFT cannot store it")
    value, parts = np.asarray(location.child.get_value(), np.float32), []
    for index in np.ndindex(*_stack(name, value.shape, matrices)):
        part = value[index]
        part = part.T if name == "kernel" else part if name == "embedding" else part.ravel()
        parts.append((index, np.ascontiguousarray(part)))
    return parts
