"""LoRA-SP for a single token, loading only its highest-scoring directions.

A dense matmul reads the whole bank, whatever the mask. For a single token, this memory traffic is
most of the cost, so `decode` gathers only `capacity` of the R rows of U and Vᵀ. Several tokens have
different active directions, so the dense matmul is faster for them. `python -m benchmarks.decoding`
measures when gathering pays off.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.energy_gate import energy_gate
from lorasp_jax.peft import LoRASP
from lorasp_jax.peft._method import Params
from lorasp_jax.peft.lora_sp.bank import apply_masked_scores, normalized_bank
from lorasp_jax.peft.lora_sp.router import router_scores


class DecodingParams(NamedTuple):
    """A layer's adapter, with each direction contiguous in memory."""

    u: jax.Array
    """[R, O]."""
    v: jax.Array
    """[R, I], transposed."""
    w1: jax.Array
    """[I, H]."""
    router: dict[str, jax.Array]
    """The router without W1."""


def prepare(method: LoRASP, params: Params, dtype: jax.typing.DTypeLike) -> DecodingParams:
    """Convert the parameters of one layer for `decode`, with bank and W1 in the compute dtype.

    Raises:
      ValueError: the granularity is not "token", or η has a schedule.
    """
    if (method.granularity, method.schedule) != ("token", None):
        raise ValueError(
            f"decoding single tokens needs granularity 'token' and no schedule, got {method}"
        )
    bank = normalized_bank(params["bank"]) if method.normalized_bank else params["bank"]
    router = dict(params["router"])
    w1 = router.pop("w1").astype(dtype)
    return DecodingParams(bank["u"].astype(dtype), bank["v"].T.astype(dtype), w1, router)


def decode(
    method: LoRASP, params: DecodingParams, x: jax.Array, *, capacity: int
) -> tuple[jax.Array, jax.Array]:
    """Compute the delta of one token from its highest-scoring active directions.

    Args:
      method: static.
      params: from `prepare`.
      x: [I], in the dtype passed to `prepare`.
      capacity: maximum number of directions to gather, 1 to R, static.

    Returns:
      delta [O], and the number of active directions beyond `capacity`, int32 []. If there are any,
      the lowest-scoring ones are left out of delta. Otherwise delta equals that of `method.delta`
      up to rounding.

    Raises:
      ValueError: `capacity` is not between 1 and R, or x has more than one token.
    """
    if not 1 <= capacity <= method.rank or x.ndim != 1:
        raise ValueError(
            f"decode needs a single token [I] and a capacity of 1 to {method.rank}, got "
            f"{list(x.shape)} and {capacity}"
        )
    scores, _ = router_scores(params.router, x @ params.w1, method.router)
    mask, _, energy = energy_gate(scores, method.energy_target)
    mask, scores = mask[: method.rank], scores[: method.rank]
    top_scores, index = jax.lax.top_k(jnp.where(mask, scores, 0), capacity)
    z = apply_masked_scores(params.v[index] @ x, method.scale * top_scores, top_scores > 0, energy)
    return z @ params.u[index], jnp.maximum(mask.sum() - capacity, 0)
