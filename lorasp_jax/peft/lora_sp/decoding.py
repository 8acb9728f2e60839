"""LoRA-SP for one token at a time, reading only the directions that are active.

A dense product with the bank costs the same whatever the mask says. For a single token the bank's
memory traffic is the cost, and reading k of R rows of U and Vᵀ saves most of it. For several tokens
each has its own directions, and the dense product is the better one; hence one token only. Where it
pays is measured by `python -m benchmarks.decoding`.
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
    """A layer's adapter, laid out so that a direction is contiguous in memory."""

    u: jax.Array
    """[R, O]."""
    v: jax.Array
    """[R, I], transposed."""
    w1: jax.Array
    """[I, H]."""
    router: dict[str, jax.Array]
    """The rest of the router."""


def prepare(method: LoRASP, params: Params, dtype: jax.typing.DTypeLike) -> DecodingParams:
    """The parameters of one layer for `decode`, bank and W1 in the type of the computation.

    Raises:
      ValueError: a method whose masks depend on more than the token.
    """
    if (method.granularity, method.schedule) != ("token", None):
        raise ValueError(
            f"decoding by token needs granularity 'token' and no schedule, got {method}."
        )
    bank = normalized_bank(params["bank"]) if method.normalized_bank else params["bank"]
    router = dict(params["router"])
    w1 = router.pop("w1").astype(dtype)
    return DecodingParams(bank["u"].astype(dtype), bank["v"].T.astype(dtype), w1, router)


def decode(
    method: LoRASP, params: DecodingParams, x: jax.Array, *, capacity: int
) -> tuple[jax.Array, jax.Array]:
    """The delta of one token from its active directions: z = Σ(x) V x, then z U, by gathered rows.

    Args:
      method: static.
      params: from `prepare`.
      x: [I], in the type given there.
      capacity: most directions that are read, 1 to R, static.

    Returns:
      delta [O], that of `method.delta` to rounding while at most `capacity` directions are active;
      and how many active ones found no room, int32 []. Those with the lowest scores are left out.

    Raises:
      ValueError: a capacity outside 1 to R, or more than one token.
    """
    if not 1 <= capacity <= method.rank or x.ndim != 1:
        raise ValueError(
            f"decode takes one token [I] and a capacity of 1 to {method.rank}, got "
            f"{list(x.shape)} and {capacity}."
        )
    scores, _ = router_scores(params.router, x @ params.w1, method.router)
    mask, _, energy = energy_gate(scores, method.energy_target)
    mask, scores = mask[: method.rank], scores[: method.rank]
    largest, index = jax.lax.top_k(jnp.where(mask, scores, 0), capacity)
    z = apply_masked_scores(params.v[index] @ x, method.scale * largest, largest > 0, energy)
    return z @ params.u[index], jnp.maximum(mask.sum() - capacity, 0)
