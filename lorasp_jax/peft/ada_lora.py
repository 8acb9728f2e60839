"""AdaLoRA: ΔW = s A diag(e) B whose rank is pruned to a budget over all layers (arXiv 2303.10512).

Which triplets (a column of A, an entry of e, a row of B) stay is decided while training, from how
sensitive the loss is to them; `AdaLoRA.transform` wraps the optimizer and does that in the same
jitted step, so a training loop cannot forget it. The arithmetic is that of Hugging Face PEFT
0.21.2. One function per equation of the paper:

    (1)  update          P Λ Q, here A diag(e) B                      `AdaLoRA.bottleneck`
    (4)  orthogonality   ‖PᵀP − I‖ + ‖QQᵀ − I‖                        `AdaLoRA.penalty`
    (7)-(11) importance  Ī, Ū, S of each triplet                      `_sensitivity`, `_importance`
    (6)  allocation      the b(t) most important stay                 `_keep`
    (12) budget          b(t), cubic                                  `budgets`
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from lorasp_jax.peft import _fields
from lorasp_jax.peft._aux import Aux
from lorasp_jax.peft._method import Method, Params

_INIT_STD = 0.02  # of A and B in PEFT
_NAMES = {"lora_a", "lora_e", "lora_b"}

Triplets = dict[str, jax.Array]


@dataclasses.dataclass(frozen=True)
class AdaLoRA(Method):
    """Adapter whose rank is allocated while training.

    Parameters: lora_a [I, R], lora_e [R], lora_b [R, O], (I + O + 1) R numbers. Where a triplet is
    pruned, lora_e is exactly 0.

    Raises:
      ValueError: a rank, interval or share that makes no sense.
    """

    rank: int = 128
    """R at the start."""
    target_rank: int | None = None
    """Mean rank of a layer at the end, None: half of R; see `match_budget`."""
    alpha: float | None = None
    """α of the scale α/R; None is 2 R. R stays that of the start, as in PEFT."""
    warmup: float = 0.1
    """Share of the steps before anything is pruned."""
    final: float = 0.3
    """Share of the steps, the last ones, in which what is pruned no longer changes."""
    interval: int = 10
    """Steps from one pruning to the next."""
    importance_decay: float = 0.85
    """β1 of the mean importance."""
    uncertainty_decay: float = 0.85
    """β2 of the mean deviation from it."""
    dropout: float = 0.0
    """Probability with which the adapter sees a number of its input as 0, in training alone:
    `with_dropout` of NNX models, rngs={"dropout": key} of Linen's."""

    def __post_init__(self) -> None:
        """Checks the fields."""
        super().__post_init__()
        if self.rank < 1 or not 1 <= self.final_rank <= self.rank or self.interval < 1:
            raise ValueError(
                "target_rank must be 1 to rank and interval at least 1, got "
                f"{self.target_rank}, {self.rank}, {self.interval}."
            )
        if self.warmup < 0 or self.final < 0 or self.warmup + self.final >= 1:
            raise ValueError(
                "warmup and final are shares of the steps that leave some between them, got "
                f"{self.warmup}, {self.final}."
            )
        if not (0 <= self.importance_decay < 1 and 0 <= self.uncertainty_decay < 1):
            raise ValueError(
                "importance_decay and uncertainty_decay must lie in [0, 1), got "
                f"{self.importance_decay}, {self.uncertainty_decay}."
            )

    @property
    def final_rank(self) -> int:
        """Mean rank of a layer at the end."""
        return (self.rank + 1) // 2 if self.target_rank is None else self.target_rank

    @property
    def scale(self) -> float:
        """α/(R + 1e-5), the constant of PEFT and of the authors' code included."""
        return (2 * self.rank if self.alpha is None else self.alpha) / (self.rank + 1e-5)

    def match_budget(self, mean_active_rank: float) -> "AdaLoRA":
        """The same with the rank that LoRA-SP was measured to use, as in the paper's Table I."""
        return dataclasses.replace(self, target_rank=round(mean_active_rank))

    def init_params(self, key: jax.Array, d_in: int, d_out: int) -> Params:
        """A and B normal with deviation 0.02, e zero: the delta starts at exactly zero."""
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
        self, params: Params, rows: jax.Array, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """Eq. (1): z = s x A diag(e); the active rank is the number of entries not 0."""
        del token_mask
        rank = (params["lora_e"] != 0).sum().astype(jnp.float32)
        z = rows * (self.scale * params["lora_e"]).astype(rows.dtype)
        return z, Aux(jnp.broadcast_to(rank, rows.shape[:-1]))

    def up(self, params: Params) -> jax.Array:
        """B."""
        return params["lora_b"]

    def penalty(self, params: Params) -> dict[str, jax.Array]:
        """Eq. (4) as PEFT has it: the mean of ‖AᵀA − I‖ and ‖BBᵀ − I‖, Frobenius, not squared."""
        a, b = params["lora_a"], params["lora_b"]
        norms = [_norm(gram - jnp.eye(len(gram))) for gram in (a.T @ a, b @ b.T)]
        return {"orthogonality": (norms[0] + norms[1]) / 2}

    def transform(
        self, optimizer: optax.GradientTransformation, total_steps: int
    ) -> optax.GradientTransformation:
        """The optimizer, after each step of which the budget of all layers is allocated.

        It wraps the whole optimizer, learning rate included, and what is chained behind it would
        undo the pruning; clipping goes before it. Importance is that of the updated parameters.
        All AdaLoRA layers in the tree share one budget.

        Args:
          optimizer: of any tree of parameters, some of them made by `init`.
          total_steps: T.

        Raises:
          ValueError: if no step would be left between warm-up and final phase, or the parameters
            hold no AdaLoRA.
        """
        _fields.positive_int("total_steps", total_steps)
        begin, end = round(self.warmup * total_steps), total_steps - round(self.final * total_steps)
        if begin >= end:
            raise ValueError(
                f"AdaLoRA cannot prune in {total_steps} steps: {begin} are warm-up and "
                f"{total_steps - end} final."
            )

        def init(params: Any) -> AllocationState:
            return _begun(params, optimizer.init(params))

        def update(updates: Any, state: Any, params: Any = None) -> Any:
            grads, (updates, inner) = updates, optimizer.update(updates, state.inner, params)
            found = _triplets(params)
            new = [
                jax.tree.map(jnp.add, *pair) for pair in zip(found, _triplets(updates), strict=True)
            ]
            means = _sensitivity(self, state, new, _triplets(grads), learn=state.step < end)
            kept, pruned = _allocate(self, state, _importance(*means), begin, end)
            updates = _replaced(updates, found, pruned)
            return updates, AllocationState(state.step + 1, *means, kept, inner)

        return optax.GradientTransformation(init, update)

    def merge(self, params: Params, kernel: jax.Array) -> jax.Array:
        """W + s A diag(e) B, summed in fp32."""
        delta = self.scale * ((params["lora_a"] * params["lora_e"]) @ params["lora_b"])
        return (kernel.astype(jnp.float32) + delta).astype(kernel.dtype)


class AllocationState(NamedTuple):
    """What the allocation remembers; lists over the adapted layers, in the tree's order."""

    step: jax.Array
    importance: list[Triplets]
    """Ī of every parameter."""
    uncertainty: list[Triplets]
    """Ū of every parameter."""
    kept: list[jax.Array]
    """bool, of the shape of lora_e: what the last allocation kept."""
    inner: Any


def budgets(initial: int, target: int, begin: int, end: int) -> np.ndarray:
    """Eq. (12): triplets that stay by step, int32 [end + 1]: all, then fewer by a cubic."""
    steps = np.arange(end + 1)
    left = 1 - np.clip((steps - begin) / (end - begin), 0.0, 1.0)
    return (target + (initial - target) * left**3).astype(np.int32)


def _begun(params: Any, inner: Any) -> AllocationState:
    """The state before the first step."""
    if not (found := _triplets(params)):
        raise ValueError("there is no AdaLoRA among the parameters of AdaLoRA's optimizer.")
    importance, uncertainty = (jax.tree.map(jnp.zeros_like, found) for _ in range(2))
    kept = [jnp.ones(t["lora_e"].shape, bool) for t in found]
    return AllocationState(jnp.zeros((), jnp.int32), importance, uncertainty, kept, inner)


def _allocate(
    method: AdaLoRA, state: AllocationState, scores: list[jax.Array], begin: int, end: int
) -> tuple[list[jax.Array], list[jax.Array]]:
    """What to keep from now on, and what to prune at once, as lora_e is shaped.

    Between two allocations pruned entries train on; after the last one they stay pruned.
    """
    step, number = state.step, sum(s.size for s in scores)
    table = budgets(number, number // method.rank * method.final_rank, begin, end)
    fewer = number - jnp.asarray(table)[jnp.minimum(step, end)]
    due = ((step > begin) & (step < end) & (step % method.interval == 0)) | (step == end)
    pairs = zip(_keep(scores, fewer), state.kept, strict=True)
    kept = [jnp.where(due, new, old) for new, old in pairs]
    return kept, [(due | (step > end)) & ~keep for keep in kept]


def _norm(matrix: jax.Array) -> jax.Array:
    """Frobenius norm, whose gradient is 0 where all is 0."""
    total = jnp.square(matrix).sum()
    return jnp.where(total > 0, jnp.sqrt(jnp.where(total > 0, total, 1.0)), 0.0)


def _is_triplets(node: Any) -> bool:
    return isinstance(node, Mapping) and set(node) == _NAMES


def _triplets(tree: Any) -> list[Triplets]:
    """The parameters of all AdaLoRA layers of a tree; stacked layers count as one."""
    nodes = jax.tree.leaves(tree, is_leaf=_is_triplets)
    return [dict(node) for node in nodes if _is_triplets(node)]


def _sensitivity(
    method: AdaLoRA, state: AllocationState, params: Any, grads: Any, learn: jax.Array
) -> tuple[Any, Any]:
    """Eqs. (8)-(10): I = |w g|, its moving mean Ī, and Ū, that of |I − Ī|."""

    def mean(decay: float, old: jax.Array, new: jax.Array) -> jax.Array:
        return jnp.where(learn, decay * old + (1 - decay) * new, old).astype(old.dtype)

    now = jax.tree.map(lambda w, g: jnp.abs(w * g), params, grads)
    importance = jax.tree.map(
        lambda old, i: mean(method.importance_decay, old, i), state.importance, now
    )
    uncertainty = jax.tree.map(
        lambda old, i, m: mean(method.uncertainty_decay, old, jnp.abs(i - m)),
        state.uncertainty,
        now,
        importance,
    )
    return importance, uncertainty


def _importance(importance: list[Triplets], uncertainty: list[Triplets]) -> list[jax.Array]:
    """Eqs. (7), (11): S of each triplet, Ī Ū of its entry of e plus the means over A and B."""
    scores = jax.tree.map(jnp.multiply, importance, uncertainty)
    return [s["lora_e"] + s["lora_a"].mean(-2) + s["lora_b"].mean(-1) for s in scores]


def _keep(scores: list[jax.Array], fewer: jax.Array) -> list[jax.Array]:
    """Eq. (6): all but the `fewer` least important of all layers; ties at the threshold go too."""
    ordered = jnp.sort(jnp.concatenate([s.ravel() for s in scores]))
    threshold = jnp.where(fewer > 0, ordered[jnp.maximum(fewer - 1, 0)], -jnp.inf)
    return [s > threshold for s in scores]


def _replaced(updates: Any, params: list[Triplets], pruned: list[jax.Array]) -> Any:
    """The updates, under which pruned entries of lora_e become exactly 0."""
    pairs = iter(zip(params, pruned, strict=True))

    def replace(node: Any) -> Any:
        if not _is_triplets(node):
            return node
        old, gone = next(pairs)
        return {**node, "lora_e": jnp.where(gone, -old["lora_e"], node["lora_e"])}

    return jax.tree.map(replace, updates, is_leaf=_is_triplets)
