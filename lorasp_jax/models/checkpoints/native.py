"""Save and load backbone weights: config.json and safetensors in bf16.

Large models are split into shards with Hugging Face's index. Tensor names are "/"-joined paths;
stacked layers keep their leading layer axis. config.json contains the backbone's name and sizes,
and a hash of config and weights. Loading checks the hash and so rejects damaged, half-written or
edited folders.
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

from lorasp_jax.adapters.combine.adapter_set import AdapterSetParam
from lorasp_jax.adapters.compress.quantization import is_quantized
from lorasp_jax.adapters.paths import by_path
from lorasp_jax.base import json_values
from lorasp_jax.base.files import as_value_error, check_local, read_json
from lorasp_jax.base.writing import write_bytes
from lorasp_jax.dense import AdapterParam
from lorasp_jax.models import backbone
from lorasp_jax.models.checkpoints.tensor_files import INDEX, TensorFiles, weight_files
from lorasp_jax.models.noise_actor import PATH

CONFIG = "config.json"
SHARD_BYTES = 15 * 2**20 - 2**16
"""Maximum size of a shard's arrays, so that the file has at most 15 MiB with its header. A larger
array gets its own shard."""
RUNTIME_FIELDS = ("dtype", "param_dtype", "remat", "unroll")
"""Config fields that affect how a model runs, but not its architecture."""
LENGTHS = ("max_tokens", "chunk")
"""Numbers of tokens, on which no parameter depends; they are saved as the model's defaults."""

Folder = str | os.PathLike[str]
Model = TypeVar("Model", bound=nnx.Module)


def save(folder: Folder, model: Any) -> None:
    """Save a backbone without adapters, replacing any model in the folder.

    Raises:
        ValueError: the model has adapters or quantized kernels, or the folder is a URL.
    """
    check_local(folder := pathlib.Path(folder))
    import huggingface_hub

    arrays = {name: a.astype(jnp.bfloat16) for name, a in base_arrays(model).items()}
    description = {
        "backbone": type(model).__module__.split(".")[-2],
        "config": _saved_fields(model.config),
    }
    description["sha256"] = _digest(description, arrays)
    split = huggingface_hub.split_state_dict_into_shards_factory(
        arrays,
        get_storage_size=lambda array: array.nbytes,
        filename_pattern="model{suffix}.safetensors",
        max_shard_size=SHARD_BYTES,
    )
    files = {
        file: safetensors.numpy.save({name: arrays[name] for name in names})
        for file, names in split.filename_to_tensors.items()
    }
    if split.is_sharded:
        index = {"metadata": split.metadata, "weight_map": split.tensor_to_filename}
        files[INDEX] = json.dumps(index, indent=1).encode()
    files[CONFIG] = (json.dumps(description, indent=1) + "\n").encode()
    folder.mkdir(parents=True, exist_ok=True)
    for file, data in files.items():
        write_bytes(folder / file, data)
    for stale in {*folder.glob("model*.safetensors"), folder / INDEX}:
        if stale.name not in files:
            stale.unlink(missing_ok=True)


def base_arrays(model: nnx.Module) -> dict[str, np.ndarray]:
    """Return every parameter of a model by "/"-joined path, in its own dtype.

    Raises:
        ValueError: the model has adapters, quantized kernels, or an actor of its noise.
    """
    if jax.tree.leaves(nnx.state(model, (AdapterParam, AdapterSetParam))):
        raise ValueError("saving needs a model without adapters: merge them or save them apart")
    if is_quantized(model):
        raise ValueError("saving needs unquantized kernels: save the base before quantizing")
    if getattr(model, PATH, None) is not None:
        raise ValueError("saving needs a model that has not learned its initial noise")
    return {name: np.asarray(leaf) for name, leaf in named_arrays(model).items()}


def load_native(folder: Folder, config: Any = None) -> Any:
    """Load a model that `save` wrote.

    Args:
        folder: folder with config.json and safetensors.
        config: sets the `RUNTIME_FIELDS`, the `LENGTHS` and which actions are relative; its other
            fields must match the stored model. None uses the stored config, in fp32.

    Raises:
        ValueError: files are missing, damaged or in another format, or do not match `config`.
    """
    folder = pathlib.Path(folder)
    description = _description(folder)
    stored = _config(folder, description)
    config = config or stored
    if type(config) is not type(stored) or _sizes(config) != _sizes(stored):
        raise ValueError(f"{folder} does not match the config: {_difference(stored, config)}")
    arrays = TensorFiles(weight_files(folder))
    if _digest(description, arrays) != description["sha256"]:  # before allocating the model
        raise ValueError(f"{folder} is damaged: weights and config do not match their hash")
    return set_arrays(nnx.eval_shape(lambda: config.create(nnx.Rngs(0))), arrays)


def load_config(folder: Folder) -> Any:
    """Read the config of a stored model; `RUNTIME_FIELDS` have their defaults (fp32).

    Raises:
        ValueError: the folder is missing or not in this project's format.
    """
    folder = pathlib.Path(folder)
    return _config(folder, _description(folder))


def set_arrays(model: Model, arrays: Mapping[str, Any]) -> Model:
    """Return a copy of a model with every parameter replaced, cast to the model's dtypes.

    Args:
        model: may be abstract, from `nnx.eval_shape`.
        arrays: the new values by "/"-joined path.

    Raises:
        ValueError: missing, unexpected or wrongly shaped arrays.
    """
    expected = named_arrays(model)
    for problem, names in (
        ("missing", expected.keys() - arrays.keys()),
        ("unexpected", arrays.keys() - expected.keys()),
    ):
        if names:
            raise ValueError(f"{problem} arrays: {', '.join(sorted(names))}")
    values = []
    for name, leaf in expected.items():
        array = arrays[name]  # may read from disk, so access it once
        if array.shape != leaf.shape:
            raise ValueError(f"{name} must have shape {leaf.shape}, got {array.shape}")
        values.append(jnp.asarray(array, leaf.dtype))
        del array  # free it before reading the next one
    graphdef, parameters, rest = nnx.split(model, nnx.Param, ...)
    parameters = jax.tree.unflatten(jax.tree.structure(parameters), values)
    return nnx.merge(graphdef, parameters, rest)


def weights_hash(source: Folder | nnx.Module) -> str:
    """Return the SHA-256 of a model's frozen parameters: names, shapes and values in fp32.

    A folder and the model loaded from it have the same hash, in bf16 and in fp32. Adding adapters
    with `adapt` keeps the hash, unless `adapt` splits kernels or makes base weights trainable (full
    fine-tuning). `quantize` changes the hash, and so does `combine`, which adds frozen adapters.

    Args:
        source: a folder that `save` wrote, or a model.
    """
    if isinstance(source, nnx.Module):
        return _hash(named_arrays(source, adapters=False))
    folder = pathlib.Path(source)
    _description(folder)
    return _hash(TensorFiles(weight_files(folder)))


def named_arrays(model: nnx.Module, adapters: bool = True) -> dict[str, Any]:
    """Return parameters by "/"-joined path, in tree order; only frozen ones unless `adapters`."""
    state = nnx.state(model, nnx.Param if adapters else nnx.All(nnx.Param, nnx.Not(AdapterParam)))
    return by_path(state)


def _digest(description: Mapping[str, Any], arrays: Mapping[str, Any]) -> str:
    """SHA-256 of backbone name, config and weights."""
    text = json.dumps([description["backbone"], description["config"]], sort_keys=True)
    return hashlib.sha256(f"{text}{_hash(arrays)}".encode()).hexdigest()


def _hash(arrays: Mapping[str, Any]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        values = np.asarray(arrays[name]).astype(np.float32)
        digest.update(f"{name}{values.shape}".encode())
        digest.update(np.ascontiguousarray(values).data)
        del values  # free it before reading the next one
    return digest.hexdigest()


def _saved_fields(config: Any) -> dict[str, Any]:
    """A config's fields after a JSON round trip, without `RUNTIME_FIELDS`."""
    fields = json.loads(json.dumps(dataclasses.asdict(config)))
    return {name: value for name, value in fields.items() if name not in RUNTIME_FIELDS}


def _sizes(config: Any) -> dict[str, Any]:
    """The saved fields that must match for weights to fit and to mean the same.

    Which actions are relative is a matter of the robot, not of the weights.
    """
    fields = _saved_fields(config)
    del fields["inputs"]["delta"]
    return {name: value for name, value in fields.items() if name not in LENGTHS}


def _difference(stored: Any, config: Any) -> str:
    a, b = _sizes(stored), _sizes(config)
    different = (k for k in sorted(a | b) if a.get(k) != b.get(k))
    pairs = [f"{k} is {a.get(k)} in the folder, {b.get(k)} in the config" for k in different]
    return "; ".join(pairs) or f"the stored model is a {type(stored).__name__}"


def _description(folder: pathlib.Path) -> dict[str, Any]:
    with as_value_error(folder / CONFIG):
        description = read_json(folder / CONFIG)
        json_values.check(description, {"backbone": str, "config": {}, "sha256": str})
    return description


def _config(folder: pathlib.Path, description: Mapping[str, Any]) -> Any:
    with as_value_error(folder / CONFIG):
        return backbone.find(description["backbone"]).from_dict(description["config"])
