"""Backbone weights on disk: config.json (backbone and every size) and safetensors in bf16.

Large models are cut into shards with the index that Hugging Face uses. Tensor names are "/"-joined
paths; a stacked layer's tensors keep their leading layer axis. The hash in config.json binds the
files together, sizes included, so a folder that is damaged or half written is not loaded, nor one
whose matrices would be split into other heads.
"""

import dataclasses
import hashlib
import json
import os
import pathlib
from collections.abc import Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from flax import nnx

from envs.datasets.files import check_local, read_text
from envs.datasets.writing import write_bytes
from lorasp_jax.adapters.combine.adapter_set import SetParam
from lorasp_jax.adapters.compress.quantization import is_quantized
from lorasp_jax.dense import AdapterParam
from lorasp_jax.models import backbone
from lorasp_jax.models.checkpoints.tensor_files import INDEX, SINGLE, TensorFiles, weight_files

CONFIG = "config.json"
SHARD_BYTES = 15 * 2**20
"""Largest shard, its header included; a larger tensor has a shard of its own."""
HEADER_BYTES = 2**16
"""Room for a shard's header: names, shapes and offsets of some hundred tensors."""
RUNTIME_FIELDS = ("dtype", "param_dtype", "remat", "unroll")
"""Fields of a config that say how to compute, not what the model is."""

Folder = str | os.PathLike[str]
Model = TypeVar("Model", bound=nnx.Module)


def save(folder: Folder, model: Any) -> None:
    """Write a model without adapters; one that is already in the folder is replaced.

    Args:
        folder: made if absent.
        model: a backbone, with `config`.

    Raises:
        ValueError: the model has adapters or quantised kernels, or is not as its config says; or
            the folder is a URL.
    """
    check_local(folder := pathlib.Path(folder))
    arrays = {name: a.astype(jnp.bfloat16) for name, a in base_arrays(model).items()}
    description = {
        "backbone": type(model).__module__.split(".")[-2],
        "config": _sizes(model.config),
    }
    description["sha256"] = _digest(description, arrays)
    shards = _shards(arrays)
    names = [f"model-{i + 1:05}-of-{len(shards):05}.safetensors" for i in range(len(shards))]
    names = names if len(shards) > 1 else [SINGLE]
    where = {name: file for file, shard in zip(names, shards, strict=True) for name in shard}
    files = {file: safetensors.numpy.save(shard) for file, shard in zip(names, shards, strict=True)}
    if len(shards) > 1:
        total = {"total_size": sum(array.nbytes for array in arrays.values())}
        files[INDEX] = json.dumps({"metadata": total, "weight_map": where}, indent=1).encode()
    files[CONFIG] = (json.dumps(description, indent=1) + "\n").encode()
    _write(folder, files)


def base_arrays(model: nnx.Module) -> dict[str, np.ndarray]:
    """Every parameter of a model by "/"-joined path, in its stored type.

    Raises:
        ValueError: the model has adapters or quantised kernels, or is not as its config says.
    """
    if jax.tree.leaves(nnx.state(model, (AdapterParam, SetParam))):
        raise ValueError(
            "models.save takes a model without adapters; merge them or save them alone."
        )
    if is_quantized(model):
        raise ValueError("models.save takes whole kernels: save a base before quantising it.")
    arrays = named_arrays(model)
    wanted = _shapes(named_arrays(nnx.eval_shape(lambda: model.config.create(nnx.Rngs(0)))))
    if other := sorted(wanted.items() ^ _shapes(arrays).items()):
        raise ValueError(f"the model is not as its config says: see {other[0][0]}.")
    return {name: np.asarray(leaf) for name, leaf in arrays.items()}


def _shapes(arrays: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    return {name: array.shape for name, array in arrays.items()}


def _write(folder: pathlib.Path, files: Mapping[str, bytes]) -> None:
    """Put files of a model, by name, in the place of those that are in the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for file, data in files.items():
        write_bytes(folder / file, data)
    for stale in {*folder.glob("model*.safetensors"), folder / INDEX}:
        if stale.name not in files:
            stale.unlink(missing_ok=True)


def load_native(folder: Folder, config: Any = None) -> Any:
    """A model from a folder that `save` wrote.

    Args:
        folder: where the files are.
        config: must have the sizes of the stored model; says the types to compute and to store in.
            None takes the stored sizes, in fp32.

    Raises:
        ValueError: missing, damaged or foreign files, or another model than `config`.
    """
    folder = pathlib.Path(folder)
    description = _description(folder)
    stored = _config(folder, description)
    config = config or stored
    if type(config) is not type(stored) or _sizes(config) != _sizes(stored):
        raise ValueError(f"{folder} does not fit the model: {_difference(stored, config)}.")
    arrays = TensorFiles(weight_files(folder))
    if _digest(description, arrays) != description["sha256"]:  # before the model needs the memory
        raise ValueError(f"{folder} is damaged: weights and sizes lack the hash in {CONFIG}.")
    model = nnx.eval_shape(lambda: config.create(nnx.Rngs(0)))
    try:
        model = set_arrays(model, arrays)
    except ValueError as error:
        raise ValueError(f"{folder} does not fit its {CONFIG}: {error}") from error
    return model


def load_config(folder: Folder) -> Any:
    """The config of a stored model, with its sizes and fp32.

    Raises:
        ValueError: no such folder, or a foreign one.
    """
    folder = pathlib.Path(folder)
    return _config(folder, _description(folder))


def set_arrays(model: Model, arrays: Mapping[str, Any]) -> Model:
    """A copy of a model with every parameter taken from arrays, in the model's types.

    Args:
        model: may be abstract, from `nnx.eval_shape`.
        arrays: by "/"-joined path.

    Raises:
        ValueError: missing or unexpected arrays, or other shapes.
    """
    expected = named_arrays(model)
    for problem, names in (
        ("missing", expected.keys() - arrays.keys()),
        ("unexpected", arrays.keys() - expected.keys()),
    ):
        if names:
            raise ValueError(f"{problem} arrays: {', '.join(sorted(names))}.")
    values = []
    for name, leaf in expected.items():
        array = arrays[name]  # perhaps read at this moment, so once
        if array.shape != leaf.shape:
            raise ValueError(f"{name} has shape {array.shape}, the model needs {leaf.shape}.")
        values.append(jnp.asarray(array, leaf.dtype))
        del array  # or it would stay beside the next one
    graphdef, parameters, rest = nnx.split(model, nnx.Param, ...)
    parameters = jax.tree.unflatten(jax.tree.structure(parameters), values)
    return nnx.merge(graphdef, parameters, rest)


def weights_hash(source: Folder | nnx.Module) -> str:
    """SHA-256 of a model's base weights: names, shapes and values in fp32.

    Adapters do not count, so it identifies the frozen base; a folder and the model loaded from it
    agree, whatever the type the model stores its parameters in.

    Args:
        source: a folder that `save` wrote, or a model.
    """
    if isinstance(source, nnx.Module):
        return _hash(named_arrays(source, adapters=False))
    folder = pathlib.Path(source)
    _description(folder)
    return _hash(TensorFiles(weight_files(folder)))


def named_arrays(model: nnx.Module, adapters: bool = True) -> dict[str, Any]:
    """Parameters in tree order by "/"-joined path."""
    state = nnx.state(model, nnx.Param if adapters else nnx.All(nnx.Param, nnx.Not(AdapterParam)))
    return by_path(nnx.to_pure_dict(state))


def by_path(tree: Any) -> dict[str, Any]:
    """Leaves of a tree by "/"-joined path, in its order."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def _digest(description: Mapping[str, Any], arrays: Mapping[str, Any]) -> str:
    """SHA-256 of what a folder holds: the backbone's name, every size, and the weights."""
    said = json.dumps([description["backbone"], description["config"]], sort_keys=True)
    return hashlib.sha256(f"{said}{_hash(arrays)}".encode()).hexdigest()


def _hash(arrays: Mapping[str, Any]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        values = np.asarray(arrays[name]).astype(np.float32)
        digest.update(f"{name}{values.shape}".encode())
        digest.update(np.ascontiguousarray(values).data)
        del values  # or it would stay beside the next one
    return digest.hexdigest()


def _shards(arrays: Mapping[str, np.ndarray]) -> list[dict[str, np.ndarray]]:
    """The arrays in order, cut where a shard would grow past its limit."""
    shards: list[dict[str, np.ndarray]] = [{}]
    room = SHARD_BYTES - HEADER_BYTES
    for name, array in arrays.items():
        if shards[-1] and array.nbytes > room:
            shards.append({})
            room = SHARD_BYTES - HEADER_BYTES
        shards[-1][name] = array
        room -= array.nbytes
    return shards


def _sizes(config: Any) -> dict[str, Any]:
    """A config as JSON gives it back, without the fields that only say how to compute."""
    fields = json.loads(json.dumps(dataclasses.asdict(config)))
    return {name: value for name, value in fields.items() if name not in RUNTIME_FIELDS}


def _difference(stored: Any, wanted: Any) -> str:
    a, b = _sizes(stored), _sizes(wanted)
    pairs = [f"{k} is {a.get(k)}, not {b.get(k)}" for k in sorted(a | b) if a.get(k) != b.get(k)]
    return "; ".join(pairs) or f"it is a {type(stored).__name__}"


def _description(folder: pathlib.Path) -> dict[str, Any]:
    foreign = f"{folder / CONFIG} is damaged or was not written by this project."
    try:
        found = json.loads(read_text(folder / CONFIG))
        valid = isinstance(found["config"], dict) and isinstance(found["sha256"], str)
    except FileNotFoundError as error:
        raise ValueError(f"{folder} holds no model: there is no {CONFIG}.") from error
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(foreign) from error
    if not valid:
        raise ValueError(foreign)
    return found


def _config(folder: pathlib.Path, description: Mapping[str, Any]) -> Any:
    try:
        return backbone.find(description["backbone"]).from_dict(description["config"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{folder / CONFIG} describes no backbone of this version.") from error
