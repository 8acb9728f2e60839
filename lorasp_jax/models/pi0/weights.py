"""The layouts in which pi0's parameters are published: openpi's and LeRobot's.

openpi keeps one einsum kernel for several linear maps (keys and values, gate and up) and separate
head axes. LeRobot has PyTorch's transposed matrices, layer by layer. Ours are matrices under the
names of Hugging Face, stacked over layers.
"""

import numpy as np

from lorasp_jax.models.layouts import Rule, copied, reshaped, stacked, transposed
from lorasp_jax.models.pi0.config import ExpertConfig, Pi0Config

_IMG, _LLM = "PaliGemma/img", "PaliGemma/llm"
_PALIGEMMA = "paligemma_with_expert.paligemma"
_EXPERT = "paligemma_with_expert.gemma_expert"
_VISION = f"{_PALIGEMMA}.model.vision_tower.vision_model"
_LANGUAGE = f"{_PALIGEMMA}.model.language_model"
UNUSED = (f"{_PALIGEMMA}.lm_head.weight", f"{_EXPERT}.lm_head.weight")
"""LeRobot's heads, which no computation reads."""
TIED = {UNUSED[0]: f"{_LANGUAGE}.embed_tokens.weight"}
"""Of those, what is another tensor once more."""
_PROJECTIONS = (
    "state_proj",
    "action_in_proj",
    "action_time_mlp_in",
    "action_time_mlp_out",
    "action_out_proj",
)


def openpi_layout(config: Pi0Config) -> list[Rule]:
    """openpi's leaves by "/"-joined path below `params` (models/pi0.py, gemma.py, siglip.py)."""
    rules = [
        *_openpi_vision(config),
        copied("language/embedding", f"{_LLM}/embedder/input_embedding"),
    ]
    for tower, size, suffix in (("language", config.language, ""), ("action", config.action, "_1")):
        rules += _openpi_expert(tower, size, suffix)
    for name in _PROJECTIONS:
        rules += [copied(f"{name}/{leaf}", f"{name}/{leaf}") for leaf in ("kernel", "bias")]
    return rules


def _openpi_vision(config: Pi0Config) -> list[Rule]:
    size = config.vision
    layers, width, patch = size.depth, size.width, size.patch
    heads = (size.heads, width // size.heads)
    block, ours = f"{_IMG}/Transformer/encoderblock", "vision/blocks"
    attention = f"{block}/MultiHeadDotProductAttention_0"
    embedding, matrix = (patch, patch, 3, width), (layers, width, width)
    rules = [
        reshaped("vision/patch_embed/kernel", f"{_IMG}/embedding/kernel", (-1, width), embedding),
        copied("vision/patch_embed/bias", f"{_IMG}/embedding/bias"),
        reshaped("vision/position_embedding", f"{_IMG}/pos_embedding", (-1, width), (1, -1, width)),
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
    """One expert; openpi marks the action expert's leaves with "_1"."""
    layers, ours = f"{_LLM}/layers", f"{tower}/blocks"
    heads, kv_heads = size.heads, size.kv_heads

    def kernel(name: str) -> str:
        return f"{ours}/{name}/kernel"

    out = (size.depth, heads, size.head_dim, size.width)
    return [
        # [L, N, D, H]; keys and values [L, 2, K, D, H]; gate and up [L, 2, D, F].
        Rule(
            (kernel("q_proj"),),
            (f"{layers}/attn/q_einsum{suffix}/w",),
            lambda arrays: [_heads_last(w) for w in arrays],
            lambda q: [_heads_first(q, heads)],
        ),
        Rule(
            (kernel("k_proj"), kernel("v_proj")),
            (f"{layers}/attn/kv_einsum{suffix}/w",),
            lambda arrays: [_heads_last(a) for w in arrays for a in (w[:, 0], w[:, 1])],
            lambda k, v: [np.stack([_heads_first(a, kv_heads) for a in (k, v)], axis=1)],
        ),
        Rule(
            (kernel("gate_proj"), kernel("up_proj")),
            (f"{layers}/mlp{suffix}/gating_einsum",),
            lambda arrays: [a for w in arrays for a in (w[:, 0], w[:, 1])],
            lambda gate, up: [np.stack([gate, up], axis=1)],
        ),
        reshaped(
            kernel("o_proj"),
            f"{layers}/attn/attn_vec_einsum{suffix}/w",
            (size.depth, -1, size.width),
            out,
        ),
        copied(kernel("down_proj"), f"{layers}/mlp{suffix}/linear"),
        copied(f"{ours}/input_layernorm/scale", f"{layers}/pre_attention_norm{suffix}/scale"),
        copied(f"{ours}/post_attention_layernorm/scale", f"{layers}/pre_ffw_norm{suffix}/scale"),
        copied(f"{tower}/norm/scale", f"{_LLM}/final_norm{suffix}/scale"),
    ]


def _heads_last(kernel: np.ndarray) -> np.ndarray:
    """`[L, N, D, H]` -> `[L, D, N H]`."""
    layers, _, width, _ = kernel.shape
    return kernel.swapaxes(1, 2).reshape(layers, width, -1)


def _heads_first(kernel: np.ndarray, heads: int) -> np.ndarray:
    """`[L, D, N H]` -> `[L, N, D, H]`."""
    layers, width, _ = kernel.shape
    return kernel.reshape(layers, width, heads, -1).swapaxes(1, 2)


def canonical_name(name: str) -> str:
    """LeRobot's name of today for a tensor: its towers have moved between versions."""
    if name.endswith("lm_head.weight"):
        return UNUSED["gemma_expert." in name]
    for mark, inner, tower in (
        ("vision_tower.", "vision_model.", _VISION),
        ("gemma_expert.", "model.", f"{_EXPERT}.model"),
        ("language_model.", "model.", _LANGUAGE),
        ("multi_modal_projector.", "", f"{_PALIGEMMA}.model.multi_modal_projector"),
    ):
        _, found, rest = name.partition(mark)
        if found:
            return f"{tower}.{rest.removeprefix(inner)}"
    return name


def lerobot_layout(config: Pi0Config) -> list[Rule]:
    """LeRobot's tensors by name without the leading "model." (policies/pi0/modeling_pi0.py)."""
    vision, tower = config.vision, _VISION
    patch = f"{tower}.embeddings.patch_embedding"
    rules = [
        Rule(
            ("vision/patch_embed/kernel",),
            (f"{patch}.weight",),
            lambda arrays: [w.transpose(2, 3, 1, 0).reshape(-1, w.shape[0]) for w in arrays],
            lambda k: [
                k.reshape(vision.patch, vision.patch, 3, vision.width).transpose(3, 2, 0, 1)
            ],
        ),
        copied("vision/patch_embed/bias", f"{patch}.bias"),
        copied("vision/position_embedding", f"{tower}.embeddings.position_embedding.weight"),
        *_norm("vision/norm", f"{tower}.post_layernorm"),
        *_linear("vision/head", f"{_PALIGEMMA}.model.multi_modal_projector.linear"),
        copied("language/embedding", f"{_LANGUAGE}.embed_tokens.weight"),
    ]
    layers = [f"{tower}.encoder.layers.{i}" for i in range(vision.depth)]
    parts = {name: f"self_attn.{name}" for name in ("q_proj", "k_proj", "v_proj", "out_proj")}
    for name, theirs in (parts | {"fc1": "mlp.fc1", "fc2": "mlp.fc2"}).items():
        rules += _linears(f"vision/blocks/{name}", [f"{layer}.{theirs}" for layer in layers])
    for name in ("layer_norm1", "layer_norm2"):
        theirs = [f"{layer}.{name}" for layer in layers]
        for leaf, torch in (("scale", "weight"), ("bias", "bias")):
            rules.append(stacked(f"vision/blocks/{name}/{leaf}", [f"{t}.{torch}" for t in theirs]))
    for name, theirs in (
        ("language", _LANGUAGE),
        ("action", f"{_EXPERT}.model"),
    ):
        rules += _lerobot_expert(name, theirs, config.language.depth)
    for name in _PROJECTIONS:
        rules += _linear(name, name)
    return rules


def _lerobot_expert(tower: str, theirs: str, depth: int) -> list[Rule]:
    layers = [f"{theirs}.layers.{i}" for i in range(depth)]
    parts = {name: f"self_attn.{name}" for name in ("q_proj", "k_proj", "v_proj", "o_proj")}
    parts |= {name: f"mlp.{name}" for name in ("gate_proj", "up_proj", "down_proj")}
    rules = [
        stacked(
            f"{tower}/blocks/{ours}/kernel", [f"{x}.{name}.weight" for x in layers], transpose=True
        )
        for ours, name in parts.items()
    ]
    rules += [
        stacked(f"{tower}/blocks/{name}/scale", [f"{x}.{name}.weight" for x in layers])
        for name in ("input_layernorm", "post_attention_layernorm")
    ]
    return [*rules, copied(f"{tower}/norm/scale", f"{theirs}.norm.weight")]


def _linear(ours: str, theirs: str) -> list[Rule]:
    return [
        transposed(f"{ours}/kernel", f"{theirs}.weight"),
        copied(f"{ours}/bias", f"{theirs}.bias"),
    ]


def _linears(ours: str, theirs: list[str]) -> list[Rule]:
    """The same of stacked layers."""
    return [
        stacked(f"{ours}/kernel", [f"{name}.weight" for name in theirs], transpose=True),
        stacked(f"{ours}/bias", [f"{name}.bias" for name in theirs]),
    ]


def _norm(ours: str, theirs: str) -> list[Rule]:
    return [copied(f"{ours}/scale", f"{theirs}.weight"), copied(f"{ours}/bias", f"{theirs}.bias")]


LAYOUTS = {"openpi": openpi_layout, "lerobot": lerobot_layout}
"""Function of a config that gives the rules, by the layout's name."""
