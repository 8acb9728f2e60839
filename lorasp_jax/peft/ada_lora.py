"""AdaLoRA: ΔW = s A diag(e) B, pruned to a rank budget shared by all layers (arXiv 2303.10512).

A triplet is a column of A, an entry of e and a row of B. Training prunes the triplets to which the
loss is least sensitive. `AdaLoRA.transform` makes this part of the optimizer, so that no training
loop can omit it. The arithmetic matches Hugging Face PEFT 0.21.2. Each equation of the paper has a
function:

    (3)  update          P Λ Q, here A diag(e) B                      `AdaLoRA.bottleneck`
    (4)  orthogonality   ‖PᵀP − I‖ + ‖QQᵀ − I‖                        `AdaLoRA.penalty`
    (7)-(11) importance  Ī, Ū, S of each triplet                      `_sensitivity`, `_importance`
    (6)  allocation      keep the b(t) most important triplets        `_keep`
    (12) budget          b(t), cubic                                  `budgets`
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from lorasp_jax.peft.auxiliary import Aux
from lorasp_jax.peft.fields import positive_int
from lorasp_jax.peft.method import Mask, Method, Params

_INIT_STD = 0.02  # PEFT's value for A and B
_NAMES = {"lora_a", "lora_e", "lora_b"}

Triplets = dict[str, jax.Array]


@dataclasses.dataclass(frozen=True)
class AdaLoRA(Method):
    """Adapter whose rank is allocated during training.

    Parameters: lora_a [I, R], lora_e [R], lora_b [R, O]: (I + O + 1) R in total. Pruning a triplet
    zeroes its entry of lora_e. Until the last allocation, a pruned triplet can return.

    Raises:
        ValueError: an invalid rank, interval, fraction or decay.
    """

    rank: int = 128
    """Initial rank R."""
    target_rank: int | None = None
    """Mean final rank per layer. Defaults to R / 2, rounded up; see `match_budget`."""
    alpha: float | None = None
    """α of the scale α/R, where R is the initial rank throughout, as in PEFT. None: 2 R."""
    warmup: float = 0.1
    """Fraction of the training steps before pruning starts."""
    final: float = 0.3
    """Fraction of the training steps, at the end, in which the set of pruned triplets is fixed."""
    interval: int = 10
    """Steps between prunings."""
    importance_decay: float = 0.85
    """β1, EMA decay of the importance."""
    uncertainty_decay: float = 0.85
    """β2, EMA decay of the uncertainty, the deviation from the mean importance."""
    dropout: float = 0.0
    """Dropout rate on the adapter's input, in training only. Enable it with `with_dropout` (NNX) or
    rngs={"dropout": key} (Linen)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rank < 1 or not 1 <= self.final_rank <= self.rank or self.interval < 1:
            raise ValueError(
                "rank and interval must be at least 1 and target_rank from 1 to rank, got "
                f"rank={self.rank}, target_rank={self.target_rank}, interval={self.interval}"
            )
        if self.warmup < 0 or self.final < 0 or self.warmup + self.final >= 1:
            raise ValueError(
                "warmup and final must be non-negative and sum to less than 1, got "
                f"{self.warmup} and {self.final}"
            )
        if not (0 <= self.importance_decay < 1 and 0 <= self.uncertainty_decay < 1):
            raise ValueError(
                "importance_decay and uncertainty_decay must be in [0, 1), got "
                f"{self.importance_decay} and {self.uncertainty_decay}"
            )

    @property
    def final_rank(self) -> int:
        """Mean final rank per layer."""
        return (self.rank + 1) // 2 if self.target_rank is None else self.target_rank

    @property
    def scale(self) -> float:
        """α/(R + 1e-5); the 1e-5 matches PEFT and the authors' code."""
        return (2 * self.rank if self.alpha is None else self.alpha) / (self.rank + 1e-5)

    def match_budget(self, mean_active_rank: float) -> "AdaLoRA":
        """Return a copy whose `target_rank` is LoRA-SP's measured mean active rank, rounded."""
        return dataclasses.replace(self, target_rank=round(mean_active_rank))

    def init_params(self, key: jax.Array, d_in: int, d_out: int) -> Params:
        """Initialize A and B from N(0, 0.02²) and e to zero; the delta is exactly zero."""
        a_key, b_key = jax.random.split(key)
        return {
            "lora_a": _INIT_STD * jax.random.normal(a_key, (d_in, self.rank)),
            "lora_e": jnp.zeros(self.rank),
            "lora_b": _INIT_STD * jax.random.normal(b_key, (self.rank, d_out)),
        }

    def down(self, params: Params) -> jax.Array:
        """A."""
        return params["lora_a"]

    def bottleneck(
        self, params: Params, rows: jax.Array, token_mask: Mask
    ) -> tuple[jax.Array, Aux]:
        """Eq. (3): z = s x A diag(e). The active rank is the number of nonzero entries of e."""
        del token_mask
        rank = (params["lora_e"] != 0).sum().astype(jnp.float32)
        z = rows * (self.scale * params["lora_e"]).astype(rows.dtype)
        return z, Aux(jnp.broadcast_to(rank, rows.shape[:-1]))

    def up(self, params: Params) -> jax.Array:
        """B."""
        return params["lora_b"]

    def penalty(self, params: Params) -> dict[str, jax.Array]:
        """Eq. (4) as in PEFT: the mean of ‖AᵀA − I‖ and ‖BBᵀ − I‖, Frobenius norms, not squared."""
        a, b = params["lora_a"], params["lora_b"]
        norms = [optax.safe_norm(gram - jnp.eye(len(gram)), 0) for gram in (a.T @ a, b @ b.T)]
        return {"orthogonality": (norms[0] + norms[1]) / 2}

    def transform(
        self, optimizer: optax.GradientTransformation, total_steps: int
    ) -> optax.GradientTransformation:
        """Wrap the optimizer so that its steps also prune all layers to one shared rank budget.

        Wrap the complete optimizer, including its learning rate: any transformation chained after
        it would undo the pruning. Gradient clipping may be chained before it. Importance is
        computed from the updated parameters.

        Args:
            optimizer: for any parameter tree that includes AdaLoRA parameters.
            total_steps: number of training steps.

        Raises:
            ValueError: no steps remain between warm-up and final phase. The wrapped optimizer's
                `init` also raises it, for a tree without AdaLoRA parameters.
        """
        positive_int("total_steps", total_steps)
        begin, end = round(self.warmup * total_steps), total_steps - round(self.final * total_steps)
        if begin >= end:
            raise ValueError(
                f"AdaLoRA cannot prune in {total_steps} steps: warm-up takes {begin} and the final "
                f"phase {total_steps - end}"
            )

        def init(params: Any) -> AllocationState:
            return _initial_state(params, optimizer.init(params))

        def update(updates: Any, state: Any, params: Any = None) -> Any:
            grads, (updates, inner) = updates, optimizer.update(updates, state.inner, params)
            old = _triplets(params)
            new = [
                jax.tree.map(jnp.add, *pair) for pair in zip(old, _triplets(updates), strict=True)
            ]
            averages = _sensitivity(self, state, new, _triplets(grads), active=state.step < end)
            kept, pruned = _allocate(self, state, _importance(*averages), begin, end)
            updates = _zero_pruned(updates, old, pruned)
            return updates, AllocationState(state.step + 1, *averages, kept, inner)

        return optax.GradientTransformation(init, update)

    def merge(self, params: Params, kernel: jax.Array) -> jax.Array:
        """W + s A diag(e) B, summed in fp32."""
        delta = self.scale * ((params["lora_a"] * params["lora_e"]) @ params["lora_b"])
        return (kernel.astype(jnp.float32) + delta).astype(kernel.dtype)


class AllocationState(NamedTuple):
    """Optimizer state. Lists have one entry per adapted layer or stack of layers, in tree order."""

    step: jax.Array
    importance: list[Triplets]
    """Ī, EMA of each parameter's importance."""
    uncertainty: list[Triplets]
    """Ū, EMA of each parameter's uncertainty."""
    kept: list[jax.Array]
    """Bool masks shaped like lora_e, True for entries that the latest allocation kept."""
    inner: Any


def budgets(initial: int, target: int, begin: int, end: int) -> np.ndarray:
    """Eq. (12): number of triplets to keep at each step, int32 [end + 1]; cubic after `begin`."""
    steps = np.arange(end + 1)
    remaining = 1 - np.clip((steps - begin) / (end - begin), 0.0, 1.0)
    return (target + (initial - target) * remaining**3).astype(np.int32)


def _initial_state(params: Any, inner: Any) -> AllocationState:
    """The state before the first step. Raise ValueError if there are no AdaLoRA parameters."""
    if not (triplets := _triplets(params)):
        raise ValueError("the parameters passed to AdaLoRA's optimizer contain no AdaLoRA adapter")
    importance, uncertainty = (jax.tree.map(jnp.zeros_like, triplets) for _ in range(2))
    kept = [jnp.ones(t["lora_e"].shape, bool) for t in triplets]
    return AllocationState(jnp.zeros((), jnp.int32), importance, uncertainty, kept, inner)


def _allocate(
    method: AdaLoRA, state: AllocationState, scores: list[jax.Array], begin: int, end: int
) -> tuple[list[jax.Array], list[jax.Array]]:
    """Masks shaped like lora_e: entries kept by the latest allocation, and entries to zero now.

    Between allocations, pruned entries train and can become nonzero. After the last allocation,
    they stay 0.
    """
    step, total = state.step, sum(s.size for s in scores)
    table = budgets(total, total // method.rank * method.final_rank, begin, end)
    num_pruned = total - jnp.asarray(table)[jnp.minimum(step, end)]
    allocate = ((step > begin) & (step < end) & (step % method.interval == 0)) | (step == end)
    pairs = zip(_keep(scores, num_pruned), state.kept, strict=True)
    kept = [jnp.where(allocate, new, old) for new, old in pairs]
    return kept, [(allocate | (step > end)) & ~keep for keep in kept]


def _is_triplets(node: Any) -> bool:
    return isinstance(node, Mapping) and set(node) == _NAMES


def _triplets(tree: Any) -> list[Triplets]:
    """The parameters of each AdaLoRA layer in a tree; a stack of layers is one entry."""
    nodes = jax.tree.leaves(tree, is_leaf=_is_triplets)
    return [dict(node) for node in nodes if _is_triplets(node)]


def _sensitivity(
    method: AdaLoRA, state: AllocationState, params: Any, grads: Any, active: jax.Array
) -> tuple[Any, Any]:
    """Eqs. (8)-(10): Ī, the EMA of I = |w g|, and Ū, the EMA of |I − Ī|, updated if `active`."""

    def average(decay: float, old: jax.Array, new: jax.Array) -> jax.Array:
        return jnp.where(active, decay * old + (1 - decay) * new, old).astype(old.dtype)

    current = jax.tree.map(lambda w, g: jnp.abs(w * g), params, grads)
    importance = jax.tree.map(
        lambda old, i: average(method.importance_decay, old, i), state.importance, current
    )
    uncertainty = jax.tree.map(
        lambda old, i, m: average(method.uncertainty_decay, old, jnp.abs(i - m)),
        state.uncertainty,
        current,
        importance,
    )
    return importance, uncertainty


def _importance(importance: list[Triplets], uncertainty: list[Triplets]) -> list[jax.Array]:
    """Eqs. (7), (11): S of a triplet: Ī Ū of its entry of e, plus the mean Ī Ū of each vector."""
    scores = jax.tree.map(jnp.multiply, importance, uncertainty)
    return [s["lora_e"] + s["lora_a"].mean(-2) + s["lora_b"].mean(-1) for s in scores]


def _keep(scores: list[jax.Array], num_pruned: jax.Array) -> list[jax.Array]:
    """Eq. (6): masks without the `num_pruned` least important triplets and any tied with them."""
    ordered = jnp.sort(jnp.concatenate([s.ravel() for s in scores]))
    threshold = jnp.where(num_pruned > 0, ordered[jnp.maximum(num_pruned - 1, 0)], -jnp.inf)
    return [s > threshold for s in scores]


def _zero_pruned(updates: Any, params: list[Triplets], pruned: list[jax.Array]) -> Any:
    """Change the updates so that pruned entries of lora_e become exactly 0."""
    pairs = iter(zip(params, pruned, strict=True))

    def replace(node: Any) -> Any:
        if not _is_triplets(node):
            return node
        old, pruned_mask = next(pairs)
        return {**node, "lora_e": jnp.where(pruned_mask, -old["lora_e"], node["lora_e"])}

    return jax.tree.map(replace, updates, is_leaf=_is_triplets)
