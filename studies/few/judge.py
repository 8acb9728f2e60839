"""Success of a policy as recorded and in a scene that was shifted, and its held-out error."""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

import envs
from envs import Env, Randomization
from envs.state import State
from lorasp_jax.evaluation import held_out, metrics
from lorasp_jax.evaluation.programs import Rollout, make_rollout
from lorasp_jax.evaluation.results import evaluate, map_rollouts
from lorasp_jax.extras.study.held_out import AllTasks
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training.demonstrations import Demonstrations
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run import Run
from studies.few.page import SCENES

SHIFT = Randomization(
    camera_position=(-0.0025, 0.0025),
    camera_turn=(-0.00875, 0.00875),
    light_turn=(-0.125, 0.125),
    brightness=(0.925, 1.05),
    colour=(-0.025, 0.025),
    table_height=(-0.0025, 0.0025),
)
"""What every episode of the shifted scene draws: a quarter of `Randomization.typical`, at which
hardly any policy of a scene that never changed succeeds. Cameras turn by up to half a degree."""
DISTRACTORS = 2
"""Unrelated objects on the table of the shifted scene."""
CROP = 0.95
"""Side of the pictures' middle that `judge` shows with `cropped`: that of openpi's random crop."""


def judge(run: Run, scenes: Iterable[str] = SCENES, *, cropped: bool = False) -> dict[str, Any]:
    """Return the outcomes of the policy by scene and task, such as "shifted/pour".

    Both scenes have layouts that no demonstration has; policies of one seed share them. With
    `cropped`, the policy sees the middle of the side camera's pictures, enlarged.

    Raises:
        ValueError: the device computed some episodes wrongly.
    """
    policy = run.policy.with_sampler()
    settings = run.config.evaluation

    def one(case: tuple[str, str]) -> str:
        scene, task = case
        sizes = settings.worlds, run.config.image_size, settings.denoise_steps
        env, rollout = _rollout(scene, task, run.config.robot, *sizes, cropped)
        key = RandomStream.FINAL_EVALUATION.key(run.config.seed, task)
        result = evaluate(policy, env, key, settings.episodes, rollout=rollout)
        return "".join("01"[succeeded] for succeeded in result.outcomes)

    cases = [(scene, task) for scene in scenes for task in run.config.tasks]
    found = map_rollouts(one, cases)
    if bias := metrics.position_bias([x == "1" for x in text] for text in found):
        raise ValueError(bias)
    trainable, total = run.parameters
    return {
        "outcomes": dict(zip(map("/".join, cases), found, strict=True)),
        "trainable_parameters": trainable,
        "total_parameters": total,
    }


def outcomes(run: Run, scene: str, tasks: Sequence[str] = ()) -> dict[str, str]:
    """Return the outcomes of a run's policy in a scene by task; by default, of its own tasks."""
    config = dataclasses.replace(run.config, tasks=tuple(tasks or run.config.tasks))
    found = judge(run.with_policy(run.policy, config=config), (scene,))["outcomes"]
    return {name.partition("/")[2]: text for name, text in found.items()}


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


@functools.cache
def _rollout(
    scene: str, task: str, robot: str, worlds: int, size: int, steps: int, cropped: bool
) -> tuple[Env, Callable[..., Rollout]]:
    distractors, ranges = (DISTRACTORS, SHIFT) if scene == "shifted" else (0, None)
    env = envs.make(task, robot=robot, num_envs=worlds, image_size=size, distractors=distractors)
    if cropped:
        env = _Cropped(
            **{field.name: getattr(env, field.name) for field in dataclasses.fields(env)}
        )
    return env, make_rollout(env, denoise_steps=steps, ranges=ranges)


class _Cropped(Env):
    """An environment whose side camera shows the middle of its pictures, in their full size."""

    def observe(self, state: State) -> dict[str, Any]:
        observation = super().observe(state)
        image = observation["image"]["side"]
        side = int(image.shape[1] * CROP)
        inside = slice(start := (image.shape[1] - side) // 2, start + side)
        middle = image[:, inside, inside].astype(jnp.float32)
        resized = jax.image.resize(middle, image.shape, "linear").round().astype(image.dtype)
        return {**observation, "image": {**observation["image"], "side": resized}}
