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
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from flax import nnx

from lorasp_jax import peft
from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.base import digest, json_values
from lorasp_jax.base.files import (
    RefusedError,
    as_value_error,
    check_memory,
    check_regular,
    read_json,
)
from lorasp_jax.base.writing import write_bytes, write_text
from lorasp_jax.dense import AdapterParam, validate
from lorasp_jax.peft import Method, to_settings

TENSORS, DESCRIPTION = "adapter.safetensors", "adapter.json"
FORMAT, VERSION = "lorasp_jax adapter", 2
FIELDS: dict[str, Any] = {
    "base": str,
    "weights": {str: str},
    "sha256": str,
    "methods": {str: {}},
    "metadata": {},
}
"""Schema of the JSON, see `json_values.check`."""
_FLOATS = {
    "F64": np.float64,
    "F32": np.float32,
    "F16": np.float16,
    "BF16": jnp.bfloat16,
    "F8_E4M3": jnp.float8_e4m3fn,
    "F8_E5M2": jnp.float8_e5m2,
}
"""Floating-point types of safetensors files."""


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
        ValueError: the model has no trainable parameters, or metadata has a number that is not
            finite.
        TypeError: metadata is not JSON-serializable.
    """
    folder, adapters = validate.folder(folder), nnx.state(validate.with_values(model), AdapterParam)
    tensors = {name: np.asarray(leaf) for name, leaf in paths.by_path(adapters).items()}
    if not tensors:
        raise ValueError("the model has no adapters; of a combined model, extract one first")
    data = safetensors.numpy.save(tensors)
    description = {
        "format": FORMAT,
        "version": VERSION,
        "base": base,
        "weights": digest.fingerprints(_frozen_weights(model)),
        "sha256": hashlib.sha256(data).hexdigest(),
        "methods": {path: to_settings(m) for path, m in adaptation.methods(model).items()},
        "metadata": dict(metadata or {}),
    }
    json_values.check(description, FIELDS)
    text = json.dumps(digest.with_digest(description), indent=2, allow_nan=False)
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(folder / TENSORS, data)
    write_text(folder / DESCRIPTION, text)


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
        any_base: whether to skip the base check. By default, every base array must match the one
            used in training, up to bf16 rounding. An array is not compared if only one of the two
            is quantized, or if an adapter split it.
        einsums: as passed to `adapt`.

    Raises:
        ValueError: files are missing, damaged or do not belong together, the base differs, or the
            adapters do not fit the model.
    """
    folder = validate.folder(folder)
    description, saved_methods, tensors = _read(folder)
    if base is not None and description["base"] != base:
        raise ValueError(f"{folder} was trained on base {description['base']!r}, not {base!r}")
    model_methods = {path: method.as_saved for path, method in adaptation.methods(model).items()}
    if not model_methods:
        model = _adapt_as_saved(model, saved_methods, tensors, folder, einsums)
    elif model_methods != saved_methods:
        different = sorted(
            p for p in model_methods | saved_methods if model_methods.get(p) != saved_methods.get(p)
        )
        raise ValueError(f"{folder} and the model have different adapters at {different[0]!r}")
    if not any_base:
        common = {n: w for n, w in _frozen_weights(model).items() if n in description["weights"]}
        _check_weights(digest.fingerprints(common), description["weights"], folder)
    graphdef, adapters, frozen = adaptation.split(model)
    expected = _matched_leaves(adapters, tensors, adaptation.methods(model), folder)
    values = [jnp.asarray(tensors[name], leaf.dtype) for name, leaf in expected.items()]
    return nnx.merge(graphdef, jax.tree.unflatten(jax.tree.structure(adapters), values), frozen)


def read_adapters(
    folder: str | os.PathLike[str],
    adapted: Callable[[Mapping[str, Method]], nnx.Module],
    fingerprints: Mapping[str, str],
    *,
    any_base: bool = False,
) -> tuple[dict[str, Method], dict[str, np.ndarray]]:
    """Read the adapters of a folder for a model whose weights are not at hand.

    Args:
        folder: written by `save_adapters`.
        adapted: returns `abstract_adapted` of the model.
        fingerprints: from `base_fingerprints` of the model with its weights.
        any_base: whether to skip the base check; see `load_adapters`.

    Returns:
        The method of each adapted path, and the adapters' tensors by name.

    Raises:
        ValueError: as for `load_adapters`; the folder has no fingerprints of its base; or a method
            splits kernels, which needs their values.
    """
    folder = validate.folder(folder)
    description, methods, tensors = _read(folder)
    if split := [path for path, method in methods.items() if method.splits_kernel]:
        raise ValueError(f"{folder} splits the kernel {split[0]}, so it cannot share a base")
    if not any_base:
        if not description["weights"].keys() & fingerprints.keys():
            raise ValueError(f"{folder} has no fingerprints of its base; any_base=True loads it")
        _check_weights(fingerprints, description["weights"], folder)
    expected = _fitting_leaves(lambda: adapted(methods), methods, tensors, folder)
    return methods, {n: np.asarray(tensors[n], leaf.dtype) for n, leaf in expected.items()}


def base_fingerprints(model: nnx.Module) -> dict[str, str]:
    """Return the fingerprints of a base's weights, as `save_adapters` records them."""
    return digest.fingerprints(_frozen_weights(model))


def _read(
    folder: pathlib.Path,
) -> tuple[dict[str, Any], dict[str, Method], dict[str, np.ndarray]]:
    """Return what a folder says of its adapters, their methods and tensors."""
    description = read_description(folder)
    data, tensors = read_tensors(folder / TENSORS)
    if description["sha256"] != hashlib.sha256(data).hexdigest():
        raise ValueError(f"{folder / TENSORS} is damaged, or does not belong to {DESCRIPTION}")
    with paths.naming("load the methods in", folder):
        methods = {p: peft.from_settings(s) for p, s in description["methods"].items()}
    return description, methods, tensors


def abstract_adapted(
    model: adaptation.Model,
    methods: Mapping[str, Method],
    einsums: nnx_layers.Einsums = MappingProxyType({}),
) -> adaptation.Model:
    """Return the shapes of a bare model, itself of values or shapes, adapted by exact paths."""
    graphdef, state = nnx.split(model)
    adapt = lambda state: _adapted(nnx.merge(graphdef, state), methods, einsums)  # noqa: E731
    return nnx.eval_shape(adapt, state)


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
    adapted = lambda: abstract_adapted(model, methods, einsums)  # noqa: E731
    _fitting_leaves(adapted, methods, tensors, folder)
    return _adapted(model, methods, einsums)


def _fitting_leaves(
    adapted: Callable[[], nnx.Module],
    methods: Mapping[str, Method],
    tensors: Mapping[str, np.ndarray],
    folder: pathlib.Path,
) -> dict[str, Any]:
    """Return `_matched_leaves` of the shapes of the adapted model."""
    with paths.naming("fit to the model the adapters in", folder):
        adapters = adaptation.split(adapted())[1]
    return _matched_leaves(adapters, tensors, methods, folder)


def _adapted(
    model: adaptation.Model, methods: Mapping[str, Method], einsums: nnx_layers.Einsums
) -> adaptation.Model:
    # FullFineTuning first, since an adapted layer may have fully fine-tuned parameters.
    order = sorted(methods, key=lambda path: not methods[path].trains_base)
    rules = [(f"^{re.escape(path)}$", methods[path]) for path in order]
    return adaptation.adapt(model, rules, rngs=nnx.Rngs(0), einsums=einsums)


def _frozen_weights(model: nnx.Module) -> dict[str, Any]:
    """Base parameters that have values, by path, except those split by an adapter."""
    split = [path for path, method in adaptation.methods(model).items() if method.splits_kernel]
    leaves = paths.by_path(nnx.state(model, nnx.All(nnx.Param, nnx.Not(AdapterParam))))
    return {
        name: leaf
        for name, leaf in leaves.items()
        if not any(name.startswith(f"{path}/") for path in split)
        and isinstance(leaf, (jax.Array, np.ndarray))
        and not isinstance(leaf, jax.core.Tracer)
    }


def _check_weights(
    found: Mapping[str, str], saved: Mapping[str, str], folder: pathlib.Path
) -> None:
    """Raise ValueError if a fingerprint of a base weight differs from the saved one."""
    common = [name for name in found if name in saved]
    if changed := [name for name in common if found[name] != saved[name]]:
        raise ValueError(
            f"{folder} was trained on another base: {len(changed)} of {len(common)} arrays "
            f"differ, first {changed[0]!r}; any_base=True loads it anyway"
        )


def _matched_leaves(
    adapters: nnx.State,
    tensors: Mapping[str, np.ndarray],
    methods: Mapping[str, Method],
    folder: pathlib.Path,
) -> dict[str, Any]:
    """Leaves of the adapters by name; raise ValueError if names or shapes of tensors differ."""
    leaves = paths.by_path(adapters)
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
            raise ValueError(f"{name} is {saved[name]} in {folder}, but {shape} in the model")
    return leaves


def read_tensors(path: pathlib.Path) -> tuple[bytes, dict[str, np.ndarray]]:
    """Read a safetensors file; return its content and its tensors by name.

    Raises:
        ValueError: the file is damaged, or a tensor is not floating-point or not finite.
    """
    tensors = {}
    with as_value_error(path, safetensors.SafetensorError):
        check_memory(check_regular(path).stat().st_size, path)
        data = path.read_bytes()
        # Not `safetensors.numpy.load`, which knows neither bf16 nor float8.
        for name, stored in sorted(safetensors.deserialize(data), key=lambda pair: pair[0]):
            dtype = _FLOATS.get(stored["dtype"])
            tensor = np.frombuffer(stored["data"], dtype or np.uint8)
            if not dtype or not np.isfinite(tensor.astype(np.float32)).all():
                raise ValueError(f"tensor {name!r} must be floating-point and finite")
            tensors[name] = tensor.reshape(stored["shape"])
    return data, tensors


def read_description(folder: pathlib.Path) -> dict[str, Any]:
    """Read the adapter.json in a folder.

    Raises:
        ValueError: the file is missing, damaged, or of an unsupported format or version.
    """
    path = folder / DESCRIPTION
    with as_value_error(path):
        description = read_json(path)
        if (description["format"], description["version"]) != (FORMAT, VERSION):
            raise RefusedError(f"{path} is not a {FORMAT} of version {VERSION}")
        description = digest.verify_digest(description)
        json_values.check(description, FIELDS)
    return description
