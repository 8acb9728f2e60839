"""LoRA-SP, Select-Prune (arXiv 2603.07404): a wide bank of rank-one directions, pruned per token.

A small router scores the R directions of a bank for each token; only the fewest whose squared
scores reach the energy target η stay active. One function per equation of the paper:

    (10) scores       s(x) = router(x) >= 0                           `router_scores`
    (12) energy gate  smallest k with E_k(x) >= η                     `energy_gate`
    (11) update       ΔW(x) = U Σ(x) V                                `select`
    (13) spectral     L_spec(x) = 1 - E_k(x)                          `spectral_loss`
    (14) router       L_router: balance and z                         `balance_loss`, `z_loss`

Where the paper is silent (activation, initialisation, scale, form of the router losses) the choices
are this project's; each is stated where it is made, the router's in `router`.
"""

import dataclasses
import functools
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax

from lorasp_jax.kernels.energy_gate import (
    Implementation,
    default_implementation,
    energy_gate,
    exact_ratio,
)
from lorasp_jax.kernels.fused_rows import fused_rows
from lorasp_jax.kernels.packing import PackedTree
from lorasp_jax.peft._aux import Aux
from lorasp_jax.peft._method import Method, Params, kaiming_uniform
from lorasp_jax.peft.lora_sp import release, schedule
from lorasp_jax.peft.lora_sp import router as routing
from lorasp_jax.peft.lora_sp.bank import init_bank, normalized_bank

Rule = Literal["paper", "release"]
# Traced and lowered once for all equal layers of a model, with and without its gradient.
_route_once = jax.jit(
    routing.route, static_argnames=("energy_target", "scale", "gate", "score_function")
)


@dataclasses.dataclass(frozen=True)
class LoRASP(Method):
    """Adapter with an input-dependent active rank.

    Parameters: bank.u [R, O], bank.v [I, R]; router.w1 [I, H], w2 [H, R] and, for the "gelu"
    router, b1 [H], b2 [R]. With H the hidden width: R (I + O) + H (I + R), and H + R biases. A
    "linear" router is w1 [I, R] alone. One number more each for a normalised bank (bank.gain) and
    for a moving η (progress).

    Raises:
      ValueError: a rank or width below 1, η outside (0, 1], blocks that do not divide the rank, or
        settings that exclude each other.
    """

    rank: int = 128
    """R, size of the bank; it may exceed the kernel's sides (paper: 128 everywhere)."""
    energy_target: float = 0.9
    """η, read as an exact decimal."""
    alpha: float | None = None
    """α of the scale α/R; None is 2 R."""
    hidden_width: int = 32
    """H, width of the router's hidden layer."""
    router: routing.Router = "gelu"
    """"gelu": GELU, biases, s = 1 at init. "softmax": softmax over H, no biases, second layer
    starting as the 0/1 matrix that spreads H values over R (paper's Table I). "linear": one layer
    of signed scores, for the rule of the release."""
    score_function: routing.ScoreFunction = "softplus"
    """What makes the scores of a "gelu" router non-negative: softplus, relu, or R times softmax."""
    rule: Rule = "paper"
    """"release": signed scores, gate and losses of `lorasp_jax.peft.lora_sp.release`."""
    granularity: routing.Granularity = "token"
    """What shares a mask, that of its `pooled_scores`: nothing ("token"), the tokens of a "sample"
    (the last token axis), or all of a "layer" (the whole batch)."""
    energy_start: float | None = None
    """η at the first step, None: always `energy_target`; see `lorasp_jax.peft.lora_sp.schedule`."""
    energy_curve: schedule.Curve = "linear"
    """How η goes from start to target."""
    energy_share: float = 0.5
    """Share of the steps in which it does."""
    normalized_bank: bool = False
    """Keep the bank's directions orthonormal, so that the scores' energy is that of ΔW and eq. (4),
    ‖ΔW - ΔW_k‖ = √(1 - E_k) ‖ΔW‖, holds (see `bank`). Needs a side of at least R."""
    pruned: int = 0
    """Directions that pruning dropped. The router still scores them, behind the R others, as their
    energy counts in E_k."""
    gate: Implementation | None = dataclasses.field(default=None, metadata={"saved": False})
    """Implementation of the energy gate, None: the backend's default. Not saved with adapters."""

    def __post_init__(self) -> None:
        """Checks the fields."""
        super().__post_init__()
        exact_ratio(self.energy_target)
        if self.energy_start is not None:
            exact_ratio(self.energy_start)
        if self.rank < 1 or self.hidden_width < 1 or self.pruned < 0:
            raise ValueError(
                "rank and hidden_width must be at least 1 and pruned not negative, got "
                f"{self.rank}, {self.hidden_width}, {self.pruned}."
            )
        if not 0 < self.energy_share <= 1:
            raise ValueError(f"energy_share must lie in (0, 1], got {self.energy_share}.")
        if self.router == "softmax" and self.scored % self.hidden_width:
            raise ValueError(
                f"a softmax router needs a rank divisible by its width, got {self.scored} and "
                f"{self.hidden_width}."
            )
        self._check_combination()

    def _check_combination(self) -> None:
        """Raises a ValueError for a setting that another one would leave without effect."""
        if self.router != "gelu" and self.score_function != "softplus":
            raise ValueError(f"only a 'gelu' router has a score_function, not {self.router!r}.")
        if self.router == "linear" and self.rule != "release":
            raise ValueError("a 'linear' router has signed scores, which need rule 'release'.")
        changed = (self.granularity, self.energy_start) != ("token", None)
        if self.rule == "release" and (self.router == "gelu" or changed):
            raise ValueError(
                "rule 'release' needs a 'linear' or 'softmax' router, masks by token and a "
                "constant energy_target."
            )

    @classmethod
    def paper(cls, *, rank: int = 128, energy_target: float = 0.9) -> "LoRASP":
        """The router whose parameter count is that of Table I: softmax over 4, no biases.

        The width is not in the paper; 4 is the only one that reproduces both of its percentages.
        """
        return cls(rank=rank, energy_target=energy_target, hidden_width=4, router="softmax")

    @classmethod
    def release(
        cls, *, rank: int = 128, energy_target: float = 0.9, projection: bool = False
    ) -> "LoRASP":
        """The public code's rule, which is not the paper's; only to compare with its results.

        `projection` takes its option `router_projection`, softmax over 4 and a matrix, instead of
        its default, one linear layer. Its dropout of 5 % on the router's input is left out.
        """
        router, width = ("softmax", 4) if projection else ("linear", rank)
        return cls(rank, energy_target, hidden_width=width, router=router, rule="release")

    @property
    def scored(self) -> int:
        """How many directions the router scores."""
        return self.rank + self.pruned

    @property
    def scale(self) -> float:
        """α/R."""
        return 2.0 if self.alpha is None else self.alpha / self.rank

    def init_params(self, key: jax.Array, d_in: int, d_out: int) -> Params:
        """V and the router random, U (or its gain) zero: the delta starts at exactly zero."""
        input_key, score_key = jax.random.split(key)
        width = self.scored if self.router == "linear" else self.hidden_width
        # V and W1 both read x and share one distribution: one draw, which compiles once.
        inputs = kaiming_uniform(input_key, (d_in, self.rank + width))
        v, w1 = jnp.split(inputs, [self.rank], axis=1)
        bank_key = jax.random.fold_in(key, 1)
        bank = init_bank(bank_key, v, d_out, normalized=self.normalized_bank)
        sides = self.hidden_width, self.scored
        scores = routing.init_scores(score_key, self.router, self.score_function, *sides)
        params = {"bank": bank, "router": {"w1": w1, **scores}}
        moves = self.energy_start is not None
        return params | ({schedule.PROGRESS: jnp.zeros(())} if moves else {})

    def down(self, params: Params) -> jax.Array:
        """[V, W1]."""
        return jnp.concatenate([self._bank(params)["v"], params["router"]["w1"]], axis=1)

    def between(
        self, params: Params, rows: jax.Array, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """z = scale Σ(x) V x of eq. (9), with the gate's statistics and losses."""
        tokens = rows.shape[:-1]
        counts = jnp.ones(tokens, bool) if token_mask is None else token_mask
        routed = self._route_released if self.rule == "release" else self._route
        z, losses, usage, statistics = routed(self._routing(params), rows, counts)
        active_rank, energy = (column.reshape(tokens) for column in statistics)
        return z.reshape(*tokens, self.rank), Aux(active_rank, energy, losses, usage=usage)

    def between_all(
        self, params: Params, read: jax.Array, columns: range, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """`between` of n layers, where possible in one kernel that finds its columns in `read`."""
        if not self.gains_together:
            return super().between_all(params, read, columns, token_mask)
        tokens, n = read.shape[:-1], len(columns)
        counts = jnp.ones(tokens, bool) if token_mask is None else token_mask
        z, sums, statistics = self._fused(params["router"], read, counts, columns.start)
        active_rank, energy = (column.T.reshape(n, *tokens) for column in statistics)
        aux = Aux(active_rank, energy, routing.Losses(sums), usage=sums.kept)
        return z.reshape(*tokens, -1), aux

    def _fused(self, router: Any, rows: jax.Array, counts: jax.Array, start: int = 0) -> tuple:
        """z, sums and statistics of `route`, in one kernel."""
        function = functools.partial(
            routing.route, energy_target=self.energy_target, scale=self.scale, gate="block"
        )
        flat, widths = rows.reshape(-1, rows.shape[-1]), (self.rank, self.hidden_width)
        return fused_rows(function, router, flat, widths, counts.reshape(-1, 1), start=start)

    def for_rows(self, params: Params) -> Params:
        """The parameters without [V, W1] and U, and for the kernel the router's in a row."""
        params = {name: p for name, p in self._routing(params).items() if name != "bank"}
        return params | ({"router": PackedTree.of(params["router"])} if self.gains_together else {})

    def _routing(self, params: Params) -> Params:
        """The parameters with the router's but for W1, unless they are in a row."""
        router = params["router"]
        if isinstance(router, PackedTree):
            return params
        return {**params, "router": {name: p for name, p in router.items() if name != "w1"}}

    def up(self, params: Params) -> jax.Array:
        """U."""
        return self._bank(params)["u"]

    def _bank(self, params: Params) -> Params:
        return normalized_bank(params["bank"]) if self.normalized_bank else params["bank"]

    def _route(self, params: Params, rows: jax.Array, counts: jax.Array) -> routing.Routed:
        """`route` of x [V W1], [...tokens, R + H], where possible in one kernel."""
        router = params["router"]
        if self.gains_together:
            z, sums, statistics = self._fused(router, rows, counts)
        else:
            kept = self._shared_mask(params, rows, counts)
            columns = jnp.split(rows.reshape(-1, rows.shape[-1]), [self.rank], axis=1)
            z, sums, _, statistics = _route_once(
                router,
                columns,
                counts.reshape(-1, 1),
                kept,
                energy_target=self.energy_target,
                scale=self.scale,
                gate=self.gate,
                score_function=self.score_function,
            )
        return z, routing.Losses(sums), sums.kept, statistics

    def _gates_alone(self) -> bool:
        """Whether the mask of a row takes no more than its scores."""
        return (self.granularity, self.energy_start, self.pruned) == ("token", None, 0)

    @property
    def gains_together(self) -> bool:
        """Whether all between the matrices is one kernel."""
        plain = (self.router, self.score_function, self.rule) == ("gelu", "softplus", "paper")
        # Triton's blocks have sides that are powers of two, its matrix product 16 at least.
        fits = all(side >= 16 and side.bit_count() == 1 for side in (self.rank, self.hidden_width))
        gate = self.gate or default_implementation(self.scored)
        return gate == "pallas" and plain and self._gates_alone() and fits

    def _shared_mask(self, params: Params, rows: jax.Array, counts: jax.Array) -> jax.Array | None:
        """The mask, bool [T, R], where it takes more than each row's scores; else None."""
        if self._gates_alone():
            return None
        hidden = rows[..., self.rank :]
        scores, _ = routing.router_scores(params["router"], hidden, self.score_function)
        pooled = routing.pooled_scores(scores, counts, self.granularity)
        if self.energy_start is None:
            mask, _, _ = energy_gate(pooled, self.energy_target, implementation=self.gate)
        else:
            ends = (self.energy_start, self.energy_target)
            moved = (params[schedule.PROGRESS], *ends, self.energy_share, self.energy_curve)
            mask = schedule.gate_at(pooled, schedule.scheduled_target(*moved))
        mask &= jnp.arange(self.scored) < self.rank
        return jnp.broadcast_to(mask, scores.shape).reshape(-1, self.scored)

    def _route_released(self, params: Params, rows: jax.Array, counts: jax.Array) -> routing.Routed:
        """What `_route` gives, by the rule of the public code."""
        columns = jnp.split(rows, [self.rank], axis=-1)
        settings = {"energy_target": self.energy_target, "scale": self.scale}
        return release.release_route(params["router"], columns, counts, **settings)

    def transform(
        self, optimizer: optax.GradientTransformation, total_steps: int
    ) -> optax.GradientTransformation:
        """The optimizer, which also moves a scheduled η over its `total_steps` steps."""
        if self.energy_start is None:
            return optimizer
        return schedule.scheduling(optimizer, total_steps)

    def merge(self, params: Params, kernel: jax.Array) -> jax.Array:
        """Raises: the delta depends on the input."""
        del params, kernel
        raise ValueError(
            "LoRA-SP chooses its directions per input and cannot be merged into one kernel; "
            "prune it (drop directions that stay inactive) or distill it into a LoRA first."
        )
