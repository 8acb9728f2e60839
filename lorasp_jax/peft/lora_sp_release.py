"""LoRA-SP by the rule of its public code, which differs from the paper's equations.

For parity with results made by that code, github.com/dhkim-furiosa/LoRA-SP at dfbf57d, PyTorch;
only facts about it are used here. Against the paper (`lora_sp`): scores may be negative and are
ranked with their signs; the gate keeps the most directions whose energy stays *within* η, and
always one, so E_k mostly falls short of η; the spectral loss is a ratio of sums over tokens;
balance is Switch's on a softmax over all scores with the pruned ones at 0; the z-loss is ln(1 +
lse), cut to lse in [-1, 10], which is -inf at the lower end.

Unlike there, padding stays out and everything is in fp32. Its dropout of 5 % on the router's input
is left out.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.energy_gate import kept_energy
from lorasp_jax.peft._aux import Aux, masked_mean
from lorasp_jax.peft._method import Params, kaiming_uniform
from lorasp_jax.peft.lora_sp.bank import BankMethod, apply_masked_scores, init_bank
from lorasp_jax.peft.lora_sp.router import bounded, init_scores


@dataclasses.dataclass(frozen=True)
class LoRASPRelease(BankMethod):
    """Adapter with an input-dependent active rank, only to compare with the public code's results.

    Parameters: bank.u [R, O], bank.v [I, R]; router.w1 [I, R], or w1 [I, H] and w2 [H, R]; one
    number more for a normalised bank (bank.gain).

    Raises:
      ValueError: a rank or width below 1, or η outside (0, 1].
    """

    rank: int = 128
    """R, size of the bank; it may exceed the kernel's sides."""
    energy_target: float = 0.9
    """η."""
    alpha: float | None = None
    """α of the scale α/R; None is 2 R."""
    hidden_width: int | None = None
    """None: scores x W1, its default. H: its option `router_projection`, the softmax of H values
    (4 there) times a matrix that starts as one of 0 and 1."""
    normalized_bank: bool = False
    """Keep the bank's directions orthonormal; see LoRA-SP's."""

    def __post_init__(self) -> None:
        """Checks the fields."""
        super().__post_init__()
        if self.hidden_width is not None and self.hidden_width < 1:
            raise ValueError(f"hidden_width must be at least 1, got {self.hidden_width}.")

    @property
    def score_arrays(self) -> tuple[str, ...]:
        """Names of the router's arrays whose last axis is that of the scores."""
        return ("w1",) if self.hidden_width is None else ("w2",)

    def init_params(self, key: jax.Array, d_in: int, d_out: int) -> Params:
        """V and W1 random, U (or its gain) zero: the delta starts at exactly zero."""
        input_key, score_key = jax.random.split(key)
        inputs = kaiming_uniform(input_key, (d_in, self.rank + (self.hidden_width or self.rank)))
        v, w1 = jnp.split(inputs, [self.rank], axis=1)
        bank_key = jax.random.fold_in(key, 1)
        bank = init_bank(bank_key, v, d_out, normalized=self.normalized_bank)
        scores = {}
        if self.hidden_width is not None:
            scores = init_scores(score_key, "softmax", self.hidden_width, self.rank)
        return {"bank": bank, "router": {"w1": w1, **scores}}

    def bottleneck(
        self, params: Params, rows: jax.Array, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """z = scale Σ(x) V x from x [V, W1], with the gate's statistics and losses."""
        valid = jnp.ones(rows.shape[:-1], bool) if token_mask is None else token_mask
        projected, hidden = jnp.split(rows, [self.rank], axis=-1)
        scores = release_scores(params["router"], hidden)
        mask = release_gate(scores, self.energy_target)
        mask &= jnp.arange(mask.shape[-1]) < self.rank  # the others were pruned
        usage = (mask & valid[..., None]).reshape(-1, mask.shape[-1]).astype(jnp.float32).sum(0)
        energy = kept_energy(scores, mask)
        z = apply_masked_scores(projected, self.scale * scores, mask, energy[..., None])
        active_rank = mask.astype(jnp.float32).sum(-1)
        return z, Aux(active_rank, energy, release_losses(scores, mask, valid), usage=usage)


def release_scores(router: dict[str, jax.Array], hidden: jax.Array) -> jax.Array:
    """Signed scores f32 [..., R]: x W1 itself, or softmax(x W1) W2 where there is a w2 [H, R]."""
    hidden = bounded(hidden)
    return jax.nn.softmax(hidden) @ router["w2"] if "w2" in router else hidden


def release_gate(scores: jax.Array, energy_target: float) -> jax.Array:
    """The mask, bool [..., R]: the longest run of the largest scores with E_k <= η, at least one.

    Ties by lowest index. No gradient.
    """
    constant = jax.lax.stop_gradient(scores)
    order = jnp.argsort(-constant, axis=-1, stable=True)
    energy = jnp.square(jnp.take_along_axis(constant, order, axis=-1))
    within = jnp.cumsum(energy, axis=-1) <= energy_target * energy.sum(-1, keepdims=True)
    within |= jnp.arange(scores.shape[-1]) == 0
    return jnp.take_along_axis(within, jnp.argsort(order, axis=-1), axis=-1)


def release_losses(scores: jax.Array, mask: jax.Array, valid: jax.Array) -> dict[str, jax.Array]:
    """Spectral, balance and z of the public code, f32 scalars over the valid tokens.

    Args:
      scores: f32 [...tokens, R].
      mask: bool [...tokens, R], from `release_gate`.
      valid: bool [...tokens], False for padding.
    """
    mean = functools.partial(masked_mean, mask=valid)
    by_direction = jax.vmap(mean, in_axes=-1)
    energy = jnp.square(scores).sum(-1)
    kept = jnp.square(jnp.where(mask, scores, 0)).sum(-1)
    share = mean(kept) / (mean(energy) + 1e-9)
    gates = jax.nn.softmax(jnp.where(mask, scores, 0))
    first = jax.nn.one_hot(gates.argmax(-1), scores.shape[-1])
    size = jnp.clip(jax.nn.logsumexp(scores, axis=-1), -1, 10)
    return {
        "spectral": 1 - jnp.clip(share, 0, 1),
        "balance": scores.shape[-1] * jnp.sum(by_direction(first) * by_direction(gates)),
        "z": mean(jnp.log1p(size)),
    }
