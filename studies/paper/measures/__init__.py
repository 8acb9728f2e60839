"""What figures need beyond results.json, measured at the end of a cell on held-out data."""

import itertools
from typing import Any

import jax
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.peft.lora_sp.bank import BankMethod
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training import rules
from lorasp_jax.training.base import base_model
from lorasp_jax.training.demonstrations import Demonstrations
from lorasp_jax.training.fixed_batches import keyed_batches, sampler
from lorasp_jax.training.run import Run
from studies.paper.measures import cost, directions, gradients, layers, spectra

BATCH_SIZE, BATCHES = 64, 4
"""Windows per batch, and batches per task."""


def measure(run: Run, episodes: Demonstrations, source: Policy | None) -> dict[str, Any]:
    """Return the costs of training, and the measures on held-out demonstrations; see `measures`."""
    config, policy = run.config, run.policy
    if source:
        return {"measures": measures(policy, episodes, source=source)}
    base = base_model(config)[0] if rules.trains_base(config) else None
    return {
        "speed": cost.training_cost(run.folder, config, policy.model.config),
        "measures": measures(policy, episodes, base=base),
    }


def measures(
    policy: Policy,
    episodes: Demonstrations,
    *,
    base: nnx.Module | None = None,
    source: Policy | None = None,
    batch_size: int = BATCH_SIZE,
    batches: int = BATCHES,
) -> dict[str, Any]:
    """Return all measures that apply to a policy, as at most about 4 kB of JSON values.

    - `gradient_cosine`, after training on several tasks: "a|b" -> tower -> cosine; see
      `gradients.gradient_cosines`. "a|a" compares two batches of one task.
    - `rank_boxes`, for LoRA-SP: tower -> linear layer -> five-number summary of the active rank
      over tokens, per layer of a stack; see `directions.rank_boxes`.
    - `direction_overlap`, for LoRA-SP on several tasks: "a|b" -> tower -> [index, index by chance];
      see `directions.overlap`.
    - `spectral_rank`, after full fine-tuning, if `base` is given: tower -> layer -> share of
      singular values, per layer of a stack; see `spectra.spectral_rank`.
    - `smaller`, if `source` is given: `bytes` of the adapters, [source, policy].

    Args:
        policy: the policy at the end of a cell.
        episodes: held-out episodes by task; see `held_out.settings`.
        base: the model before full fine-tuning.
        source: for a `Derived` cell, the policy before its transformation.
        batch_size: windows per batch.
        batches: batches per task.
    """
    methods = set(adaptation.methods(policy.model).values())
    found: dict[str, Any] = {}
    if source is not None:
        found["smaller"] = {"bytes": [cost.adapter_bytes(each) for each in (source, policy)]}
    elif methods and len(episodes) > 1:
        found["gradient_cosine"] = _gradient_cosines(policy, episodes, batch_size, batches)
    if any(isinstance(method, BankMethod) for method in methods):
        found |= _directions(policy, episodes, batch_size, batches)
    if base is not None and all(method.trains_base for method in methods):
        found |= _spectra(policy.model, base)
    return found


def _gradient_cosines(
    policy: Policy, episodes: Demonstrations, batch_size: int, batches: int
) -> dict[str, Any]:
    samples = {task: sampler(policy, group, batch_size) for task, group in episodes.items()}
    key = jax.random.key(0)
    cosines = gradients.gradient_cosines(policy.model, samples, key, batches)
    return {
        "|".join(pair): {tower: round(value, 3) for tower, value in towers.items()}
        for pair, towers in cosines.items()
    }


def _directions(
    policy: Policy, episodes: Demonstrations, batch_size: int, batches: int
) -> dict[str, Any]:
    by_task = {
        task: directions.directions_in_use(policy.model, pairs)
        for task, pairs in keyed_batches(policy, episodes, batch_size, batches).items()
    }
    found: dict[str, Any] = {
        "rank_boxes": directions.rank_boxes(directions.merged(by_task.values()))
    }
    pairs = {
        f"{a}|{b}": {
            tower: [round(value, 2) for value in values]
            for tower, values in directions.overlap(by_task[a], by_task[b]).items()
        }
        for a, b in itertools.combinations(by_task, 2)
    }
    return found | ({"direction_overlap": pairs} if pairs else {})


def _spectra(model: nnx.Module, base: nnx.Module) -> dict[str, Any]:
    shares = {
        path: [None if share is None else round(share, 3) for share in row]
        for path, row in spectra.spectral_rank(model, base).items()
    }
    return {"spectral_rank": layers.by_tower(shares)}
