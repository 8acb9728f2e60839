"""LoRA-SP, Select-Prune (arXiv 2603.07404): a wide bank of rank-one directions, pruned per token.

A small router scores the R directions of a bank for each token; only the fewest whose squared
scores reach the energy target η stay active. One function per equation of the paper:

    (10) scores       s(x) = router(x) >= 0                           `router_scores`
    (12) energy gate  smallest k with E_k(x) >= η                     `energy_gate`
    (11) update       ΔW(x) = U Σ(x) V                                `select`
    (13) spectral     L_spec(x) = 1 - E_k(x)                          `spectral_loss`
    (14) router       L_router: balance and z                         `balance_loss`, `z_loss`

Where the paper is silent (activation, initialisation, scale, form of the router losses) the choices
are this project's; each is stated where it is made.
"""

import dataclasses
import math
from typing import Literal

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.energy_gate import Implementation, energy_gate, exact_ratio
from lorasp_jax.peft.method import Aux, Method, Params, kaiming_uniform, masked_mean

SOFTPLUS_INVERSE_OF_ONE = math.log(math.e - 1)
SCORE_INIT_STD = 0.01


@dataclasses.dataclass(frozen=True)
class LoRASP(Method):
    """Adapter with an input-dependent active rank.

    Parameters: bank.u [R, O], bank.v [I, R]; router.w1 [I, H], w2 [H, R] and, for the "gelu"
    router, b1 [H], b2 [R]. With H the hidden width: R (I + O) + H (I + R), and H + R biases.

    Raises:
      ValueError: a rank or width below 1, η outside (0, 1], or blocks that do not divide the rank.
    """

    rank: int = 128
    """R, size of the bank; it may exceed the kernel's sides (paper: 128 everywhere)."""
    energy_target: float = 0.9
    """η, read as an exact decimal."""
    alpha: float | None = None
    """α of the scale α/R; None is 2 R."""
    hidden_width: int = 32
    """H, width of the router's hidden layer."""
    router: Literal["gelu", "softmax"] = "gelu"
    """"gelu": GELU, biases, softplus scores, s = 1 at init. "softmax": softmax over H, no biases,
    second layer starting as the 0/1 matrix that spreads H values over R (paper's Table I)."""
    gate: Implementation | None = dataclasses.field(default=None, metadata={"saved": False})
    """Implementation of the energy gate, None: the backend's default. Not saved with adapters."""

    def __post_init__(self) -> None:
        """Checks the fields."""
        exact_ratio(self.energy_target)
        if self.rank < 1 or self.hidden_width < 1:
            raise ValueError(
                f"rank and hidden_width must be at least 1, got {self.rank}, {self.hidden_width}."
            )
        if self.router not in ("gelu", "softmax"):
            raise ValueError(f"router must be 'gelu' or 'softmax', got {self.router!r}.")
        if self.router == "softmax" and self.rank % self.hidden_width:
            raise ValueError(
                f"a softmax router needs a rank divisible by its width, got {self.rank} and "
                f"{self.hidden_width}."
            )

    @classmethod
    def paper(cls, *, rank: int = 128, energy_target: float = 0.9) -> "LoRASP":
        """The router whose parameter count is that of Table I: softmax over 4, no biases.

        The width is not in the paper; 4 is the only one that reproduces both of its percentages.
        """
        return cls(rank=rank, energy_target=energy_target, hidden_width=4, router="softmax")

    @property
    def scale(self) -> float:
        """α/R."""
        return 2.0 if self.alpha is None else self.alpha / self.rank

    def init_params(self, key: jax.Array, d_in: int, d_out: int) -> Params:
        """V and the router random, U zero: the delta starts at exactly zero."""
        input_key, score_key = jax.random.split(key)
        # V and W1 both read x and share one distribution: one draw, which compiles once.
        inputs = kaiming_uniform(input_key, (d_in, self.rank + self.hidden_width))
        v, w1 = jnp.split(inputs, [self.rank], axis=1)
        bank = {"u": jnp.zeros((self.rank, d_out)), "v": v}
        return {"bank": bank, "router": {"w1": w1, **self._init_scores(score_key)}}

    def _init_scores(self, key: jax.Array) -> dict[str, jax.Array]:
        """The router's second layer, and the biases of both."""
        shape = (self.hidden_width, self.rank)
        if self.router == "softmax":
            return {"w2": jnp.repeat(jnp.eye(shape[0]), shape[1] // shape[0], axis=1)}
        return {
            "b1": jnp.zeros(self.hidden_width),
            "w2": SCORE_INIT_STD * jax.random.normal(key, shape),
            "b2": jnp.full(self.rank, SOFTPLUS_INVERSE_OF_ONE),
        }

    def project(
        self, params: Params, x: jax.Array, token_mask: jax.Array | None
    ) -> tuple[jax.Array, jax.Array, Aux]:
        """z = scale Σ(x) V x and u = U of eq. (9), with the gate's statistics and losses."""
        scores, logits = router_scores(params["router"], x)
        mask, active_rank, kept_energy = energy_gate(
            scores, self.energy_target, implementation=self.gate
        )
        z = select(x @ params["bank"]["v"].astype(x.dtype), self.scale * scores, mask)
        valid = (scores != 0).any(-1)  # a row of zeros teaches the router nothing; NaN shows
        if token_mask is not None:
            valid &= token_mask
        losses = {
            "spectral": spectral_loss(kept_energy, valid),
            "balance": balance_loss(scores, mask, valid),
            "z": z_loss(logits, valid),
        }
        aux = Aux(active_rank, kept_energy, losses, token_mask)
        return z, params["bank"]["u"].astype(x.dtype), aux

    def merge(self, params: Params, kernel: jax.Array) -> jax.Array:
        """Raises: the delta depends on the input."""
        del params, kernel
        raise ValueError(
            "LoRA-SP chooses its directions per input and cannot be merged into one kernel; "
            "prune it (drop directions that stay inactive) or distill it into a LoRA first."
        )


def router_scores(router: dict[str, jax.Array], x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Eq. (10): h = φ(x W1 + b1), s(x) = h W2 + b2 made non-negative.

    With biases φ is GELU and softplus makes the scores positive. Without, φ is softmax, whose
    product with a 0/1 matrix is non-negative at the start; ReLU keeps it so.

    Args:
      router: w1 [I, H], w2 [H, R] and b1 [H], b2 [R] or none.
      x: [..., I]. The first product is in its type, everything after in fp32.

    Returns:
      scores f32 [..., R], and the logits the z-loss acts on: the softplus' input [..., R] or the
      softmax' input [..., H].
    """
    hidden = (x @ router["w1"].astype(x.dtype)).astype(jnp.float32)
    if "b1" not in router:
        return jax.nn.relu(jax.nn.softmax(hidden) @ router["w2"]), hidden
    logits = jax.nn.gelu(hidden + router["b1"]) @ router["w2"] + router["b2"]
    return jax.nn.softplus(logits), logits


def select(projected: jax.Array, scores: jax.Array, mask: jax.Array) -> jax.Array:
    """Eq. (11): Σ(x) V x with the pruned scores at zero, [..., R] in the type of `projected`."""
    return projected * jnp.where(mask, scores, 0).astype(projected.dtype)


def spectral_loss(kept_energy: jax.Array, valid: jax.Array) -> jax.Array:
    """Eq. (13): 1 - E_k, averaged over valid tokens."""
    return masked_mean(1 - kept_energy, valid)


def balance_loss(scores: jax.Array, mask: jax.Array, valid: jax.Array) -> jax.Array:
    """Balance term of eq. (14): R Σ_i f_i P_i, 1 where all directions are used alike.

    The load-balancing loss of Fedus et al. (arXiv 2101.03961, eq. 4) for k(x) choices a token: f_i
    is direction i's share of all kept places (no gradient), P_i its mean share of the energy. Both
    are means over the valid tokens of the whole batch.

    Args:
      scores: f32 [..., R].
      mask: bool [..., R], from the gate.
      valid: bool [...].
    """
    tokens = tuple(range(valid.ndim))
    count = jnp.maximum(valid.sum(), 1)
    weight = jnp.where(valid, 1.0, 0.0)[..., None] / count
    kept = jax.lax.stop_gradient(jnp.sum(weight * mask, axis=tokens))
    largest = jax.lax.stop_gradient(scores.max(-1, keepdims=True))
    energy = jnp.square(scores / jnp.where(largest > 0, largest, 1))
    total = energy.sum(-1, keepdims=True)
    share = jnp.sum(weight * energy / jnp.where(total > 0, total, 1), axis=tokens)
    return scores.shape[-1] * jnp.vdot(kept / jnp.maximum(kept.sum(), 1e-9), share)


def z_loss(logits: jax.Array, valid: jax.Array) -> jax.Array:
    """z term of eq. (14): (logsumexp(logits) - ln n)², n = logits' width, over valid tokens.

    Zoph et al. (arXiv 2202.08906, eq. 5) without the ln n, which would push the logits of a wide
    router down even where they are all zero.
    """
    log_mean = jax.nn.logsumexp(logits, axis=-1) - math.log(logits.shape[-1])
    return masked_mean(jnp.square(log_mean), valid)
