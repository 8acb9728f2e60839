"""Success of a policy, and the active ranks of its layers at the end of training."""

from collections.abc import Sequence
from typing import Any

from lorasp_jax.evaluation.callback import training_ranks
from lorasp_jax.extras.study.study import Results
from lorasp_jax.training.run import Run
from studies.few import judge as scenes
from studies.few.page import success


def judge(run: Run) -> dict[str, Any]:
    """Return what `few.judge` does, and the active ranks by tower and layer."""
    return {**scenes.judge(run), "layer_active_rank": training_ranks(run)}


def best_rate(results: Results, pilots: Sequence[str]) -> float:
    """Return the learning rate, the last part of the name, of the pilot with the most success."""
    return float(max(pilots, key=lambda name: success(results[name])).rpartition("/")[2])
