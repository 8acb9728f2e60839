"""Adapters on disk: a folder with adapter.safetensors (what trains) and adapter.json (what it is).

The JSON holds the method of every adapted path, the identity of the base (fingerprints of its
weights, and its name if the caller gives one), free metadata, the checksum that binds it to its
tensors, and its own digest. Tensor names are "/"-joined paths; a stacked layer's tensors keep their
leading layer axes.
"""

import hashlib
import json
import os
import pathlib
import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from flax import nnx

from lorasp_jax import peft
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.dense import AdapterParam, validate
from lorasp_jax.peft import Method, to_settings
from lorasp_jax.peft._fields import short
from lorasp_jax.storage import digest

TENSORS, DESCRIPTION = "adapter.safetensors", "adapter.json"
FORMAT, VERSION = "lorasp_jax adapter", 2
FIELDS: dict[str, type] = {
    "base": str,
    "weights": dict,
    "sha256": str,
    "methods": dict,
    "metadata": dict,
}


def save_adapters(
    folder: str | os.PathLike[str],
    model: nnx.Module,
    *,
    base: str = "",
    metadata: Mapping[str, Any] | None = None,
) -> None:
    """Writes everything in a model that trains, and nothing of its frozen base.

    Each file is complete before it takes its name; an adapter already in the folder is replaced.

    Args:
      folder: made if absent.
      model: an adapted model.
      base: name of the frozen base, if it has one; its weights are known by themselves.
      metadata: anything JSON can hold.

    Raises:
      ValueError: the model has nothing that trains, or metadata that JSON would not give back.
    """
    folder, adapters = validate.folder(folder), nnx.state(validate.with_values(model), AdapterParam)
    if not isinstance(base, str):
        raise ValueError(f"base must be a text, the name of the base, got {short(base)}.")
    tensors = {name: np.asarray(leaf) for name, leaf in _named(adapters).items()}
    if not tensors:
        raise ValueError("the model has no adapters to save; of a combined one, extract one first.")
    data = safetensors.numpy.save(tensors)
    description = {
        "format": FORMAT,
        "version": VERSION,
        "base": base,
        "weights": digest.fingerprints(_frozen_weights(model)),
        "sha256": hashlib.sha256(data).hexdigest(),
        "methods": {path: to_settings(m) for path, m in adaptation.methods(model).items()},
        "metadata": _checked_metadata({} if metadata is None else metadata),
    }
    text = json.dumps(digest.with_digest(description), indent=2)
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / TENSORS, data)
    write_whole(folder / DESCRIPTION, text.encode())


def load_adapters(
    folder: str | os.PathLike[str],
    model: adaptation.Model,
    *,
    base: str | None = None,
    any_base: bool = False,
    einsums: nnx_layers.Einsums = MappingProxyType({}),
) -> adaptation.Model:
    """The model with the adapters of a folder.

    A model without adapters is adapted as the file says; one that has adapters must have the same.

    Args:
      folder: written by `save_adapters`.
      model: not modified.
      base: if given, must equal the name of the base that the adapters were saved for.
      any_base: take the adapters onto other weights, too. Otherwise each array of the base must be
        the one they were trained on, up to rounding to bf16; what is quantised on one side only, or
        lacks the part that an adapter holds, is not compared.
      einsums: those that `adapt` was given.

    Raises:
      ValueError: missing, damaged or foreign files, another base, or adapters that do not fit.
    """
    folder = validate.folder(folder)
    description, tensors = _read(folder)
    if base is not None and description["base"] != base:
        raise ValueError(
            f"{folder} was trained on base {description['base']!r}, not on {short(base)}."
        )
    wanted = _methods(description["methods"], folder)
    present = {path: method.as_saved for path, method in adaptation.methods(model).items()}
    if not present:
        model = _adapted(model, wanted, tensors, folder, einsums)
    elif present != wanted:
        differing = sorted(p for p in present | wanted if present.get(p) != wanted.get(p))
        raise ValueError(f"{folder} has other adapters than the model, first at {differing[0]!r}.")
    if not any_base:
        _check_weights(model, description["weights"], folder)
    graphdef, adapters, frozen = adaptation.split(model)
    expected = _fitting(adapters, tensors, adaptation.methods(model), folder)
    values = [jnp.asarray(tensors[name], leaf.dtype) for name, leaf in expected.items()]
    return nnx.merge(graphdef, jax.tree.unflatten(jax.tree.structure(adapters), values), frozen)


def _adapted(
    model: adaptation.Model,
    methods: Mapping[str, Method],
    tensors: Mapping[str, np.ndarray],
    folder: pathlib.Path,
    einsums: nnx_layers.Einsums,
) -> adaptation.Model:
    """The bare model with the adapters that a file lists, by exact paths.

    They are made as shapes first: what is asked for may be larger than any memory.
    """
    try:
        # A parameter trained in full may sit in a layer with an adapter: such rules go first.
        paths = sorted(methods, key=lambda path: not methods[path].trains_base)
        rules = [(f"^{re.escape(path)}$", methods[path]) for path in paths]
        adapt = lambda: adaptation.adapt(model, rules, rngs=nnx.Rngs(0), einsums=einsums)  # noqa: E731
        adapters = adaptation.split(nnx.eval_shape(adapt))[1]
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"{folder} does not fit the model: {error}") from error
    _fitting(adapters, tensors, methods, folder)
    return adapt()


def _frozen_weights(model: nnx.Module) -> dict[str, jax.Array]:
    """By path, the base's parameters that adapters leave as they are and that have values."""
    split = [path for path, method in adaptation.methods(model).items() if method.splits_kernel]
    found = _named(nnx.state(model, nnx.All(nnx.Param, nnx.Not(AdapterParam))))
    return {
        name: leaf
        for name, leaf in found.items()
        if not any(name.startswith(f"{path}/") for path in split)
        and isinstance(leaf, (jax.Array, np.ndarray))
        and not isinstance(leaf, jax.core.Tracer)
    }


def _check_weights(model: nnx.Module, saved: Mapping[str, str], folder: pathlib.Path) -> None:
    """Raises a ValueError if the base has other weights than those saved."""
    common = {n: leaf for n, leaf in _frozen_weights(model).items() if n in saved}
    found = digest.fingerprints(common)
    if others := [name for name in found if found[name] != saved[name]]:
        raise ValueError(
            f"{folder} was trained on another base: of {len(found)} arrays {len(others)} differ, "
            f"first {others[0]!r}; any_base=True takes the adapters all the same."
        )


def _fitting(
    adapters: nnx.State,
    tensors: Mapping[str, np.ndarray],
    methods: Mapping[str, Method],
    folder: pathlib.Path,
) -> dict[str, Any]:
    """The leaves of a state by name, of which each has a tensor that fits its method."""
    expected = _named(adapters)
    if differing := sorted(expected.keys() ^ tensors.keys()):
        raise ValueError(f"{folder} and the model differ in tensors, first {differing[0]!r}.")
    made, held = ({name: a.shape for name, a in of.items()} for of in (expected, tensors))
    for path, method in methods.items():
        begin = f"{path}/adapter/".lstrip("/")
        own = [name for name in made if name.startswith(begin)]
        of_made, of_held = ({n.removeprefix(begin): s[n] for n in own} for s in (made, held))
        made |= {begin + name: shape for name, shape in method.shapes(of_made, of_held).items()}
    for name, shape in made.items():
        if held[name] != shape:
            shapes = f"{held[name]} in {folder}, {shape} in the model"
            raise ValueError(f"tensor {name!r} has shape {shapes}.")
    return expected


def _named(adapters: nnx.State) -> dict[str, jax.Array]:
    """Leaves in tree order, by attribute path and place in the parameters."""
    leaves = jax.tree_util.tree_flatten_with_path(nnx.to_pure_dict(adapters))[0]
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def _methods(found: Mapping[str, Any], folder: pathlib.Path) -> dict[str, Method]:
    """The methods of a description, by path."""
    try:
        return {path: peft.from_settings(settings) for path, settings in found.items()}
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"{folder} does not fit the model: {error}") from error


def _checked_metadata(metadata: Any) -> dict[str, Any]:
    """It as a dictionary; raises a ValueError for what would be another one once it is read."""
    try:
        again = json.loads(json.dumps(metadata, allow_nan=False))
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"metadata is for JSON, which cannot hold it: {error}.") from error
    if not isinstance(metadata, Mapping) or again.keys() != metadata.keys():
        raise ValueError(f"metadata is a dictionary whose keys are texts, got {short(metadata)}.")
    return again


def write_whole(path: pathlib.Path, data: bytes) -> None:
    """Replaces a file when all is written."""
    from envs.datasets.writing import write_bytes  # here alone: envs sets a flag of XLA

    write_bytes(path, data)


def read_whole(path: pathlib.Path) -> bytes:
    """The bytes of a file.

    Raises:
      ValueError: it has more than this machine's memory.
    """
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if (size := path.stat().st_size) > memory:
        raise ValueError(f"{path} has {size} bytes, more than this machine's memory")
    return path.read_bytes()


def read_tensors(path: pathlib.Path, data: bytes) -> dict[str, np.ndarray]:
    """The tensors in a safetensors file's bytes, by name.

    Raises:
      ValueError: they are damaged, or one is not of finite floating point numbers.
    """
    try:
        tensors = dict(sorted(safetensors.numpy.load(data).items()))
    except (ValueError, KeyError, TypeError, safetensors.SafetensorError) as error:
        raise ValueError(f"{path} is damaged or no safetensors file: {error}") from error
    for name, tensor in tensors.items():
        if not jnp.issubdtype(tensor.dtype, jnp.floating):
            raise ValueError(f"{path} holds {name!r} as {tensor.dtype}, not as real numbers.")
        if not np.isfinite(tensor.astype(np.float32)).all():
            raise ValueError(f"{path} holds numbers that are not finite in {name!r}.")
    return tensors


def _read(folder: pathlib.Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The description and the tensors, checked against each other."""
    for name in (DESCRIPTION, TENSORS):
        if not (folder / name).is_file():
            raise ValueError(f"{folder} holds no {name}; an adapter is a folder with both files.")
    data = read_whole(folder / TENSORS)
    description = read_description(folder)
    if description["sha256"] != hashlib.sha256(data).hexdigest():
        raise ValueError(f"{folder / TENSORS} is damaged or belongs to another {DESCRIPTION}.")
    return description, read_tensors(folder / TENSORS, data)


def read_description(folder: pathlib.Path) -> dict[str, Any]:
    """adapter.json of a folder, as it was written.

    Raises:
      ValueError: it is missing, damaged, or of another format.
    """
    path = folder / DESCRIPTION
    try:
        found = json.loads(read_whole(path))
        known = (found["format"], found["version"]) == (FORMAT, VERSION)
        if known:
            found = digest.verify_digest(found)
            wrong = [name for name, kind in FIELDS.items() if not isinstance(found[name], kind)]
            if wrong:
                raise ValueError(f"its {wrong[0]} is {short(found[wrong[0]])}")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{path} is damaged or no adapter description ({error}).") from error
    if not known:
        raise ValueError(f"{path} is not a {FORMAT} of version {VERSION}.")
    return found
