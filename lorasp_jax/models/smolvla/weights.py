"""LeRobot's SmolVLA parameters, tensors by name, as parameters of our `SmolVLA`, and back.

PyTorch keeps a linear map as [O, I] and every layer for itself; ours are [I, O], stacked over
depth. Values are only transposed, reshaped and stacked, so they stay exact. The names are those of
LeRobot 0.4.4 to 0.6.1; what stands before their first known part ("model.") does not matter when
reading.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
import safetensors.numpy
from flax import nnx

from lorasp_jax.models import checkpoint
from lorasp_jax.models.checkpoint import Folder
from lorasp_jax.models.smolvla.config import SmolVLAConfig
from lorasp_jax.models.smolvla.smolvla import SmolVLA

Arrays = dict[str, np.ndarray]
"""Arrays by "/"-joined path (ours) or by "."-joined name (LeRobot's)."""

_PREFIX = "model."
_ROOT = re.compile(r"(?:^|\.)((?:vlm_with_expert|state_proj|action_\w+)\..*)")
_VISION = "vlm_with_expert.vlm.model.vision_model"
_TEXT = "vlm_with_expert.vlm.model.text_model"
_CONNECTOR = "vlm_with_expert.vlm.model.connector.modality_projection.proj"
_LM_HEAD = "vlm_with_expert.vlm.lm_head"
_EXPERT = "vlm_with_expert.lm_expert"
_PROJECTIONS = (
    "state_proj",
    "action_in_proj",
    "action_time_mlp_in",
    "action_time_mlp_out",
    "action_out_proj",
)


def load(folder: Folder, config: SmolVLAConfig) -> SmolVLA:
    """A model from LeRobot's `model.safetensors` (or its shards and their index).

    Args:
        folder: where the files are.
        config: sizes of the stored model, and the types to compute and to store in.

    Raises:
        ValueError: missing or damaged files, missing or unexpected tensors, or other shapes.
    """
    arrays = from_lerobot(checkpoint.read(folder), config)
    return checkpoint.set_arrays(nnx.eval_shape(lambda: config.create(nnx.Rngs(0))), arrays)


def save(folder: Folder, model: SmolVLA, *, like: Folder | None = None) -> None:
    """Write LeRobot's `model.safetensors`; one that is already in the folder is replaced.

    Args:
        folder: made if absent; its other files are left alone.
        model: without adapters.
        like: folder whose stored types are taken, tensor by tensor: the one that the model came
            from. None stores the model's own types.

    Raises:
        ValueError: the model has adapters or quantised kernels, or `like` holds another model.
    """
    theirs = to_lerobot(checkpoint.base_arrays(model), model.config)
    if like is not None:
        types = {name: a.dtype for name, a in _plain(checkpoint.read(like)).items()}
        _check(types, {_plain_name(name) for name in theirs})
        theirs = {name: a.astype(types[_plain_name(name)]) for name, a in theirs.items()}
    theirs = {name: np.ascontiguousarray(a) for name, a in theirs.items()}
    data = safetensors.numpy.save(theirs, metadata={"format": "pt"})
    checkpoint.write(folder, {checkpoint.SINGLE: data})


def from_lerobot(arrays: Mapping[str, np.ndarray], config: SmolVLAConfig) -> Arrays:
    """Rename, transpose and stack LeRobot's tensors.

    Args:
        arrays: tensors by name.
        config: sizes of the model they are for.

    Returns:
        Leaves by path in our model, for `models.set_arrays`, in the types of the tensors.

    Raises:
        ValueError: tensors are missing, or some are left over (adapters, another model).
    """
    theirs = _plain(arrays)
    leaves = [*_leaves(config)]
    _check(theirs, {name for leaf in leaves for name in leaf.names})
    ours = {}
    for leaf in leaves:
        each = [leaf.kind.read(theirs[name]) for name in leaf.names]
        ours[leaf.path] = np.stack(each) if leaf.stacked else each[0]
    return ours


def to_lerobot(arrays: Mapping[str, np.ndarray], config: SmolVLAConfig) -> Arrays:
    """The inverse of `from_lerobot`, with LeRobot's own names: a tensor for each layer.

    Args:
        arrays: every leaf of our model by path.
        config: its sizes.
    """
    theirs = {}
    for leaf in _leaves(config):
        array = np.asarray(arrays[leaf.path])
        for name, each in zip(leaf.names, array if leaf.stacked else [array], strict=True):
            theirs[_PREFIX + name] = leaf.kind.write(each)
    return theirs


class _Kind(NamedTuple):
    """How a tensor becomes ours, and the way back."""

    read: Callable[[np.ndarray], np.ndarray]
    write: Callable[[np.ndarray], np.ndarray]


def _read_patches(weight: np.ndarray) -> np.ndarray:
    """`[O, rgb, y, x]` -> `[y x rgb, O]`."""
    return weight.transpose(2, 3, 1, 0).reshape(-1, len(weight))


def _write_patches(kernel: np.ndarray) -> np.ndarray:
    side = round((len(kernel) / 3) ** 0.5)
    return kernel.reshape(side, side, 3, -1).transpose(3, 2, 0, 1)


_SAME = _Kind(np.asarray, np.asarray)
_MATRIX = _Kind(np.transpose, np.transpose)
_PATCHES = _Kind(_read_patches, _write_patches)


class _Leaf(NamedTuple):
    """A leaf of ours and the names of what it is made of, one a layer if it is stacked."""

    path: str
    names: tuple[str, ...]
    kind: _Kind
    stacked: bool = False


def _leaves(config: SmolVLAConfig) -> Iterator[_Leaf]:
    """Every leaf of the model (facts of LeRobot's layout: its policies/smolvla)."""
    yield from _vision(range(config.vision.depth))
    for path, name in (("embedding", f"{_TEXT}.embed_tokens"), ("lm_head", _LM_HEAD)):
        yield _Leaf(f"language/{path}", (f"{name}.weight",), _SAME)
    yield from _expert("language/blocks", _TEXT, range(config.language.depth))
    yield from _expert("action/blocks/self_layer", _EXPERT, range(0, config.action.depth, 2))
    yield from _expert("action/blocks/cross_layer", _EXPERT, range(1, config.action.depth, 2))
    for path, name in (("language", _TEXT), ("action", _EXPERT)):
        yield _Leaf(f"{path}/norm/scale", (f"{name}.norm.weight",), _SAME)
    for name in _PROJECTIONS:
        yield _Leaf(f"{name}/kernel", (f"{name}.weight",), _MATRIX)
        yield _Leaf(f"{name}/bias", (f"{name}.bias",), _SAME)


def _vision(layers: range) -> Iterator[_Leaf]:
    embeddings, norm = f"{_VISION}.embeddings", f"{_VISION}.post_layernorm"
    yield _Leaf("vision/patch_embed/kernel", (f"{embeddings}.patch_embedding.weight",), _PATCHES)
    yield _Leaf("vision/patch_embed/bias", (f"{embeddings}.patch_embedding.bias",), _SAME)
    position = f"{embeddings}.position_embedding.weight"
    yield _Leaf("vision/position_embedding", (position,), _SAME)
    yield _Leaf("vision/norm/scale", (f"{norm}.weight",), _SAME)
    yield _Leaf("vision/norm/bias", (f"{norm}.bias",), _SAME)
    yield _Leaf("vision/head/kernel", (f"{_CONNECTOR}.weight",), _MATRIX)
    blocks, theirs = "vision/blocks", f"{_VISION}.encoder.layers"
    attention = ("q_proj", "k_proj", "v_proj", "out_proj")
    for name in (*(f"self_attn.{a}" for a in attention), "mlp.fc1", "mlp.fc2"):
        yield _stacked(blocks, theirs, name, "weight", "kernel", _MATRIX, layers)
        yield _stacked(blocks, theirs, name, "bias", "bias", _SAME, layers)
    for name in ("layer_norm1", "layer_norm2"):
        yield _stacked(blocks, theirs, name, "weight", "scale", _SAME, layers)
        yield _stacked(blocks, theirs, name, "bias", "bias", _SAME, layers)


def _expert(blocks: str, theirs: str, layers: range) -> Iterator[_Leaf]:
    attention = (f"self_attn.{name}_proj" for name in "qkvo")
    for name in (*attention, "mlp.gate_proj", "mlp.up_proj", "mlp.down_proj"):
        yield _stacked(blocks, f"{theirs}.layers", name, "weight", "kernel", _MATRIX, layers)
    for name in ("input_layernorm", "post_attention_layernorm"):
        yield _stacked(blocks, f"{theirs}.layers", name, "weight", "scale", _SAME, layers)


def _stacked(
    blocks: str, theirs: str, name: str, leaf: str, ours: str, kind: _Kind, layers: range
) -> _Leaf:
    """A leaf of these layers; LeRobot's names have a part before the linear map's own."""
    names = tuple(f"{theirs}.{i}.{name}.{leaf}" for i in layers)
    return _Leaf(f"{blocks}/{name.rpartition('.')[2]}/{ours}", names, kind, stacked=True)


def _plain_name(name: str) -> str:
    found = _ROOT.search(name)
    return found[1] if found else name


def _plain(arrays: Mapping[str, np.ndarray]) -> Arrays:
    """The tensors by name without prefix; names that nothing here knows stay whole."""
    return {_plain_name(name): array for name, array in arrays.items()}


def _check(found: Mapping[str, object], wanted: set[str]) -> None:
    problems = (
        ("lack", wanted - found.keys()),
        ("have, unlike this model,", found.keys() - wanted),
    )
    said = [f"{problem} {', '.join(sorted(names))}" for problem, names in problems if names]
    if said:
        raise ValueError(f"SmolVLA tensors {'; they '.join(said)}.")
