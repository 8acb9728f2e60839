"""Which of LoRA-SP's directions are active on held-out data, by layer and by task."""

import dataclasses
import functools
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.peft import Aux
from lorasp_jax.training.fixed_batches import Keyed, forward

QUARTILES = (0.0, 0.25, 0.5, 0.75, 1.0)


@dataclasses.dataclass(frozen=True)
class Use:
    """How the tokens of a data set use one linear layer, or a stack of L such layers.

    Attributes:
        usage: `[L, n]`, number of tokens for which each of the n scored directions is active.
        ranks: `[L, n + 1]`, number of tokens with active rank 0, 1, ..., n.
    """

    usage: np.ndarray
    ranks: np.ndarray

    @property
    def frequency(self) -> np.ndarray:
        """Fraction of the tokens for which each direction is active, `[L, n]`."""
        return self.usage / np.maximum(self.ranks.sum(-1, keepdims=True), 1)

    def __add__(self, other: "Use") -> "Use":
        return Use(self.usage + other.usage, self.ranks + other.ranks)


Uses = dict[str, dict[str, Use]]
"""Tower -> name of a linear layer -> its use."""


def directions_in_use(model: nnx.Module, batches: Iterable[Keyed]) -> Uses:
    """Count active directions over the valid tokens of batches, at random flow times.

    Args:
        model: a backbone with LoRA-SP adapters; layers without an energy gate are omitted.
        batches: pairs of a key, which draws noise and flow time, and a batch.
    """
    graphdef, state = nnx.split(model)
    total: Uses = {}
    for keyed in batches:
        counts = jax.device_get(_count(graphdef, state, keyed))
        for tower, linears in counts.items():
            uses = total.setdefault(tower, {})
            for name, (usage, ranks) in linears.items():
                use = Use(usage.astype(np.int64), ranks.astype(np.int64))
                uses[name] = uses[name] + use if name in uses else use
    return total


def merged(uses: Iterable[Uses]) -> Uses:
    """Add the counts of several data sets."""
    first, *others = uses
    is_use = lambda node: isinstance(node, Use)  # noqa: E731
    return jax.tree.map(lambda *parts: sum(parts[1:], parts[0]), first, *others, is_leaf=is_use)


def rank_boxes(uses: Uses) -> dict[str, dict[str, list[list[int]]]]:
    """Return the five-number summary of the active rank over tokens, for each layer (Figure 6).

    Minimum, lower quartile, median, upper quartile, maximum: the quantile q is the smallest rank
    that at least a fraction q of the tokens do not exceed, and occurs.
    """
    return {
        tower: {name: [_five_numbers(row) for row in use.ranks] for name, use in linears.items()}
        for tower, linears in uses.items()
    }


def overlap(a: Uses, b: Uses) -> dict[str, tuple[float, float]]:
    """Return how far two tasks use the same directions, and what chance would give.

    The index is the weighted Jaccard index of the frequencies f of all directions of a tower,

        J = Σ min(f_a, f_b) / Σ max(f_a, f_b),

    1 if the frequencies agree, 0 if no direction is active for both. By chance: each layer's
    directions of one task permuted at random, so that frequencies stay but identities are lost;
    numerator and denominator are replaced by their exact expectations.

    Returns:
        (index, index by chance) by tower, and for all towers together as "all".
    """
    sums = {tower: _overlap_sums(a[tower], b[tower]) for tower in a}
    sums["all"] = np.sum(list(sums.values()), axis=0)
    tiny = np.finfo(np.float64).tiny
    return {
        tower: (float(s[0] / max(s[1], tiny)), float(s[2] / max(s[3], tiny)))
        for tower, s in sums.items()
    }


def _overlap_sums(a: Mapping[str, Use], b: Mapping[str, Use]) -> np.ndarray:
    """Return Σ min, Σ max, and both by chance, `[4]`, over all layers of a tower."""
    sums = []
    for name in a:
        x, y = a[name].frequency, b[name].frequency
        pairs = x[:, :, None], y[:, None, :]
        chance = [f(*pairs).sum() / x.shape[-1] for f in (np.minimum, np.maximum)]
        sums.append(np.array([np.minimum(x, y).sum(), np.maximum(x, y).sum(), *chance]))
    return np.sum(sums, axis=0)


def _five_numbers(counts: np.ndarray) -> list[int]:
    """Return the quartiles of the ranks 0, 1, ..., n with the given counts `[n + 1]`."""
    cumulative = np.cumsum(counts)
    at_least = np.maximum(np.array(QUARTILES) * cumulative[-1], 1)
    return np.searchsorted(cumulative, at_least).tolist()


@functools.partial(jax.jit, static_argnums=0)
def _count(graphdef: Any, state: Any, keyed: Keyed) -> Any:
    """Return usage and counts of ranks of each linear layer with an energy gate, by tower."""
    model = nnx.merge(graphdef, state, copy=True)
    _, aux = forward(model, keyed)
    return {
        tower: {name: _layer_counts(a) for name, a in linears.items() if a.usage is not None}
        for tower, linears in aux.items()
        if any(a.usage is not None for a in linears.values())
    }


def _layer_counts(aux: Aux) -> tuple[jax.Array, jax.Array]:
    """Return usage `[L, n]` and counts of ranks `[L, n + 1]`, both int32."""
    assert aux.usage is not None
    assert aux.active_rank is not None
    assert aux.token_mask is not None  # backbones always set it
    usage = jnp.atleast_2d(aux.usage)
    valid = jnp.broadcast_to(aux.token_mask, aux.active_rank.shape)
    rank, weight = (x.reshape(len(usage), -1).astype(jnp.int32) for x in (aux.active_rank, valid))
    count = functools.partial(jnp.bincount, length=usage.shape[-1] + 1)
    return jnp.round(usage).astype(jnp.int32), jax.vmap(count)(rank, weight)
