"""One of the project's tasks with the PiPER, simulated by MuJoCo's C engine.

Cameras are rendered by the ray caster that policies were trained with, and the tasks' own tests
judge success. Physics differ from training: the engine, its time step, gains, friction, damping.
"""

import functools
import threading
from typing import Any, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import envs
from envs.scene import placing
from envs.state import Poses, State
from envs.tasks import View

_FIELDS = ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "xpos", "xmat", "site_xpos")
_SUPPORT = ("actuator_gainprm", "actuator_biasprm", "body_gravcomp", "dof_damping")
_MATRICES = ("geom_xmat", "cam_xmat", "xmat", "site_xmat")


# How the fake arm's physics differ from the simulation's; all our choices.
TIMESTEP = 0.0025
"""Physics period [s]."""
_GAINS = 1.15  # factor on the servos' stiffness and damping
_FRICTION = 0.9  # factor on the friction of all contacts
_DRY_FRICTION = 0.05  # N m, friction torque in the arm's joints
_SINKING = 10.0  # N m s, damping of the joints after an emergency stop


class World:
    """A task scene with a PiPER.

    Attributes:
        env: the environment that the scene, the cameras and the success test come from.
        state: its state at reset, one world; the expert plans from it.
        data: MuJoCo's data now.
        success: whether the task has been solved.
        instruction: the request in words.
    """

    def __init__(self, task: str, *, image_size: int = 64) -> None:
        """Build a task's scene; call `reset` before anything else.

        Raises:
            ValueError: the task is unknown.
        """
        self.env: envs.Env = envs.make(task, robot="piper", num_envs=1, image_size=image_size)
        self._render = jax.jit(self.env.render)
        self._check = jax.jit(functools.partial(_check, self.env))
        self._lock = threading.Lock()  # the arm may live in a thread of its own

    def reset(self, seed: int) -> None:
        """Start a random layout."""
        with self._lock:
            self._reset(seed)

    def _reset(self, seed: int) -> None:
        self.state: State = self.env.reset(jax.random.key(seed))
        self.model = placing.world_model(self.env.model, self.state.info["layout"], 0)
        self.model.opt.timestep = TIMESTEP
        self.model.actuator_gainprm *= _GAINS
        self.model.actuator_biasprm *= _GAINS
        self.model.geom_friction *= _FRICTION
        self.model.dof_frictionloss[:6] = _DRY_FRICTION
        self._supported = {name: getattr(self.model, name).copy() for name in _SUPPORT}
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = np.asarray(self.state.data.qpos[0])
        self.command(self.pose)
        mujoco.mj_forward(self.model, self.data)
        self.instruction = self.env.instructions[int(self.state.info["instruction"][0])]
        self.success, self._held = False, 0

    @property
    def pose(self) -> np.ndarray:
        """Joints [rad] and gripper opening [m], [7]."""
        return np.append(self.data.qpos[:6], self.data.qpos[6:8].sum())

    def command(self, pose: np.ndarray) -> None:
        """Set the servos' targets [7]."""
        self.data.ctrl[:] = np.append(pose[:6], pose[6] / 2)

    def support(self, by: Literal["motors", "damping", "none"]) -> None:
        """Choose what carries the arm: its motors, or against its weight only damping, or none."""
        with self._lock:
            for name, value in self._supported.items():
                getattr(self.model, name)[:] = value if by == "motors" else 0.0
            if by == "damping":
                self.model.dof_damping[:6] = _SINKING
            elif by == "none":
                self.model.dof_damping[:] = self._supported["dof_damping"]

    def advance(self, seconds: float) -> None:
        """Simulate a multiple of the time step."""
        with self._lock:
            mujoco.mj_step(self.model, self.data, round(seconds / TIMESTEP))

    def judge(self) -> bool:
        """Test for success, as the environment does after every control step."""
        self._held = self._held + 1 if bool(self._check(self._arrays())) else 0
        self.success |= self._held >= self.env.task.hold_steps
        return self.success

    def images(self) -> dict[str, np.ndarray]:
        """Render camera name -> uint8 [size, size, 3]."""
        arrays = self._arrays()
        poses = Poses(*(arrays[name][None] for name in Poses._fields))
        return {name: np.asarray(image[0]) for name, image in self._render(poses).items()}

    def _arrays(self) -> dict[str, Any]:
        """Return what rendering and tasks read, with poses up to date."""
        names = (*_FIELDS, "site_xmat", "qpos", "qvel")
        with self._lock:
            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_camlight(self.model, self.data)
            arrays = {name: getattr(self.data, name).astype(np.float32) for name in names}
        return arrays | {name: arrays[name].reshape(-1, 3, 3) for name in _MATRICES}


def _check(env: envs.Env, arrays: dict[str, jax.Array]) -> jax.Array:
    zero = jnp.zeros(0)
    data = envs.state.Data(qacc_warmstart=zero, xquat=zero, **arrays)
    return env.task.check(View(env.model, data))[0]
