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
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from pathlib import Path
from types import ModuleType
from typing import Any

import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import safetensors
import safetensors.numpy
from flax import nnx

from lorasp_jax.models import layouts
from lorasp_jax.models.checkpoint import (
    INDEX,
    SINGLE,
    base_arrays,
    by_path,
    named_arrays,
    set_arrays,
    weight_files,
)
from lorasp_jax.models.pi0 import openpi_lora

_READ_AHEAD = 1  # GB that Orbax reads at once, beside the result
_PREFIX = "model."  # of all tensors in a LeRobot policy's file


def load(folder: Path, config: Any) -> tuple[Any, list[str]]:
    """A model from a folder in one of the published layouts, which is found out.

    Args:
        folder: openpi's, with `params` or the content of that; or LeRobot's, with safetensors.
        config: sizes of the model, and the type to store its parameters in.

    Returns:
        The model, with adapters if openpi trained LoRA; and the names of tensors in the files that
        no computation reads.

    Raises:
        ValueError: neither layout; damaged files; leaves missing, left over or of other shapes.
    """
    weights = _weights(config)
    layout, theirs = _open(folder, weights.canonical_name)
    unused: list[str] = []
    if isinstance(theirs, _Tensors):
        for head, twin in weights.TIED.items():
            if head in theirs and twin not in theirs:  # as older files have it
                theirs.rename(head, twin)
        unused = [name for name in weights.UNUSED if name in theirs]
        for name in unused:
            del theirs[name]
    lora = openpi_lora.taken(theirs) if layout == "openpi" else {}
    model = nnx.eval_shape(lambda: config.create(nnx.Rngs(0)))
    dtypes = {name: leaf.dtype for name, leaf in named_arrays(model).items()}

    def place(name: str, array: np.ndarray) -> jax.Array:
        return jnp.asarray(array, dtypes[name])

    rules = weights.LAYOUTS[layout](config)
    arrays = layouts.read(rules, theirs, f"{folder} (layout {layout})", place)
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
        ValueError: unknown layout, adapters or quantised kernels, or something is there already.
    """
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
        unfinished = target.with_name(f".{target.name}.unfinished")
        safetensors.numpy.save_file({_PREFIX + name: a for name, a in theirs.items()}, unfinished)
        unfinished.rename(target)
    else:
        tree = jax.tree.map(jnp.asarray, flax.traverse_util.unflatten_dict(theirs, sep="/"))
        ocp.PyTreeCheckpointer().save(target.absolute(), {"params": tree})


def stored_dtypes(folder: Path, config: Any) -> dict[str, np.dtype]:
    """Type of each leaf in a published folder, for `save`.

    Raises:
        ValueError: as `load`.
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
    for place in (folder / "params", folder):
        if (place / "_METADATA").exists():
            return "openpi", _restored(place)
    files = weight_files(folder)
    if not ((folder / INDEX).exists() or files[0].exists()):
        raise ValueError(
            f"{folder} holds neither an Orbax checkpoint of openpi (params/_METADATA) nor "
            f"safetensors of LeRobot ({SINGLE})."
        )
    return "lerobot", _Tensors(files, canonical_name)


def _restored(place: Path) -> dict[str, np.ndarray]:
    """Leaves of an Orbax checkpoint by path below `params`, without a trailing "/value"."""
    handler = ocp.PyTreeCheckpointHandler(restore_concurrent_gb=_READ_AHEAD)
    checkpointer = ocp.Checkpointer(handler)
    try:
        found: Any = checkpointer.metadata(place.absolute())
        tree = found.item_metadata.tree
        as_numpy = jax.tree.map(lambda _: ocp.RestoreArgs(restore_type=np.ndarray), tree)
        restored = checkpointer.restore(place.absolute(), restore_args=as_numpy)
    except Exception as error:  # Orbax and its C++ parts raise many kinds
        raise ValueError(f"{place} is damaged or no Orbax checkpoint.") from error
    return {
        name.removeprefix("params/").removesuffix("/value"): leaf
        for name, leaf in by_path(restored).items()
    }


class _Tensors(MutableMapping[str, np.ndarray]):
    """Tensors in safetensors files by canonical name, read when asked for."""

    def __init__(self, files: list[Path], canonical_name: Callable[[str], str]) -> None:
        self._found: dict[str, tuple[Any, str]] = {}
        for path in files:
            try:
                file = safetensors.safe_open(path, framework="np")
            except (OSError, safetensors.SafetensorError) as error:
                raise ValueError(f"{path} is missing, damaged or cut short.") from error
            for name in file.keys():  # noqa: SIM118, which is no mapping
                short = canonical_name(name.removeprefix(_PREFIX))
                if short in self._found:
                    other = self._found[short][1]
                    raise ValueError(f"{path} has one tensor under two names, {other} and {name}.")
                self._found[short] = file, name

    def rename(self, old: str, new: str) -> None:
        """Lets a tensor be found under another name."""
        self._found[new] = self._found.pop(old)

    def __getitem__(self, name: str) -> np.ndarray:
        file, stored = self._found[name]
        return file.get_tensor(stored)

    def __delitem__(self, name: str) -> None:
        del self._found[name]

    def __setitem__(self, name: str, array: np.ndarray) -> None:
        raise TypeError("files are only read")

    def __iter__(self) -> Iterator[str]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)
