"""Load and save published checkpoints: openpi's Orbax folders, LeRobot's safetensors.

Each backbone package has a module `published_names`:

    LAYOUTS              layout name -> function (config) -> rules
    lerobot_name(name)   version-independent name of a LeRobot tensor
    UNUSED               LeRobot tensors that the model does not use
    TIED                 unused tensor -> the tensor it is tied to

Arrays are converted one at a time and released once copied, to save host memory.
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

from lorasp_jax.adapters.paths import by_path
from lorasp_jax.base.files import RefusedError, check_local, check_memory
from lorasp_jax.base.writing import atomic_file
from lorasp_jax.models.checkpoints import layouts, orbax_folders
from lorasp_jax.models.checkpoints.native import base_arrays, named_arrays, set_arrays
from lorasp_jax.models.checkpoints.tensor_files import SINGLE, TensorFiles, weight_files
from lorasp_jax.models.pi0 import openpi_lora

METADATA = "_METADATA"
"""File of every Orbax folder."""
_CONCURRENT_GB = 1  # host memory that Orbax may use in addition to the result
_PREFIX, _WEIGHT = "model.", ".weight"  # of every tensor in a LeRobot policy, of most
# Normalization statistics, which older LeRobot versions stored among the weights.
_STATISTIC = re.compile(r"(?:un)?normalize_(?:inputs|targets|outputs)\.")
_COMPILED = "_orig_mod."  # prefix that torch.compile adds


def load_published(folder: Path, config: Any) -> tuple[Any, list[str]]:
    """Load a published checkpoint, detecting its layout.

    Args:
        folder: openpi's folder or its subfolder `params`, or LeRobot's folder with safetensors.
        config: model sizes and parameter dtype.

    Returns:
        The model, with adapters if the checkpoint has openpi's LoRA, and the names of unused
        tensors: language-model heads, and normalization statistics from older LeRobot versions.

    Raises:
        ValueError: unknown layout or damaged files.
        ModelMismatchError: missing, unexpected or wrongly shaped leaves (a ValueError subclass).
    """
    published_names = _published_names(config)
    layout, theirs = _open(folder, published_names.lerobot_name)
    unused: list[str] = []
    if isinstance(theirs, TensorFiles):
        for head, embedding in published_names.TIED.items():
            if head in theirs and embedding not in theirs:  # older files store only the head
                theirs.rename(head, embedding)
        unused = [n for n in theirs if n in published_names.UNUSED or _STATISTIC.match(n)]
        for name in unused:
            del theirs[name]
    lora = openpi_lora.pop_lora(theirs) if layout == "openpi" else {}
    model = nnx.eval_shape(lambda: config.create(nnx.Rngs(0)))
    leaves = named_arrays(model)

    def convert(name: str, array: np.ndarray) -> jax.Array:
        # Cast with NumPy: JAX would hold a second copy and return before freeing it.
        return jnp.asarray(np.asarray(array, leaves[name].dtype))

    rules = published_names.LAYOUTS[layout](config)
    shapes = {name: leaf.shape for name, leaf in leaves.items()}
    arrays = layouts.to_ours(rules, theirs, shapes, f"{folder} (layout {layout})", convert)
    model = set_arrays(model, arrays)
    return openpi_lora.attach(model, lora) if lora else model, unused


def save(folder: Path, model: Any, layout: str, dtypes: Mapping[str, Any] | None = None) -> None:
    """Save a model's parameters for openpi (`folder`/params) or LeRobot (model.safetensors).

    Args:
        folder: created if missing; must not already contain a checkpoint of this layout.
        model: a backbone without adapters.
        layout: "openpi" (pi0 only) or "lerobot".
        dtypes: dtype of each saved leaf, from `stored_dtypes`; None keeps the model's dtypes.

    Raises:
        ValueError: the layout is unknown, the model has adapters or quantized kernels, or the
            folder is a URL or already contains a checkpoint.
    """
    check_local(folder)
    published_names = _published_names(model.config)
    if layout not in published_names.LAYOUTS:
        raise ValueError(f"layout must be one of {[*published_names.LAYOUTS]}, got {layout!r}")
    target = folder / ("params" if layout == "openpi" else SINGLE)
    if target.exists():
        raise ValueError(f"{target} already exists: choose another folder")
    rules = published_names.LAYOUTS[layout](model.config)
    theirs = layouts.to_theirs(rules, base_arrays(model))
    if dtypes is not None:
        theirs = {name: array.astype(dtypes[name]) for name, array in theirs.items()}
    folder.mkdir(parents=True, exist_ok=True)
    if layout == "lerobot":
        theirs |= {head: theirs[tied] for head, tied in published_names.TIED.items()}
        tensors = {_PREFIX + name: array for name, array in theirs.items()}
        with atomic_file(target) as temporary:
            safetensors.numpy.save_file(tensors, temporary)
    else:
        tree = jax.tree.map(jnp.asarray, flax.traverse_util.unflatten_dict(theirs, sep="/"))
        ocp.PyTreeCheckpointer().save(target.absolute(), {"params": tree})


def stored_dtypes(folder: Path, config: Any) -> dict[str, np.dtype]:
    """Return the dtype of each leaf in a published checkpoint, for `save`.

    Raises:
        ValueError: unknown layout or damaged files.
    """
    _, theirs = _open(folder, _published_names(config).lerobot_name)
    return {name: theirs[name].dtype for name in theirs}


def lerobot_names(model: Any) -> Callable[[str, tuple[int, ...]], str]:
    """Names of a backbone's layers in LeRobot's PEFT folders, the `names` of `load_peft`.

    LeRobot adapts the policy that holds the network as `model` (policies/pretrained.py,
    wrap_with_peft).

    Args:
        model: a backbone, not part of a larger model.

    Returns:
        Function (path, index) -> module name.
    """
    layers: dict[str, tuple[str, ...]] = {}
    for rule in _published_names(model.config).LAYOUTS["lerobot"](model.config):
        if rule.theirs[0].endswith(_WEIGHT):
            layers.setdefault(rule.ours[0].rpartition("/")[0], rule.theirs)

    def name(path: str, index: tuple[int, ...]) -> str:
        if path not in layers:
            raise ValueError(f"{path} is no layer of the backbone: load into the backbone itself")
        return _PREFIX + layers[path][index[0] if index else 0].removesuffix(_WEIGHT)

    return name


def _published_names(config: Any) -> ModuleType:
    package = type(config).__module__.rpartition(".")[0]
    return importlib.import_module(f"{package}.published_names")


def _open(folder: Path, lerobot_name: Callable[[str], str]) -> tuple[str, MutableMapping[str, Any]]:
    """Return a folder's layout and its leaves by name."""
    if params := orbax_folder(folder):
        return "openpi", _restore(params)
    files = weight_files(folder)
    if files == [folder / SINGLE] and not files[0].exists():
        raise ValueError(f"{folder} has neither openpi's params/{METADATA} nor LeRobot's {SINGLE}")

    def rename(name: str) -> str:
        return lerobot_name(name.removeprefix(_PREFIX).removeprefix(_COMPILED))

    return "lerobot", TensorFiles(files, rename)


def orbax_folder(folder: Path) -> Path | None:
    """Return the Orbax folder of an openpi checkpoint, or None if there is none.

    Like openpi (policies/policy_config.py), prefers a PyTorch conversion, a safetensors file.
    """
    if (folder / SINGLE).exists():
        return None
    candidates = (folder / "params", folder)
    return next((path for path in candidates if (path / METADATA).exists()), None)


def _restore(folder: Path) -> dict[str, np.ndarray]:
    """Read an Orbax checkpoint's leaves by path below `params`, without a trailing "/value"."""
    handler = ocp.PyTreeCheckpointHandler(restore_concurrent_gb=_CONCURRENT_GB)
    checkpointer = ocp.Checkpointer(handler)
    orbax_folders.suppress_repeated_errors()
    try:
        orbax_folders.check(folder)
        metadata: Any = checkpointer.metadata(folder.absolute())
        tree = metadata.item_metadata.tree
        # Orbax reads missing chunks as zeros, so a small folder can declare arrays of any size.
        sizes = (math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))
        check_memory(sum(sizes), folder)
        as_numpy = jax.tree.map(lambda _: ocp.RestoreArgs(restore_type=np.ndarray), tree)
        restored = checkpointer.restore(folder.absolute(), restore_args=as_numpy)
    except (RefusedError, MemoryError):
        raise
    except Exception as error:  # Orbax and its C++ layer raise many exception types
        raise ValueError(f"{folder} is damaged or not an Orbax checkpoint") from error
    return {
        name.removeprefix("params/").removesuffix("/value"): leaf
        for name, leaf in by_path(restored).items()
    }
