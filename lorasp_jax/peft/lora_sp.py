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
import functools
import math
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.energy_gate import (
    Implementation,
    default_implementation,
    energy_gate,
    energy_share,
    exact_ratio,
    kept_energy,
)
from lorasp_jax.kernels.fused_rows import fused_rows
from lorasp_jax.peft.method import Aux, Method, Params, kaiming_uniform

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

    def down(self, params: Params) -> jax.Array:
        """[V, W1]."""
        return jnp.concatenate([params["bank"]["v"], params["router"]["w1"]], axis=1)

    def between(
        self, params: Params, rows: jax.Array, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """z = scale Σ(x) V x of eq. (9), with the gate's statistics and losses."""
        router = {name: p for name, p in params["router"].items() if name != "w1"}
        *tokens, width = rows.shape
        counts = jnp.ones(tokens, bool) if token_mask is None else token_mask
        z, sums, (active_rank, energy) = self._route(
            router, rows.reshape(-1, width), counts.reshape(-1, 1)
        )
        losses = {
            "spectral": spectral_loss(sums),
            "balance": balance_loss(sums),
            "z": z_loss(sums),
        }
        aux = Aux(active_rank.reshape(tokens), energy.reshape(tokens), losses)
        return z.reshape(*tokens, self.rank), aux

    def up(self, params: Params) -> jax.Array:
        """U."""
        return params["bank"]["u"]

    def _route(
        self, router: dict[str, jax.Array], rows: jax.Array, counts: jax.Array
    ) -> tuple[jax.Array, "LossSums", list[jax.Array]]:
        """`route` of x [V W1], [T, R + H], where possible in one kernel."""
        gate = self.gate or default_implementation(self.rank)
        widths = (self.rank, self.hidden_width)
        function = functools.partial(route, energy_target=self.energy_target, scale=self.scale)
        if gate == "pallas" and self.router == "gelu" and all(map(_fits_triton, widths)):
            function = functools.partial(function, gate="block")
            return fused_rows(function, router, rows, widths, counts)
        columns = jnp.split(rows, widths[:1], axis=1)
        z, sums, _, statistics = function(router, columns, counts, None, gate=gate)
        return z, sums, statistics

    def merge(self, params: Params, kernel: jax.Array) -> jax.Array:
        """Raises: the delta depends on the input."""
        del params, kernel
        raise ValueError(
            "LoRA-SP chooses its directions per input and cannot be merged into one kernel; "
            "prune it (drop directions that stay inactive) or distill it into a LoRA first."
        )


def _fits_triton(side: int) -> bool:
    """Whether a side of an array suits Triton's blocks and matrix product."""
    return side >= 16 and side.bit_count() == 1


def route(
    router: dict[str, jax.Array],
    columns: list[jax.Array],
    counts: jax.Array,
    kept: jax.Array | None,
    *,
    energy_target: float,
    scale: float,
    gate: Implementation,
) -> tuple[jax.Array, "LossSums", jax.Array, list[jax.Array]]:
    """Everything between the two matrix products with the bank, row by row.

    Args:
      router: w2 [H, R], and b1 [H], b2 [R] or none.
      columns: V x [n, R] and W1 x [n, H] in one type.
      counts: bool [n, 1], False for padding.
      kept: bool [n, R], the gate's mask where it is known already; it has no gradient.
      energy_target: η.
      scale: α/R.
      gate: implementation of the energy gate.

    Returns:
      z [n, R], the losses' sums over rows, the mask, and f32 [n, 1] each active rank and kept
      energy.
    """
    projected, hidden = columns
    scores, logits = router_scores(router, hidden)
    mask = energy_gate(scores, energy_target, implementation=gate)[0] if kept is None else kept
    energy = kept_energy(scores, mask)[:, None]
    z = select(projected, scale * scores, mask)
    active_rank = mask.astype(jnp.float32).sum(-1, keepdims=True)
    return z, loss_sums(scores, logits, mask, energy, counts), mask, [active_rank, energy]


def router_scores(router: dict[str, jax.Array], hidden: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Eq. (10): h = φ(x W1 + b1), s(x) = h W2 + b2 made non-negative.

    With biases φ is GELU and softplus makes the scores positive. Without, φ is softmax, whose
    product with a 0/1 matrix is non-negative at the start; ReLU keeps it so.

    Args:
      router: w2 [H, R] and b1 [H], b2 [R] or none.
      hidden: x W1, [..., H]; everything from here on is in fp32.

    Returns:
      scores f32 [..., R], and the logits the z-loss acts on: the softplus' input [..., R] or the
      softmax' input [..., H].
    """
    hidden = hidden.astype(jnp.float32)
    if "b1" not in router:
        return jax.nn.relu(jax.nn.softmax(hidden) @ router["w2"]), hidden
    logits = jax.nn.gelu(hidden + router["b1"]) @ router["w2"] + router["b2"]
    return jax.nn.softplus(logits), logits


def select(projected: jax.Array, scores: jax.Array, mask: jax.Array) -> jax.Array:
    """Eq. (11): Σ(x) V x with the pruned scores at zero, [..., R] in the type of `projected`."""
    return projected * jnp.where(mask, scores, 0).astype(projected.dtype)


class LossSums(NamedTuple):
    """What the auxiliary losses need, summed over the valid rows: f32 [1], kept and share [R]."""

    rows: jax.Array
    spectral: jax.Array
    """1 - E_k."""
    z: jax.Array
    """Squared mean logit, on the scale of exponentials."""
    kept: jax.Array
    """1 for each kept direction; no gradient."""
    share: jax.Array
    """Share of the energy."""


def loss_sums(
    scores: jax.Array, logits: jax.Array, mask: jax.Array, energy: jax.Array, counts: jax.Array
) -> LossSums:
    """The sums for scores and mask [n, R], logits [n, :], kept energy and counts [n, 1].

    A row of zeros is not valid: it teaches the router nothing. NaN shows in the sums.
    """
    valid = (scores.max(-1, keepdims=True) != 0) & counts
    mean_logit = jax.nn.logsumexp(logits, axis=-1, keepdims=True) - math.log(logits.shape[-1])

    def total(values: jax.Array) -> jax.Array:
        return jnp.where(valid, values, 0).sum(0)

    return LossSums(
        rows=total(jnp.ones_like(energy)),
        spectral=total(1 - energy),
        z=total(jnp.square(mean_logit)),
        kept=total(mask.astype(jnp.float32)),
        share=total(energy_share(scores)),
    )


def spectral_loss(sums: LossSums) -> jax.Array:
    """Eq. (13): 1 - E_k, averaged over valid rows, f32 scalar."""
    return _mean(sums.spectral, sums)


def balance_loss(sums: LossSums) -> jax.Array:
    """Balance term of eq. (14): R Σ_i f_i P_i, 1 where all directions are used alike.

    The load-balancing loss of Fedus et al. (arXiv 2101.03961, eq. 4) for k(x) choices a token: f_i
    is direction i's share of all kept places (no gradient), P_i its mean share of the energy.
    """
    kept = jax.lax.stop_gradient(sums.kept)
    used = kept / jnp.maximum(kept.sum(), 1)
    return len(kept) * _mean(jnp.sum(used * sums.share, keepdims=True), sums)


def z_loss(sums: LossSums) -> jax.Array:
    """z term of eq. (14): (logsumexp(logits) - ln n)², n = logits' width, over valid rows.

    Zoph et al. (arXiv 2202.08906, eq. 5) without the ln n, which would push the logits of a wide
    router down even where they are all zero.
    """
    return _mean(sums.z, sums)


def _mean(total: jax.Array, sums: LossSums) -> jax.Array:
    return total[0] / jnp.maximum(sums.rows[0], 1)
