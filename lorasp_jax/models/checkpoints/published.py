"""Checkpoints as others publish them, in and out: openpi's Orbax folders, LeRobot's safetensors.

The package of a backbone has a module `weights` with

    LAYOUTS              layout's name -> function of a config that gives its rules
    canonical_name(name) of a LeRobot tensor, whichever version of the libraries wrote it
    UNUSED               LeRobot's tensors that no computation reads
    TIED                 of those, name -> the tensor it equals

Arrays are read one after the other and let go once they are in the model, so that loading takes
little more host memory than the model itself.
"""

import importlib
import math
import re
from collections.abc import Callable, Mapping, MutableMapping
from pathlib import Path
from types import ModuleType
from typing import Any

import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import safetensors.numpy
from flax import nnx

from envs.datasets.files import check_local
from envs.datasets.writing import replacing
from lorasp_jax.models.checkpoints import layouts, orbax_folders
from lorasp_jax.models.checkpoints.native import base_arrays, by_path, named_arrays, set_arrays
from lorasp_jax.models.checkpoints.tensor_files import INDEX, SINGLE, TensorFiles, weight_files
from lorasp_jax.models.pi0 import openpi_lora

_DENSITY, _SMALL = 20, 2**30  # bytes of arrays in a byte of files; bytes that do no harm
_READ_AHEAD = 1  # GB that Orbax reads at once, beside the result
_PREFIX = "model."  # of all tensors in a LeRobot policy's file
_STATISTIC = re.compile(r"(?:un)?normalize_(?:inputs|targets|outputs)\.")  # of older policies
_COMPILED = "_orig_mod."  # what PyTorch puts before the names of a compiled module


def load_published(folder: Path, config: Any) -> tuple[Any, list[str]]:
    """A model from a folder in one of the published layouts, which is found out.

    Args:
        folder: openpi's, with `params` or the content of that; or LeRobot's, with safetensors.
        config: sizes of the model, and the type to store its parameters in.

    Returns:
        The model, with adapters if openpi trained LoRA; and the names of tensors in the files that
        no computation reads: heads, and the statistics that LeRobot once kept there, which
        `statistics_files` reads.

    Raises:
        ValueError: neither layout, or damaged files.
        OtherModelError: leaves are missing, left over or of other shapes; a ValueError, too.
    """
    weights = _weights(config)
    layout, theirs = _open(folder, weights.canonical_name)
    unused: list[str] = []
    if isinstance(theirs, TensorFiles):
        for head, twin in weights.TIED.items():
            if head in theirs and twin not in theirs:  # as older files have it
                theirs.rename(head, twin)
        unused = [n for n in theirs if n in weights.UNUSED or _STATISTIC.match(n)]
        for name in unused:
            del theirs[name]
    lora = openpi_lora.taken(theirs) if layout == "openpi" else {}
    model = nnx.eval_shape(lambda: config.create(nnx.Rngs(0)))
    leaves = named_arrays(model)

    def place(name: str, array: np.ndarray) -> jax.Array:
        # Converted by numpy: JAX would hold a second copy, and return before it is gone.
        return jnp.asarray(np.asarray(array, leaves[name].dtype))

    rules = weights.LAYOUTS[layout](config)
    shapes = {name: leaf.shape for name, leaf in leaves.items()}
    arrays = layouts.read(rules, theirs, shapes, f"{folder} (layout {layout})", place)
    model = set_arrays(model, arrays)
    return openpi_lora.adapted(model, lora) if lora else model, unused


def save(folder: Path, model: Any, layout: str, dtypes: Mapping[str, Any] | None = None) -> None:
    """Writes a model's parameters for openpi (`folder`/params) or LeRobot (model.safetensors).

    Args:
        folder: made if absent; must not hold such a checkpoint yet.
        model: a backbone without adapters.
        layout: "openpi" or "lerobot".
        dtypes: type of each of their leaves, as `stored_dtypes` tells; None: the model's types.

    Raises:
        ValueError: unknown layout, adapters or quantised kernels, parameters of other shapes than
            the model's config says; or the folder is a URL, or holds such a checkpoint.
    """
    check_local(folder)
    weights = _weights(model.config)
    if layout not in weights.LAYOUTS:
        raise ValueError(f"layout {layout!r} is not one of {', '.join(weights.LAYOUTS)}.")
    target = folder / ("params" if layout == "openpi" else SINGLE)
    if target.exists():
        raise ValueError(f"{target} exists already: choose another folder.")
    rules = weights.LAYOUTS[layout](model.config)
    theirs = layouts.write(rules, base_arrays(model))
    if dtypes is not None:
        theirs = {name: array.astype(dtypes[name]) for name, array in theirs.items()}
    folder.mkdir(parents=True, exist_ok=True)
    if layout == "lerobot":
        theirs |= {name: theirs[twin] for name, twin in weights.TIED.items()}
        tensors = {_PREFIX + name: array for name, array in theirs.items()}
        with replacing(target) as unfinished:
            safetensors.numpy.save_file(tensors, unfinished)
    else:
        tree = jax.tree.map(jnp.asarray, flax.traverse_util.unflatten_dict(theirs, sep="/"))
        ocp.PyTreeCheckpointer().save(target.absolute(), {"params": tree})


def stored_dtypes(folder: Path, config: Any) -> dict[str, np.dtype]:
    """Type of each leaf in a published folder, for `save`.

    Raises:
        ValueError: as `load_published`.
    """
    _, theirs = _open(folder, _weights(config).canonical_name)
    return {name: theirs[name].dtype for name in theirs}


def _weights(config: Any) -> ModuleType:
    package = type(config).__module__.rpartition(".")[0]
    return importlib.import_module(f"{package}.weights")


def _open(
    folder: Path, canonical_name: Callable[[str], str]
) -> tuple[str, MutableMapping[str, Any]]:
    """The layout of a folder and its leaves."""
    if place := orbax_folder(folder):
        return "openpi", _restored(place)
    files = weight_files(folder)
    if not ((folder / INDEX).exists() or files[0].exists()):
        raise ValueError(
            f"{folder} holds neither an Orbax checkpoint of openpi (params/_METADATA) nor "
            f"safetensors of LeRobot ({SINGLE})."
        )

    def rename(name: str) -> str:
        return canonical_name(name.removeprefix(_PREFIX).removeprefix(_COMPILED))

    return "lerobot", TensorFiles(files, rename)


def orbax_folder(folder: Path) -> Path | None:
    """Where in a folder openpi's leaves are; None: it is not openpi's."""
    places = (folder / "params", folder)
    return next((place for place in places if (place / "_METADATA").exists()), None)


def _restored(place: Path) -> dict[str, np.ndarray]:
    """Leaves of an Orbax checkpoint by path below `params`, without a trailing "/value"."""
    handler = ocp.PyTreeCheckpointHandler(restore_concurrent_gb=_READ_AHEAD)
    checkpointer = ocp.Checkpointer(handler)
    orbax_folders.leave_echoes_out()
    try:
        orbax_folders.check(place)
        found: Any = checkpointer.metadata(place.absolute())
        tree = found.item_metadata.tree
        _check_size(place, tree)
        as_numpy = jax.tree.map(lambda _: ocp.RestoreArgs(restore_type=np.ndarray), tree)
        restored = checkpointer.restore(place.absolute(), restore_args=as_numpy)
    except Exception as error:  # Orbax and its C++ parts raise many kinds
        raise ValueError(f"{place} is damaged or no Orbax checkpoint.") from error
    return {
        name.removeprefix("params/").removesuffix("/value"): leaf
        for name, leaf in by_path(restored).items()
    }


def _check_size(place: Path, tree: Any) -> None:
    """Raise ValueError if the arrays are far larger than the files: they may be all zeros."""
    claimed = sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))
    there = sum(path.stat().st_size for path in place.rglob("*") if path.is_file())
    if claimed > max(_SMALL, _DENSITY * there):
        raise ValueError(f"{claimed} bytes of arrays cannot be in {there} bytes of files")
