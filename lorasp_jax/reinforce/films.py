"""Films of the start policy and of the one that has learned, from the same initial state."""

from pathlib import Path

import jax
import numpy as np

from envs.env import Env
from lorasp_jax.base.writing import atomic_file
from lorasp_jax.evaluation import video
from lorasp_jax.evaluation.programs import RECORDED_WORLDS, Rollout, compiled_rollout
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run import Callback, Run


class Films(Callback):
    """Writes `start_TASK.mp4` and `rollout_TASK.mp4`, if possible of a failure and a success."""

    def __init__(self, start: Policy) -> None:
        """Create the callback; `start` is the start policy."""
        self._start = start

    def on_end(self, run: Run) -> None:
        """Film one world of each task twice; layouts are those of the final evaluation."""
        for task in run.config.tasks:
            env, rollout = compiled_rollout(run, task)
            key = RandomStream.FINAL_EVALUATION.key(run.config.seed, task)
            found = [rollout(x.with_sampler(), key) for x in (self._start, run.policy)]
            before, after = (np.asarray(x.success[:RECORDED_WORLDS]) for x in found)
            world = int(np.argmax(2 * (after & ~before) + after))
            for name, each in zip(("start", "rollout"), found, strict=True):
                with atomic_file(run.folder / f"{name}_{task}.mp4") as unfinished:
                    _write(env, each, world, unfinished)


def _write(env: Env, rollout: Rollout, world: int, path: Path) -> None:
    """Film one of the recorded worlds."""
    end = max(int(rollout.steps[world]), 1)
    poses = jax.tree.map(lambda x: x[:end, world], rollout.poses)
    video.write_episode(env, poses, path, jax.tree.map(lambda x: x[world], rollout.draw))
