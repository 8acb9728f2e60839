"""Success of a policy, and the active ranks of its layers at the end of training."""

from typing import Any

from lorasp_jax.evaluation.callback import training_ranks
from lorasp_jax.training.run import Run
from studies.few import judge as scenes


def judge(run: Run) -> dict[str, Any]:
    """Return what `few.judge` does, and the active ranks by tower and layer."""
    return {**scenes.judge(run), "layer_active_rank": training_ranks(run)}
