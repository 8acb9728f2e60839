"""Convert openpi's LoRA weights to equivalent adapters of our layers.

openpi adapts each einsum kernel W with A = `lora_a` and B = `lora_b`, which keep the kernel's head
axes (models/lora.py). For N heads of dimension H, width D, rank r, and s = alpha / r or alpha / √r:

    q_einsum, kv_einsum    [N, D, H]    ΔW[n] = s A[n] B[n], one pair (A, B) per head n
    attn_vec_einsum        [N, H, D]    ΔW[n] = s A[n] Σ_m B[m], the same sum over heads for every n
    gating_einsum, linear               ΔW = A B, without heads and independent of alpha

The first row becomes a LoRA of rank N r with a block-diagonal B, the others LoRAs of rank r. The
conversion is exact. Further training also updates the zeros outside B's diagonal blocks.
"""

from collections.abc import Mapping, MutableMapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.dense import AdapterParam
from lorasp_jax.models.checkpoints.layouts import ModelMismatchError
from lorasp_jax.models.config import ExpertConfig
from lorasp_jax.peft import LoRA

_LAYERS = "PaliGemma/llm/layers"
_TOWERS = {"language": "", "action": "_1"}  # our tower -> openpi's suffix
Pair = tuple[np.ndarray, np.ndarray]
"""A [L, ..., I, r] and B [L, ..., r, O]."""


def pop_lora(leaves: MutableMapping[str, Any]) -> dict[str, Any]:
    """Pop openpi's LoRA leaves and return them by path."""
    names = [name for name in leaves if name.endswith(("lora_a", "lora_b"))]
    return {name: leaves.pop(name) for name in names}


def attach(model: Any, leaves: Mapping[str, np.ndarray]) -> Any:
    """Attach openpi's LoRA weights to a pi0 model as adapters, at openpi's scale 1.

    Args:
        model: a pi0 model; it is not modified, but the result shares its arrays.
        leaves: LoRA arrays of one expert or both, from `pop_lora`, by "/"-joined path below
            `params`.

    Raises:
        ValueError: leaves are missing, unexpected or wrongly shaped.
    """
    pairs, remaining = {}, dict(leaves)
    for tower, suffix in _TOWERS.items():
        if any(f"einsum{suffix}/lora_" in name for name in leaves):
            pairs |= _expert_pairs(
                remaining, getattr(model.config, tower), f"{tower}/blocks", suffix
            )
    if remaining:
        raise ValueError(f"openpi's LoRA has unexpected leaves {', '.join(sorted(remaining)[:8])}")
    model = nnx.clone(model)
    for path, (a, b) in pairs.items():
        tower, _, name = path.split("/")
        layer = getattr(getattr(model, tower).blocks, name)
        layer.method = LoRA(a.shape[-1], alpha=float(a.shape[-1]))
        values = {"lora_a": jnp.asarray(a, jnp.float32), "lora_b": jnp.asarray(b, jnp.float32)}
        layer.adapter = AdapterParam(values)
    return model


def _expert_pairs(
    leaves: dict[str, np.ndarray], size: ExpertConfig, ours: str, suffix: str
) -> dict[str, Pair]:
    """Pop one expert's leaves and convert them to pairs (A, B) by our layers' paths."""
    layers, width, mlp = size.depth, size.width, size.mlp
    heads, kv_heads, head_dim = size.heads, size.kv_heads, size.head_dim

    def pair(name: str, *kernel: int) -> Pair:
        return _pop_pair(leaves, f"{_LAYERS}/{name}", (layers, *kernel))

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
        f"{ours}/o_proj": _sum_heads(*out),
        f"{ours}/gate_proj": gate,
        f"{ours}/up_proj": up,
        f"{ours}/down_proj": down,
    }


def _pop_pair(leaves: dict[str, np.ndarray], prefix: str, kernel: tuple[int, ...]) -> Pair:
    """Pop A [..., I, r] and B [..., r, O] of a kernel [..., I, O] from `leaves`."""
    names = f"{prefix}lora_a", f"{prefix}lora_b"
    if missing := [name for name in names if name not in leaves]:
        raise ValueError(f"openpi's LoRA lacks {missing[0]}")
    a, b = (leaves.pop(name) for name in names)
    *outer, d_in, d_out = kernel
    rank = a.shape[-1] if a.ndim else 0
    if (a.shape, b.shape) != ((*outer, d_in, rank), (*outer, rank, d_out)):
        raise ModelMismatchError(f"{names[0]} {a.shape} and {b.shape} do not fit {kernel}")
    return a, b


def _per_head(a: np.ndarray, b: np.ndarray) -> Pair:
    """A [L, N, D, r], B [L, N, r, H] -> A [L, D, N r], block-diagonal B [L, N r, N H]."""
    layers, heads, width, rank = a.shape
    blocks = np.zeros((layers, heads, rank, heads, b.shape[-1]), b.dtype)
    for n in range(heads):
        blocks[:, n, :, n] = b[:, n]
    return a.swapaxes(1, 2).reshape(layers, width, -1), blocks.reshape(layers, heads * rank, -1)


def _sum_heads(a: np.ndarray, b: np.ndarray) -> Pair:
    """A [L, N, H, r], B [L, N, r, D] -> A [L, N H, r], B [L, r, D]."""
    return a.reshape(len(a), -1, a.shape[-1]), b.sum(axis=1)
