"""LoRA-SP, Select-Prune (arXiv 2603.07404): a wide bank of rank-one directions, pruned per token.

A small router scores the R directions of a bank for each token; only the fewest whose squared
scores reach the energy target η stay active. `reference` is the paper in sixty lines; the functions
that `LoRASP.bottleneck` puts together here compute the same, and faster:

    (10) scores       s(x) = router(x) >= 0                           `router.router_scores`
    (12) energy gate  smallest k with E_k(x) >= η                     `energy_gate`
    (11) update       ΔW(x) = U Σ(x) V                                `bank.apply_masked_scores`
    (13) spectral     L_spec(x) = 1 - E_k(x)                          `losses.spectral_loss`
    (14) router       L_router: balance and z                         `balance_loss`, `z_loss`

Where the paper is silent (activation, initialisation, scale, form of the router losses) the choices
are this project's; each is stated where it is made.
"""

import dataclasses

import jax
import jax.numpy as jnp
import optax

from lorasp_jax.kernels.energy_gate import default_implementation, energy_gate, kept_energy
from lorasp_jax.peft._aux import Aux
from lorasp_jax.peft._method import Params, kaiming_uniform
from lorasp_jax.peft.lora_sp.bank import BankMethod, apply_masked_scores, init_bank
from lorasp_jax.peft.lora_sp.gpu_kernel import FusedBottleneck
from lorasp_jax.peft.lora_sp.losses import Losses, loss_sums
from lorasp_jax.peft.lora_sp.router import (
    Granularity,
    Router,
    init_scores,
    pooled_scores,
    router_scores,
)
from lorasp_jax.peft.lora_sp.schedule import PROGRESS, EnergySchedule, gate_at, scheduling


@dataclasses.dataclass(frozen=True)
class LoRASP(BankMethod):
    """Adapter with an input-dependent active rank.

    Parameters: bank.u [R, O], bank.v [I, R]; router.w1 [I, H], w2 [H, R] and, but for a "softmax"
    router, b1 [H], b2 [R]. With H the hidden width: R (I + O) + H (I + R), and H + R biases. One
    number more each for a normalised bank (bank.gain) and for a moving η (progress).

    Raises:
      ValueError: a rank or width below 1, or η outside (0, 1].
    """

    rank: int = 128
    """R, size of the bank; it may exceed the kernel's sides (paper: 128 everywhere)."""
    energy_target: float = 0.9
    """η, read as an exact decimal."""
    alpha: float | None = None
    """α of the scale α/R; None is 2 R."""
    hidden_width: int = 32
    """H, width of the router's hidden layer."""
    router: Router = "gelu"
    """"gelu": a GELU layer with biases and softplus scores, 1 at the start. "gelu_relu",
    "gelu_softmax": the same with ReLU, or with R times the softmax over the directions. "softmax":
    softmax over H, no biases, second layer starting as a 0/1 matrix (paper's Table I)."""
    granularity: Granularity = "token"
    """What shares a mask, that of its `pooled_scores`: nothing ("token"), the tokens of a "sample"
    (the last token axis), or all of a "layer" (the whole batch)."""
    schedule: EnergySchedule | None = None
    """How η reaches `energy_target` while training; None: it is that from the start."""
    normalized_bank: bool = False
    """Keep the bank's directions orthonormal, so that the scores' energy is that of ΔW and eq. (4),
    ‖ΔW - ΔW_k‖ = √(1 - E_k) ‖ΔW‖, holds (see `bank`). Needs a side of at least R."""

    def __post_init__(self) -> None:
        """Checks the fields."""
        super().__post_init__()
        if self.hidden_width < 1:
            raise ValueError(f"hidden_width must be at least 1, got {self.hidden_width}.")

    @classmethod
    def paper(cls, *, rank: int = 128, energy_target: float = 0.9) -> "LoRASP":
        """The router whose parameter count is that of Table I: softmax over 4, no biases.

        The width is not in the paper; 4 is the only one that reproduces both of its percentages.
        """
        return cls(rank=rank, energy_target=energy_target, hidden_width=4, router="softmax")

    @property
    def score_arrays(self) -> tuple[str, ...]:
        """Names of the router's arrays whose last axis is that of the scores."""
        return "w2", "b2"

    def init_params(self, key: jax.Array, d_in: int, d_out: int) -> Params:
        """V and the router random, U (or its gain) zero: the delta starts at exactly zero."""
        input_key, score_key = jax.random.split(key)
        # V and W1 both read x and share one distribution: one draw, which compiles once.
        inputs = kaiming_uniform(input_key, (d_in, self.rank + self.hidden_width))
        v, w1 = jnp.split(inputs, [self.rank], axis=1)
        bank_key = jax.random.fold_in(key, 1)
        bank = init_bank(bank_key, v, d_out, normalized=self.normalized_bank)
        scores = init_scores(score_key, self.router, self.hidden_width, self.rank)
        params = {"bank": bank, "router": {"w1": w1, **scores}}
        return params | ({PROGRESS: jnp.zeros(())} if self.schedule else {})

    def bottleneck(
        self, params: Params, rows: jax.Array, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """z = scale Σ(x) V x of eq. (9) from x [V, W1], with the gate's statistics and losses."""
        tokens = rows.shape[:-1]
        valid = jnp.ones(tokens, bool) if token_mask is None else token_mask
        projected, hidden = jnp.split(rows.reshape(-1, rows.shape[-1]), [self.rank], axis=1)
        scores, logits = router_scores(params["router"], hidden, self.router)
        mask = self._mask(params, scores, valid)
        energy = kept_energy(scores, mask)[:, None]
        z = apply_masked_scores(projected, self.scale * scores, mask, energy)
        sums = loss_sums(scores, logits, mask, energy, valid.reshape(-1, 1))
        active_rank = mask.astype(jnp.float32).sum(-1).reshape(tokens)
        aux = Aux(active_rank, energy.reshape(tokens), Losses(sums), usage=sums.kept)
        return z.reshape(*tokens, self.rank), aux

    def _mask(self, params: Params, scores: jax.Array, valid: jax.Array) -> jax.Array:
        """The gate's mask, bool like scores [T, R or more]; what was pruned is never kept."""
        by_token = scores.reshape(*valid.shape, scores.shape[-1])
        pooled = pooled_scores(by_token, valid, self.granularity)
        if self.schedule is None:
            mask, _, _ = energy_gate(pooled, self.energy_target)
        else:
            mask = gate_at(pooled, self.schedule.target(params[PROGRESS], self.energy_target))
        if scores.shape[-1] > self.rank:
            mask &= jnp.arange(scores.shape[-1]) < self.rank
        return jnp.broadcast_to(mask, by_token.shape).reshape(scores.shape)

    def fused_kernel(self, params: Params) -> FusedBottleneck | None:
        """All of `bottleneck` as one kernel on an NVIDIA GPU, for the default router and gate."""
        scored = params["router"]["w2"].shape[-1]
        default = (self.router, self.granularity, self.schedule) == ("gelu", "token", None)
        if not default or scored > self.rank or default_implementation(scored) != "pallas":
            return None
        route = FusedBottleneck(self.rank, self.hidden_width, self.energy_target, self.scale)
        return route if route.fits else None

    def transform(
        self, optimizer: optax.GradientTransformation, total_steps: int
    ) -> optax.GradientTransformation:
        """The optimizer, which also moves a scheduled η over its `total_steps` steps."""
        return optimizer if self.schedule is None else scheduling(optimizer, total_steps)
