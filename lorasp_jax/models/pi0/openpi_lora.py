"""LoRA as openpi trains and stores it, as adapters of our layers that compute the same.

openpi has two matrices for each einsum kernel, with the kernel's head axes (its models/lora.py).
W is a kernel, A and B its `lora_a` and `lora_b`, n a head, s = alpha / rank, or alpha / √rank:

    q_einsum, kv_einsum    [N, D, H]    ΔW[n] = s A[n] B[n], one pair for each head
    attn_vec_einsum        [N, H, D]    ΔW[n] = s A[n] Σ_m B[m]: the heads are summed in between
    gating_einsum, linear               ΔW = A B, whatever alpha is

As one matrix the first is a LoRA of rank N r whose B is block-diagonal, the second one of rank r.
Both are exact; under further training the zeros between the blocks fill like any other number.
"""

from collections.abc import Mapping, MutableMapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.dense import AdapterParam
from lorasp_jax.models.checkpoints.layouts import OtherModelError
from lorasp_jax.models.config import ExpertConfig
from lorasp_jax.peft import LoRA

_LAYERS = "PaliGemma/llm/layers"
_TOWERS = {"language": "", "action": "_1"}
Pair = tuple[np.ndarray, np.ndarray]
"""A [L, I, R] and B [L, R, O]."""


def taken(leaves: MutableMapping[str, Any]) -> dict[str, Any]:
    """openpi's leaves that belong to LoRA, by path; taken out of `leaves`."""
    names = [name for name in leaves if name.endswith(("lora_a", "lora_b"))]
    return {name: leaves.pop(name) for name in names}


def adapted(model: Any, leaves: Mapping[str, np.ndarray], *, scale: float = 1.0) -> Any:
    """A pi0 with openpi's LoRA as its adapters.

    Args:
        model: left untouched; the result shares its arrays.
        leaves: openpi's arrays by "/"-joined path below `params`, those of `taken`, for one expert
            or both.
        scale: openpi's alpha / rank of the attention, alpha / √rank under its `rslora`; checkpoints
            do not hold it. Its own variants have 1.

    Raises:
        ValueError: a leaf is missing, left over or does not fit the model.
    """
    pairs, left = {}, dict(leaves)
    for tower, suffix in _TOWERS.items():
        if any(f"einsum{suffix}/lora_" in name for name in leaves):
            pairs |= _expert(left, getattr(model.config, tower), f"{tower}/blocks", suffix)
    if left or not pairs:
        raise ValueError(f"openpi's LoRA has no leaves {', '.join(sorted(left)[:8]) or 'at all'}.")
    model = nnx.clone(model)
    for path, (a, b) in pairs.items():
        tower, _, name = path.split("/")
        layer = getattr(getattr(model, tower).blocks, name)
        rank = a.shape[-1]
        layer.method = LoRA(rank, alpha=rank * (scale if _attends(name) else 1.0))
        values = {"lora_a": jnp.asarray(a, jnp.float32), "lora_b": jnp.asarray(b, jnp.float32)}
        layer.adapter = AdapterParam(values)
    return model


def _attends(name: str) -> bool:
    return name in ("q_proj", "k_proj", "v_proj", "o_proj")


def _expert(
    left: dict[str, np.ndarray], size: ExpertConfig, ours: str, suffix: str
) -> dict[str, Pair]:
    """Pairs by path of our layer; takes what they are made of out of `left`."""
    layers, width, mlp = size.depth, size.width, size.mlp
    heads, kv_heads, head_dim = size.heads, size.kv_heads, size.head_dim

    def pair(name: str, *kernel: int) -> Pair:
        return _pair(left, f"{_LAYERS}/{name}", (layers, *kernel))

    q = pair(f"attn/q_einsum{suffix}/", heads, width, head_dim)
    keys_values = pair(f"attn/kv_einsum{suffix}/", 2, kv_heads, width, head_dim)
    out = pair(f"attn/attn_vec_einsum{suffix}/", heads, head_dim, width)
    gating = pair(f"mlp{suffix}/gating_einsum_", 2, width, mlp)
    down = pair(f"mlp{suffix}/linear_", mlp, width)
    (k, v), (gate, up) = ([(a[:, i], b[:, i]) for i in (0, 1)] for a, b in (keys_values, gating))
    return {
        f"{ours}/q_proj": _per_head(*q),
        f"{ours}/k_proj": _per_head(*k),
        f"{ours}/v_proj": _per_head(*v),
        f"{ours}/o_proj": _summed(*out),
        f"{ours}/gate_proj": gate,
        f"{ours}/up_proj": up,
        f"{ours}/down_proj": down,
    }


def _pair(left: dict[str, np.ndarray], name: str, kernel: tuple[int, ...]) -> Pair:
    """A [..., I, R] and B [..., R, O] of a kernel [..., I, O], taken out of `left`."""
    names = f"{name}lora_a", f"{name}lora_b"
    for each in names:
        if each not in left:
            raise ValueError(f"openpi's LoRA lacks {each}.")
    a, b = (left.pop(each) for each in names)
    *outer, d_in, d_out = kernel
    rank = a.shape[-1] if a.ndim else 0
    if (a.shape, b.shape) != ((*outer, d_in, rank), (*outer, rank, d_out)):
        raise OtherModelError(
            f"openpi's LoRA has {names[0]} and lora_b of shapes {a.shape} and {b.shape}, "
            f"but the model's kernel is {kernel}."
        )
    return a, b


def _per_head(a: np.ndarray, b: np.ndarray) -> Pair:
    """A [L, N, D, r], B [L, N, r, H] -> [L, D, N r] and the block-diagonal [L, N r, N H]."""
    layers, heads, width, rank = a.shape
    blocks = np.zeros((layers, heads, rank, heads, b.shape[-1]), b.dtype)
    for n in range(heads):
        blocks[:, n, :, n] = b[:, n]
    return a.swapaxes(1, 2).reshape(layers, width, -1), blocks.reshape(layers, heads * rank, -1)


def _summed(a: np.ndarray, b: np.ndarray) -> Pair:
    """A [L, N, H, r], B [L, N, r, D] -> [L, N H, r] and [L, r, D]."""
    return a.reshape(len(a), -1, a.shape[-1]), b.sum(axis=1)
