"""openpi's pi0 parameters, a tree of arrays, as parameters of our `Pi0`.

openpi keeps one einsum kernel for several linear maps (keys and values, gate and up) and separate
head axes; ours are matrices under the names of Hugging Face. Values are only sliced, transposed and
reshaped, so they stay exact.
"""

from collections.abc import Mapping

import numpy as np

from lorasp_jax.models.pi0.config import Pi0Config

Arrays = dict[str, np.ndarray]
"""Arrays by "/"-joined path."""

_VISION = "PaliGemma/img"
_LAYERS = "PaliGemma/llm/layers"
_PROJECTIONS = (
    "state_proj",
    "action_in_proj",
    "action_time_mlp_in",
    "action_time_mlp_out",
    "action_out_proj",
)


def from_openpi(arrays: Mapping[str, np.ndarray], config: Pi0Config) -> Arrays:
    """Rename and reshape openpi's leaves.

    Args:
        arrays: leaves by "/"-joined path below `params`; a trailing "/value" is dropped.
        config: sizes of the model they are for.

    Returns:
        Leaves by path in our model, for `models.set_arrays`.

    Raises:
        ValueError: a leaf is missing, or some are left over (adapters, another model).
    """
    source = _Source({path.removesuffix("/value"): np.asarray(a) for path, a in arrays.items()})
    ours = {**_vision(source, config), **_expert(source, "language", "")}
    ours |= _expert(source, "action", "_1")
    ours["language/embedding"] = source.take("PaliGemma/llm/embedder/input_embedding")
    for name in _PROJECTIONS:
        ours |= {f"{name}/{leaf}": source.take(f"{name}/{leaf}") for leaf in ("kernel", "bias")}
    source.check()
    return ours


class _Source:
    """Leaves that are taken one by one; knows what nobody took."""

    def __init__(self, arrays: Arrays) -> None:
        self._left = arrays

    def take(self, path: str) -> np.ndarray:
        """The leaf at `path`."""
        if path not in self._left:
            raise ValueError(f"openpi parameters lack {path}.")
        return self._left.pop(path)

    def check(self) -> None:
        """Raises ValueError if a leaf is left."""
        if self._left:
            raise ValueError(
                f"openpi parameters have leaves this model lacks: {', '.join(sorted(self._left))}."
            )


def _vision(source: _Source, config: Pi0Config) -> Arrays:
    layers, width = config.vision.depth, config.vision.width
    block = f"{_VISION}/Transformer/encoderblock"
    ours = {
        "patch_embed/kernel": source.take(f"{_VISION}/embedding/kernel").reshape(-1, width),
        "patch_embed/bias": source.take(f"{_VISION}/embedding/bias"),
        "position_embedding": source.take(f"{_VISION}/pos_embedding")[0],
    }
    for name, theirs in (("q_proj", "query"), ("k_proj", "key"), ("v_proj", "value")):
        path = f"{block}/MultiHeadDotProductAttention_0/{theirs}"
        ours[f"blocks/{name}/kernel"] = source.take(f"{path}/kernel").reshape(layers, width, -1)
        ours[f"blocks/{name}/bias"] = source.take(f"{path}/bias").reshape(layers, -1)
    path = f"{block}/MultiHeadDotProductAttention_0/out"
    ours["blocks/out_proj/kernel"] = source.take(f"{path}/kernel").reshape(layers, -1, width)
    ours["blocks/out_proj/bias"] = source.take(f"{path}/bias")
    copies = {
        "blocks/fc1/kernel": f"{block}/MlpBlock_0/Dense_0/kernel",
        "blocks/fc1/bias": f"{block}/MlpBlock_0/Dense_0/bias",
        "blocks/fc2/kernel": f"{block}/MlpBlock_0/Dense_1/kernel",
        "blocks/fc2/bias": f"{block}/MlpBlock_0/Dense_1/bias",
        "head/kernel": f"{_VISION}/head/kernel",
        "head/bias": f"{_VISION}/head/bias",
    }
    for leaf in ("scale", "bias"):
        copies[f"blocks/layer_norm1/{leaf}"] = f"{block}/LayerNorm_0/{leaf}"
        copies[f"blocks/layer_norm2/{leaf}"] = f"{block}/LayerNorm_1/{leaf}"
        copies[f"norm/{leaf}"] = f"{_VISION}/Transformer/encoder_norm/{leaf}"
    ours |= {name: source.take(path) for name, path in copies.items()}
    return {f"vision/{name}": array for name, array in ours.items()}


def _expert(source: _Source, name: str, suffix: str) -> Arrays:
    """Leaves of one expert; openpi marks the action expert's with "_1"."""
    q = source.take(f"{_LAYERS}/attn/q_einsum{suffix}/w")  # [L, N, D, H]
    kv = source.take(f"{_LAYERS}/attn/kv_einsum{suffix}/w")  # [L, 2, K, D, H]
    out = source.take(f"{_LAYERS}/attn/attn_vec_einsum{suffix}/w")  # [L, N, H, D]
    gating = source.take(f"{_LAYERS}/mlp{suffix}/gating_einsum")  # [L, 2, D, F]
    ours = {
        "q_proj/kernel": _heads_last(q),
        "k_proj/kernel": _heads_last(kv[:, 0]),
        "v_proj/kernel": _heads_last(kv[:, 1]),
        "o_proj/kernel": out.reshape(len(out), -1, out.shape[-1]),
        "gate_proj/kernel": gating[:, 0],
        "up_proj/kernel": gating[:, 1],
        "down_proj/kernel": source.take(f"{_LAYERS}/mlp{suffix}/linear"),
        "input_layernorm/scale": source.take(f"{_LAYERS}/pre_attention_norm{suffix}/scale"),
        "post_attention_layernorm/scale": source.take(f"{_LAYERS}/pre_ffw_norm{suffix}/scale"),
    }
    norm = source.take(f"PaliGemma/llm/final_norm{suffix}/scale")
    return {f"{name}/blocks/{leaf}": a for leaf, a in ours.items()} | {f"{name}/norm/scale": norm}


def _heads_last(kernel: np.ndarray) -> np.ndarray:
    """`[L, N, D, H]` -> `[L, D, N H]`."""
    layers, _, width, _ = kernel.shape
    return kernel.swapaxes(1, 2).reshape(layers, width, -1)
