"""Save and load adapters: a folder with adapter.safetensors (tensors) and adapter.json (metadata).

The JSON contains the method of every adapted path, fingerprints and an optional name of the base,
user metadata, a checksum of the tensor file, and a digest of the JSON itself. Tensor names are
"/"-joined paths; tensors of stacked layers keep their leading layer axes.
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
from lorasp_jax.base import digest
from lorasp_jax.dense import AdapterParam, validate
from lorasp_jax.peft import Method, to_settings
from lorasp_jax.peft.fields import short

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
    """Save a model's trainable parameters, without the frozen base.

    Each file is written atomically.

    Args:
      folder: created if absent; an adapter in it is replaced.
      model: an adapted model.
      base: optional name of the base, in addition to the fingerprints of its weights.
      metadata: any JSON-serializable dict with str keys.

    Raises:
      ValueError: the model has no trainable parameters, or metadata does not round-trip through
        JSON.
    """
    folder, adapters = validate.folder(folder), nnx.state(validate.with_values(model), AdapterParam)
    if not isinstance(base, str):
        raise ValueError(f"base must be the base model's name (str), got {short(base)}")
    tensors = {name: np.asarray(leaf) for name, leaf in _leaves_by_name(adapters).items()}
    if not tensors:
        raise ValueError(
            "the model has no adapters to save; for a combined model, extract one first"
        )
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
    write_atomic(folder / TENSORS, data)
    write_atomic(folder / DESCRIPTION, text.encode())


def load_adapters(
    folder: str | os.PathLike[str],
    model: adaptation.Model,
    *,
    base: str | None = None,
    any_base: bool = False,
    einsums: nnx_layers.Einsums = MappingProxyType({}),
) -> adaptation.Model:
    """Load the adapters of a folder into a model.

    A model without adapters is first adapted as saved. An adapted model must have the same methods
    at the same paths.

    Args:
      folder: written by `save_adapters`.
      model: not modified.
      base: if given, must equal the name that was saved.
      any_base: whether to skip the base check. By default, every base array must match the one used
        in training, up to bf16 rounding. An array is not compared if only one of the two is
        quantized, or if an adapter split it.
      einsums: as passed to `adapt`.

    Raises:
      ValueError: files are missing, damaged or do not belong together, the base differs, or the
        adapters do not fit the model.
    """
    folder = validate.folder(folder)
    description, tensors = _read(folder)
    if base is not None and description["base"] != base:
        raise ValueError(
            f"the adapter in {folder} was trained on base {description['base']!r}, not on "
            f"{short(base)}"
        )
    saved_methods = _methods(description["methods"], folder)
    model_methods = {path: method.as_saved for path, method in adaptation.methods(model).items()}
    if not model_methods:
        model = _adapt_as_saved(model, saved_methods, tensors, folder, einsums)
    elif model_methods != saved_methods:
        different = sorted(
            p for p in model_methods | saved_methods if model_methods.get(p) != saved_methods.get(p)
        )
        raise ValueError(
            f"{folder} and the model have different adapters, first at {different[0]!r}"
        )
    if not any_base:
        _check_weights(model, description["weights"], folder)
    graphdef, adapters, frozen = adaptation.split(model)
    expected = _matched_leaves(adapters, tensors, adaptation.methods(model), folder)
    values = [jnp.asarray(tensors[name], leaf.dtype) for name, leaf in expected.items()]
    return nnx.merge(graphdef, jax.tree.unflatten(jax.tree.structure(adapters), values), frozen)


def _adapt_as_saved(
    model: adaptation.Model,
    methods: Mapping[str, Method],
    tensors: Mapping[str, np.ndarray],
    folder: pathlib.Path,
    einsums: nnx_layers.Einsums,
) -> adaptation.Model:
    """Adapt the bare model with the methods of a file, by exact paths.

    Shapes are checked first, since a damaged or malicious file could request too much memory.
    """
    try:
        # FullFineTuning first, since an adapted layer may have fully fine-tuned parameters.
        paths = sorted(methods, key=lambda path: not methods[path].trains_base)
        rules = [(f"^{re.escape(path)}$", methods[path]) for path in paths]
        adapt = lambda: adaptation.adapt(model, rules, rngs=nnx.Rngs(0), einsums=einsums)  # noqa: E731
        adapters = adaptation.split(nnx.eval_shape(adapt))[1]
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"{folder} does not fit the model: {error}") from error
    _matched_leaves(adapters, tensors, methods, folder)
    return adapt()


def _frozen_weights(model: nnx.Module) -> dict[str, jax.Array]:
    """Base parameters that have values, by path, except those split by an adapter."""
    split = [path for path, method in adaptation.methods(model).items() if method.splits_kernel]
    leaves = _leaves_by_name(nnx.state(model, nnx.All(nnx.Param, nnx.Not(AdapterParam))))
    return {
        name: leaf
        for name, leaf in leaves.items()
        if not any(name.startswith(f"{path}/") for path in split)
        and isinstance(leaf, (jax.Array, np.ndarray))
        and not isinstance(leaf, jax.core.Tracer)
    }


def _check_weights(model: nnx.Module, saved: Mapping[str, str], folder: pathlib.Path) -> None:
    """Raise ValueError if a base weight differs from the saved fingerprint."""
    common = {n: leaf for n, leaf in _frozen_weights(model).items() if n in saved}
    fingerprints = digest.fingerprints(common)
    if changed := [name for name in fingerprints if fingerprints[name] != saved[name]]:
        raise ValueError(
            f"the adapter in {folder} was trained on a different base: {len(changed)} of "
            f"{len(fingerprints)} arrays differ, first {changed[0]!r}; pass any_base=True to load "
            "it anyway"
        )


def _matched_leaves(
    adapters: nnx.State,
    tensors: Mapping[str, np.ndarray],
    methods: Mapping[str, Method],
    folder: pathlib.Path,
) -> dict[str, Any]:
    """Leaves of the adapters by name; raise ValueError if names or shapes of tensors differ."""
    leaves = _leaves_by_name(adapters)
    if different := sorted(leaves.keys() ^ tensors.keys()):
        raise ValueError(f"{folder} and the model have different tensors, first {different[0]!r}")
    expected = {name: leaf.shape for name, leaf in leaves.items()}
    saved = {name: tensor.shape for name, tensor in tensors.items()}
    for path, method in methods.items():
        prefix = f"{path}/adapter/".lstrip("/")
        names = [name for name in expected if name.startswith(prefix)]
        shapes = method.shapes(
            {name.removeprefix(prefix): expected[name] for name in names},
            {name.removeprefix(prefix): saved[name] for name in names},
        )
        expected |= {prefix + name: shape for name, shape in shapes.items()}
    for name, shape in expected.items():
        if saved[name] != shape:
            raise ValueError(
                f"tensor {name!r} has shape {saved[name]} in {folder}, but {shape} in the model"
            )
    return leaves


def _leaves_by_name(adapters: nnx.State) -> dict[str, jax.Array]:
    """Leaves by path, in tree order."""
    leaves = jax.tree_util.tree_flatten_with_path(nnx.to_pure_dict(adapters))[0]
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def _methods(saved: Mapping[str, Any], folder: pathlib.Path) -> dict[str, Method]:
    try:
        return {path: peft.from_settings(settings) for path, settings in saved.items()}
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"{folder} has invalid adapter settings: {error}") from error


def _checked_metadata(metadata: Any) -> dict[str, Any]:
    """Return metadata as a dict; raise ValueError if it does not round-trip through JSON."""
    try:
        restored = json.loads(json.dumps(metadata, allow_nan=False))
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"metadata is not JSON-serializable: {error}") from error
    if not isinstance(metadata, Mapping) or restored.keys() != metadata.keys():
        raise ValueError(f"metadata must be a dict with str keys, got {short(metadata)}")
    return restored


def write_atomic(path: pathlib.Path, data: bytes) -> None:
    """Write a file atomically, replacing an existing one."""
    from lorasp_jax.base.writing import write_bytes  # imported here because envs sets an XLA flag

    write_bytes(path, data)


def read_bytes(path: pathlib.Path) -> bytes:
    """Read a file.

    Raises:
      ValueError: the file is larger than this machine's memory.
    """
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if (size := path.stat().st_size) > memory:
        raise ValueError(f"{path} has {size} bytes, more than this machine's memory")
    return path.read_bytes()


def read_tensors(path: pathlib.Path, data: bytes) -> dict[str, np.ndarray]:
    """Decode the content of a safetensors file into tensors by name.

    `path` is only for error messages.

    Raises:
      ValueError: the file is damaged, or a tensor is not floating-point or not finite.
    """
    try:
        tensors = dict(sorted(safetensors.numpy.load(data).items()))
    except (ValueError, KeyError, TypeError, safetensors.SafetensorError) as error:
        raise ValueError(f"{path} is damaged or not a safetensors file: {error}") from error
    for name, tensor in tensors.items():
        if not jnp.issubdtype(tensor.dtype, jnp.floating):
            raise ValueError(f"tensor {name!r} in {path} is {tensor.dtype}, not floating point")
        if not np.isfinite(tensor.astype(np.float32)).all():
            raise ValueError(f"tensor {name!r} in {path} has non-finite values")
    return tensors


def _read(folder: pathlib.Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read and verify the description and the tensors."""
    for name in (DESCRIPTION, TENSORS):
        if not (folder / name).is_file():
            raise ValueError(
                f"{folder} has no {name}; an adapter folder needs {DESCRIPTION} and {TENSORS}"
            )
    data = read_bytes(folder / TENSORS)
    description = read_description(folder)
    if description["sha256"] != hashlib.sha256(data).hexdigest():
        raise ValueError(f"{folder / TENSORS} is damaged, or does not belong to {DESCRIPTION}")
    return description, read_tensors(folder / TENSORS, data)


def read_description(folder: pathlib.Path) -> dict[str, Any]:
    """Read the adapter.json in a folder.

    Raises:
      ValueError: the file is missing, damaged, or of an unsupported format or version.
    """
    path = folder / DESCRIPTION
    try:
        description = json.loads(read_bytes(path))
        supported = (description["format"], description["version"]) == (FORMAT, VERSION)
        if supported:
            description = digest.verify_digest(description)
            wrong = [
                name for name, kind in FIELDS.items() if not isinstance(description[name], kind)
            ]
            if wrong:
                field = wrong[0]
                kind = FIELDS[field].__name__
                raise ValueError(f"{field} must be a {kind}, got {short(description[field])}")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{path} is damaged or not an adapter description: {error}") from error
    if not supported:
        raise ValueError(f"{path} is not a {FORMAT} of version {VERSION}")
    return description
