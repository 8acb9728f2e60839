"""An expert episode in MuJoCo's own window, in real time, over and over."""

import itertools
import time
import warnings
from collections.abc import Callable
from typing import Any

import glfw
import jax
import mujoco
import mujoco.viewer
import numpy as np

from envs.compilation import fast_cpu
from envs.env import Env
from envs.experts import expert
from envs.scene import placing
from envs.state import State


def check_display() -> None:
    """Raises a ValueError if no window can be opened here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", glfw.GLFWError)  # the answer says it
        if not glfw.init():
            raise ValueError("there is no display to open a window on: add --out FILE.mp4")


def episode(
    env: Env,
    key: jax.Array,
    *,
    tries: int = 8,
    plan: Callable[[Env, State, jax.Array], Any] | None = None,
    act: Callable[[Env, Any, State], jax.Array] | None = None,
) -> tuple[mujoco.MjModel, np.ndarray]:
    """A successful episode of the expert: the scene of its world and all positions `[T, nq]` in it.

    Args:
        env: W worlds.
        key: all randomness.
        tries: layouts of all worlds to try.
        plan: as `expert.plan`, which is compiled by default.
        act: as `expert.act`, which is compiled by default.

    Raises:
        ValueError: if the expert never succeeds.
    """
    plan, act = plan or _plan, act or _act
    for _ in range(tries):
        key, try_key = jax.random.split(key)
        reset_key, plan_key, _ = jax.random.split(try_key, 3)  # as envs.experts.collection does it
        state = env.reset(reset_key)
        planned = plan(env, state, plan_key)
        states = [state]
        for _ in range(env.expert_steps):
            states.append(env.step(states[-1], act(env, planned, states[-1])))
        wins = np.flatnonzero(states[-1].info["success"])
        if len(wins):
            world = wins[0]
            steps = int(states[-1].info["steps"][world])
            positions = [np.asarray(state.data.qpos[world]) for state in states[: steps + 1]]
            return placing.placed(env.model, states[0].info["layout"], world), np.stack(positions)
    raise ValueError(f"the expert failed in all of {tries * env.num_envs} layouts")


def show(model: mujoco.MjModel, positions: np.ndarray, seconds: float) -> None:
    """Shows positions `[T, nq]`, each for some seconds, over and over until the window closes.

    Raises:
        ValueError: if no window can be opened.
    """
    data = mujoco.MjData(model)
    try:
        # Its panels would take two thirds of the window.
        window = mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
    except RuntimeError as error:  # on macOS, where a window needs mjpython
        raise ValueError(f"no window can be opened ({error}): add --out FILE.mp4") from error
    with window:
        for qpos in itertools.cycle(positions):
            start = time.monotonic()
            with window.lock():
                data.qpos[:] = qpos
                mujoco.mj_forward(model, data)
            window.sync()
            time.sleep(max(0.0, start + seconds - time.monotonic()))
            if not window.is_running():
                return


_plan = fast_cpu.jit(expert.plan, static_argnums=0)
_act = fast_cpu.jit(expert.act, static_argnums=0)
