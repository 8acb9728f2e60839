"""Show an expert episode in MuJoCo's viewer, in real time and in a loop."""

import itertools
import time
import warnings

import glfw
import jax
import mujoco
import mujoco.viewer
import numpy as np

from envs.env import Env
from envs.experts import expert
from envs.scene import placing
from lorasp_jax.base import fast_cpu

_TRIES = 8  # maximum number of resets; our choice
_plan = fast_cpu.jit(expert.plan, static_argnums=0)
_act = fast_cpu.jit(expert.act, static_argnums=0)


def check_display() -> None:
    """Raise a ValueError if no window can be opened."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", glfw.GLFWError)  # `init` also returns False
        if not glfw.init():
            raise ValueError("cannot open a window without a display: add --out FILE.mp4")


def episode(env: Env, key: jax.Array) -> tuple[mujoco.MjModel, np.ndarray]:
    """Simulate a successful episode of the expert.

    Args:
        env: environment; its parallel worlds are independent attempts.
        key: source of all randomness.

    Returns:
        Model of the successful world, and the joint positions `[T, nq]` over time.

    Raises:
        ValueError: the expert never succeeds.
    """
    for _ in range(_TRIES):
        key, try_key = jax.random.split(key)
        reset_key, plan_key, _ = jax.random.split(try_key, 3)  # as in envs.experts.collection
        state = env.reset(reset_key)
        planned = _plan(env, state, plan_key)
        states = [state]
        for _ in range(env.expert_steps):
            states.append(env.step(states[-1], _act(env, planned, states[-1])))
        wins = np.flatnonzero(states[-1].info["success"])
        if len(wins):
            world = wins[0]
            steps = int(states[-1].info["steps"][world])
            positions = [np.asarray(state.data.qpos[world]) for state in states[: steps + 1]]
            model = placing.world_model(env.model, states[0].info["layout"], world)
            return model, np.stack(positions)
    raise ValueError(f"the expert failed in all {_TRIES * env.num_envs} layouts")


def show(model: mujoco.MjModel, positions: np.ndarray, seconds: float) -> None:
    """Replay joint positions `[T, nq]` until the window is closed, each row for `seconds`.

    Raises:
        ValueError: no window can be opened.
    """
    data = mujoco.MjData(model)
    try:
        # The panels would take two thirds of the window.
        window = mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
    except RuntimeError as error:  # on macOS, where the viewer needs mjpython
        raise ValueError(f"cannot open a window ({error}): add --out FILE.mp4") from error
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
