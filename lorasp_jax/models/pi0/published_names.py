"""Names and shapes of pi0's parameters as openpi and LeRobot publish them.

openpi fuses keys with values and gate with up into one einsum kernel each, and keeps head axes
separate. LeRobot stores PyTorch's transposed matrices [O, I], one per layer. This project stores
matrices [I, O] under Hugging Face's names, stacked over layers.
"""

import numpy as np

from lorasp_jax.models.checkpoints.layouts import Rule, copied, reshaped
from lorasp_jax.models.checkpoints.torch_layouts import PROJECTIONS, decoder, linear, siglip
from lorasp_jax.models.config import ExpertConfig
from lorasp_jax.models.pi0.pi0 import Pi0Config

_IMG, _LLM = "PaliGemma/img", "PaliGemma/llm"
_PALIGEMMA = "paligemma_with_expert.paligemma"
_EXPERT = "paligemma_with_expert.gemma_expert"
_VISION = f"{_PALIGEMMA}.model.vision_tower.vision_model"
_LANGUAGE = f"{_PALIGEMMA}.model.language_model"
_PROJECTIONS05 = ("action_in_proj", "time_mlp_in", "time_mlp_out", "action_out_proj")
UNUSED = (f"{_PALIGEMMA}.lm_head.weight", f"{_EXPERT}.lm_head.weight")
"""Language-model heads in LeRobot's checkpoints, which the model does not use."""
TIED = {UNUSED[0]: f"{_LANGUAGE}.embed_tokens.weight"}
"""Unused tensor -> the tensor it is tied to."""


def openpi_layout(config: Pi0Config) -> list[Rule]:
    """Rules for openpi's "/"-joined paths below `params` (models/pi0.py, gemma.py, siglip.py)."""
    rules = [
        *_openpi_vision(config),
        copied("language/embedding", f"{_LLM}/embedder/input_embedding"),
    ]
    for tower, size, suffix in (("language", config.language, ""), ("action", config.action, "_1")):
        rules += _openpi_expert(tower, size, suffix)
        rules += _openpi_norms(tower, suffix, adaptive=config.pi05 and tower == "action")
    for name in _PROJECTIONS05 if config.pi05 else PROJECTIONS:
        rules += [copied(f"{name}/{leaf}", f"{name}/{leaf}") for leaf in ("kernel", "bias")]
    return rules


def _openpi_vision(config: Pi0Config) -> list[Rule]:
    size = config.vision
    layers, width, patch = size.depth, size.width, size.patch
    heads = (size.heads, width // size.heads)
    block, ours = f"{_IMG}/Transformer/encoderblock", "vision/blocks"
    attention = f"{block}/MultiHeadDotProductAttention_0"
    embedding, matrix = (patch, patch, 3, width), (layers, width, width)
    pixels, positions = patch * patch * 3, (config.patches, width)
    rules = [
        reshaped(
            "vision/patch_embed/kernel", f"{_IMG}/embedding/kernel", (pixels, width), embedding
        ),
        copied("vision/patch_embed/bias", f"{_IMG}/embedding/bias"),
        reshaped("vision/position_embedding", f"{_IMG}/pos_embedding", positions, (1, *positions)),
        reshaped(
            f"{ours}/out_proj/kernel", f"{attention}/out/kernel", matrix, (layers, *heads, width)
        ),
        copied(f"{ours}/out_proj/bias", f"{attention}/out/bias"),
    ]
    for name, theirs in (("q_proj", "query"), ("k_proj", "key"), ("v_proj", "value")):
        theirs = f"{attention}/{theirs}"
        kernel, bias = (layers, width, *heads), (layers, *heads)
        rules += [
            reshaped(f"{ours}/{name}/kernel", f"{theirs}/kernel", matrix, kernel),
            reshaped(f"{ours}/{name}/bias", f"{theirs}/bias", (layers, width), bias),
        ]
    for leaf in ("kernel", "bias"):
        rules += [
            copied(f"{ours}/fc{i + 1}/{leaf}", f"{block}/MlpBlock_0/Dense_{i}/{leaf}")
            for i in (0, 1)
        ]
        rules.append(copied(f"vision/head/{leaf}", f"{_IMG}/head/{leaf}"))
    for leaf in ("scale", "bias"):
        rules += [
            copied(f"{ours}/layer_norm{i + 1}/{leaf}", f"{block}/LayerNorm_{i}/{leaf}")
            for i in (0, 1)
        ]
        rules.append(copied(f"vision/norm/{leaf}", f"{_IMG}/Transformer/encoder_norm/{leaf}"))
    return rules


def _openpi_expert(tower: str, size: ExpertConfig, suffix: str) -> list[Rule]:
    """Rules for one expert's projections; openpi marks the action expert with the suffix "_1"."""
    layers, ours = f"{_LLM}/layers", f"{tower}/blocks"
    depth, width, heads, kv_heads = size.depth, size.width, size.heads, size.kv_heads
    inner = heads * size.head_dim

    def kernel(name: str) -> str:
        return f"{ours}/{name}/kernel"

    return [
        # openpi's shapes, with N query heads, K kv heads and MLP width F:
        # q: [L, N, D, H]; k and v: [L, 2, K, D, H]; gate and up: [L, 2, D, F].
        Rule(
            (kernel("q_proj"),),
            (f"{layers}/attn/q_einsum{suffix}/w",),
            lambda _: [(depth, heads, width, size.head_dim)],
            lambda arrays: [_heads_last(w) for w in arrays],
            lambda q: [_heads_first(q, heads)],
        ),
        Rule(
            (kernel("k_proj"), kernel("v_proj")),
            (f"{layers}/attn/kv_einsum{suffix}/w",),
            lambda *_: [(depth, 2, kv_heads, width, size.head_dim)],
            lambda arrays: [_heads_last(a) for w in arrays for a in (w[:, 0], w[:, 1])],
            lambda k, v: [np.stack([_heads_first(a, kv_heads) for a in (k, v)], axis=1)],
        ),
        Rule(
            (kernel("gate_proj"), kernel("up_proj")),
            (f"{layers}/mlp{suffix}/gating_einsum",),
            lambda *_: [(depth, 2, width, size.mlp)],
            lambda arrays: [a for w in arrays for a in (w[:, 0], w[:, 1])],
            lambda gate, up: [np.stack([gate, up], axis=1)],
        ),
        reshaped(
            kernel("o_proj"),
            f"{layers}/attn/attn_vec_einsum{suffix}/w",
            (depth, inner, width),
            (depth, heads, size.head_dim, width),
        ),
        copied(kernel("down_proj"), f"{layers}/mlp{suffix}/linear"),
    ]


def _openpi_norms(tower: str, suffix: str, *, adaptive: bool) -> list[Rule]:
    """Rules for one expert's norms; an adaptive norm has a dense layer instead of a scale."""
    names = {
        f"{tower}/blocks/input_layernorm": f"{_LLM}/layers/pre_attention_norm{suffix}",
        f"{tower}/blocks/post_attention_layernorm": f"{_LLM}/layers/pre_ffw_norm{suffix}",
        f"{tower}/norm": f"{_LLM}/final_norm{suffix}",
    }
    leaves = {"scale": "scale"}
    if adaptive:
        leaves = {"dense/kernel": "Dense_0/kernel", "dense/bias": "Dense_0/bias"}
    return [
        copied(f"{ours}/{our_leaf}", f"{theirs}/{their_leaf}")
        for ours, theirs in names.items()
        for our_leaf, their_leaf in leaves.items()
    ]


def _heads_last(kernel: np.ndarray) -> np.ndarray:
    """`[L, N, D, H]` -> `[L, D, N H]`."""
    layers, _, width, _ = kernel.shape
    return kernel.swapaxes(1, 2).reshape(layers, width, -1)


def _heads_first(kernel: np.ndarray, heads: int) -> np.ndarray:
    """`[L, D, N H]` -> `[L, N, D, H]`."""
    layers, width, _ = kernel.shape
    return kernel.reshape(layers, width, heads, -1).swapaxes(1, 2)


def lerobot_name(name: str) -> str:
    """Map a tensor name from any LeRobot version to the current name.

    Older versions have the towers in other modules.
    """
    if name.endswith("lm_head.weight"):
        return UNUSED["gemma_expert." in name]
    for marker, inner, tower in (
        ("vision_tower.", "vision_model.", _VISION),
        ("gemma_expert.", "model.", f"{_EXPERT}.model"),
        ("language_model.", "model.", _LANGUAGE),
        ("multi_modal_projector.", "", f"{_PALIGEMMA}.model.multi_modal_projector"),
    ):
        _, matched, rest = name.partition(marker)
        if matched:
            return f"{tower}.{rest.removeprefix(inner)}"
    return name


def lerobot_layout(config: Pi0Config) -> list[Rule]:
    """Rules for LeRobot's tensors, named without the leading "model." (policies/pi0 and pi05)."""
    rules = [
        *siglip(_VISION, config.vision),
        *linear("vision/head", f"{_PALIGEMMA}.model.multi_modal_projector.linear"),
        copied("language/embedding", f"{_LANGUAGE}.embed_tokens.weight"),
    ]
    for tower, theirs in (("language", _LANGUAGE), ("action", f"{_EXPERT}.model")):
        adaptive = config.pi05 and tower == "action"
        layers = range(config.language.depth)
        rules += decoder(f"{tower}/blocks", theirs, layers, adaptive=adaptive)
        if adaptive:
            rules += linear(f"{tower}/norm/dense", f"{theirs}.norm.dense")
        else:
            rules.append(copied(f"{tower}/norm/scale", f"{theirs}.norm.weight"))
    for name in _PROJECTIONS05 if config.pi05 else PROJECTIONS:
        rules += linear(name, name)
    return rules


LAYOUTS = {"openpi": openpi_layout, "lerobot": lerobot_layout}
"""Layout name -> function (config) -> rules."""
