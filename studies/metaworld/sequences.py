"""Tasks of Meta-World learned one after another by one policy: what does it forget?"""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from lorasp_jax.data.cache import Cache
from lorasp_jax.extras.study import Derived
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training import dataset
from lorasp_jax.training.run import Run
from lorasp_jax.training.run_folder import CACHE
from studies.metaworld import page
from studies.metaworld.judge import outcomes
from studies.metaworld.tasks import INSTRUCTIONS
from studies.where_it_pays import sequences
from studies.where_it_pays.sequence_page import KINDS

EPISODES = 20
"""Judged episodes per task, on the same layouts whenever a task is judged."""


def cells(backbone: str, seed: int) -> Iterator[Derived]:
    """Yield the policies of a seed that learn one task after another."""
    yield from sequences.derived(page.SEQUENCES, backbone, seed, judge, episodes=EPISODES)


def judge(run: Run, kind: str, order: int, episodes: int) -> dict[str, Any]:
    """Return what `sequences.judged` does, of the last task learned and the next.

    Demonstrations and prompts are those of the run that learned all tasks together.
    """
    method, rank, *_ = KINDS[kind]
    source = page.together(run.config.model.backbone, method, rank, run.config.seed)
    cache = Cache(run.folder.parents[3] / source / CACHE)
    cache.verify_images()
    phrases = cache.phrases

    def demonstrate(stage: Run, shares: Mapping[str, float]) -> Run:
        left_out = {*range(len(cache))}
        for task, share in shares.items():
            own = np.flatnonzero(phrases == INSTRUCTIONS[task])
            left_out -= {*own[: math.ceil(share * len(own))].tolist()}
        return dataclasses.replace(stage, dataset=dataset.without(cache.steps, left_out))

    def success(policy: Policy, tasks: Sequence[str]) -> dict[str, str]:
        return outcomes(run.with_policy(policy), tasks, episodes, 0)

    tasks = page.SEQUENCES.orders[order]
    return sequences.judged(run, kind, tasks, demonstrate, success, whole=False)
