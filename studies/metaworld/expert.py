"""Meta-World's scripted experts at a tenth of a second per action."""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from metaworld.policies import ENV_POLICY_MAP  # pyright: ignore[reportMissingImports]

from studies.metaworld.world import HOLD, World, state

Plan = Callable[[World, Any, np.ndarray], np.ndarray]
"""World, expert and observation -> the action of the next `HOLD` steps, f32 `[4]`."""
MAX_STEPS = 248
"""Environment steps after which an attempt has failed; the package ends episodes at 500."""
STATE = mujoco.mjtState.mjSTATE_INTEGRATION


@dataclass
class Demonstration:
    """An episode of T actions.

    Attributes:
        pictures: T pictures, uint8 `[H, W, 3]`, each before its action; none without success.
        state: f32 `[T, 4]`.
        action: f32 `[T, 4]`, hand displacement and gripper force in [-1, 1].
        success: whether the environment said so.
        steps: environment steps.
    """

    pictures: list[np.ndarray]
    state: np.ndarray
    action: np.ndarray
    success: bool
    steps: int


def demonstrate(world: World, name: str, seed: int) -> Demonstration:
    """Solve a layout with the mean of the expert's next actions, or else with held actions."""
    mean = _run(world, name, seed, look_ahead)
    return mean if mean.success else _run(world, name, seed, act_now)


def _run(world: World, name: str, seed: int, plan: Plan) -> Demonstration:
    """Run an expert until the environment reports success, at most `MAX_STEPS` steps."""
    expert = ENV_POLICY_MAP[f"{name}-v3"]()
    observation, _ = world.reset(seed=seed)
    moments, states, actions = [], [], []
    success, steps = False, 0
    while not success and steps < MAX_STEPS:
        action = plan(world, expert, observation)
        moments.append(copy.copy(world.inner.data))
        states.append(state(observation))
        actions.append(action)
        for _ in range(HOLD):
            observation, _, _, _, info = world.step(action)
            steps += 1
            success = bool(info["success"])
            if success:
                break
    pictures = [world.picture(moment) for moment in moments] if success else []
    rows = np.array(states, np.float32), np.array(actions, np.float32)
    return Demonstration(pictures, rows[0], rows[1], success, steps)


def look_ahead(world: World, expert: Any, observation: np.ndarray) -> np.ndarray:
    """Return the mean of the expert's next `HOLD` actions, f32 `[4]`.

    The experts are feedback laws for 80 Hz, and some oscillate if an action of theirs is held for
    eight steps. The mean moves the hand as far as the eight actions would. The world is left as it
    was.
    """
    inner = world.inner
    attributes = dict(inner.__dict__)
    physics = np.empty(mujoco.mj_stateSize(inner.model, STATE))
    mujoco.mj_getState(inner.model, inner.data, physics, STATE)
    actions = []
    for _ in range(HOLD):
        actions.append(np.clip(expert.get_action(observation), -1, 1))
        observation, *_ = world.step(actions[-1])
    inner.__dict__.clear()
    inner.__dict__.update(attributes)
    mujoco.mj_setState(inner.model, inner.data, physics, STATE)
    mujoco.mj_forward(inner.model, inner.data)
    return np.asarray(np.mean(actions, axis=0), np.float32)


def act_now(world: World, expert: Any, observation: np.ndarray) -> np.ndarray:  # noqa: ARG001
    """Return the expert's next action alone, f32 `[4]`; stiff handles need its full force."""
    return np.asarray(np.clip(expert.get_action(observation), -1, 1), np.float32)
