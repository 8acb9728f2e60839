"""How far a policy's actions are from those of demonstrations that no policy has learned from."""

from typing import Any

from lorasp_jax.evaluation import held_out
from lorasp_jax.extras.study.held_out import AllTasks
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training.demonstrations import Demonstrations
from lorasp_jax.training.run import Run


def measure(run: Run, episodes: Demonstrations, _: Policy | None) -> dict[str, float]:
    """Return the loss and the action error on held-out demonstrations; see `held_out.measure`."""
    source: Any = AllTasks(episodes)
    windows = held_out.windows(source, range(len(source)), run.policy)
    found = held_out.measure(run.policy, windows, num_steps=run.config.evaluation.denoise_steps)
    return {
        "loss": found.loss,
        "action_error": found.policy.mean,
        "hold_error": found.hold.mean,
        "repeat_error": found.repeat.mean,
    }
