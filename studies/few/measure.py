"""How far a policy's actions are from those of demonstrations that no policy has learned from."""

from typing import Any

from envs.datasets.episodes import Episodes
from lorasp_jax.evaluation import held_out
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training.demonstrations import Demonstrations
from lorasp_jax.training.run import Run


class _Source:
    """Demonstrations as a dataset: the episodes of all tasks, numbered one after the other."""

    def __init__(self, demonstrations: Demonstrations) -> None:
        self._groups = [*demonstrations.values()]
        self.control_dt = self._groups[0].control_dt

    def __len__(self) -> int:
        return sum(group.num_episodes for group in self._groups)

    def episode(self, number: int, cameras: object = None) -> Episodes:  # noqa: ARG002
        for group in self._groups:
            if number < group.num_episodes:
                return group.select([number])
            number -= group.num_episodes
        raise IndexError(number)


def measure(run: Run, episodes: Demonstrations, _: Policy | None) -> dict[str, float]:
    """Return the loss and the action error on held-out demonstrations; see `held_out.measure`."""
    source: Any = _Source(episodes)
    windows = held_out.windows(source, range(len(source)), run.policy)
    found = held_out.measure(run.policy, windows, num_steps=run.config.evaluation.denoise_steps)
    return {
        "loss": found.loss,
        "action_error": found.policy.mean,
        "hold_error": found.hold.mean,
        "repeat_error": found.repeat.mean,
    }
