"""One of the project's tasks with the PiPER, simulated by MuJoCo's C engine.

Cameras are rendered by the ray caster that policies were trained with, and the tasks' own tests
judge success. Physics differ from training: the engine, its time step, gains, friction, damping.
"""

import dataclasses
import functools
import threading
from typing import Any, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import envs
from envs.experts import expert
from envs.robots import BASE
from envs.scene import placing
from envs.state import Poses, State
from envs.tasks import View

_FIELDS = ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "xpos", "xmat", "site_xpos")
_MATRICES = ("geom_xmat", "cam_xmat", "xmat", "site_xmat")


Support = Literal["motors", "damping", "none"]

# How the fake arm's physics differ from the simulation's; all our choices.
TIMESTEP = 0.0025
"""Physics period [s]."""
_GAINS = 1.15  # factor on the servos' stiffness and damping
_FRICTION = 0.9  # factor on the friction of all contacts
_DRY_FRICTION = 0.05  # N m, friction torque in the arm's joints
_SINKING = 10.0  # N m s, damping of the joints after an emergency stop


class Limb:
    """An arm in a MuJoCo model, as its firmware sees it."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, side: str = "") -> None:
        """Find an arm whose parts' names begin with `side`, such as left_."""
        self._model, self._data = model, data
        names = [*(f"joint{i + 1}" for i in range(6)), "left", "right"]
        joints = [model.joint(side + name) for name in names]
        servos = [model.actuator(side + name).id for name in (*names[:6], "gripper")]
        bodies = model.body_rootid == model.body(side + BASE).id
        self._places = np.array([joint.qposadr[0] for joint in joints])
        self._servos, dofs = np.array(servos), np.array([joint.dofadr[0] for joint in joints])
        parts = {"actuator_gainprm": servos, "actuator_biasprm": servos}
        self._parts = parts | {"body_gravcomp": bodies, "dof_damping": dofs}
        self._supported = {name: getattr(model, name)[at] for name, at in self._parts.items()}

    @property
    def pose(self) -> np.ndarray:
        """Joints [rad] and gripper opening [m], [7]."""
        places = self._data.qpos[self._places]
        return np.append(places[:6], places[6:].sum())

    def command(self, pose: np.ndarray) -> None:
        """Set the servos' targets [7]."""
        self._data.ctrl[self._servos] = np.append(pose[:6], pose[6] / 2)

    def support(self, by: Support) -> None:
        """Choose what carries the arm: its motors, or against its weight only damping, or none."""
        for name, at in self._parts.items():
            getattr(self._model, name)[at] = self._supported[name] if by == "motors" else 0.0
        if by == "damping":
            self._model.dof_damping[self._parts["dof_damping"][:6]] = _SINKING
        elif by == "none":
            self._model.dof_damping[self._parts["dof_damping"]] = self._supported["dof_damping"]


class World:
    """A task scene with a PiPER.

    Attributes:
        env: the environment that the scene, the cameras and the success test come from.
        state: its state at reset, one world; the expert plans from it.
        data: MuJoCo's data now.
        success: whether the task has been solved.
        instruction: the request in words.
        instructions: all phrasings of it.
        control_dt: time between two actions [s].
    """

    def __init__(self, task: str, *, image_size: int = 64) -> None:
        """Build a task's scene; call `reset` before anything else.

        Raises:
            ValueError: the task is unknown.
        """
        self.env: envs.Env = envs.make(task, robot="piper", num_envs=1, image_size=image_size)
        self.instructions, self.control_dt = self.env.instructions, self.env.control_dt
        self._hold_steps = self.env.task.hold_steps
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
        unlike_training(self.model)
        self.data = mujoco.MjData(self.model)
        self._limb = Limb(self.model, self.data)
        self.data.qpos[:] = np.asarray(self.state.data.qpos[0])
        self.command(self.pose)
        mujoco.mj_forward(self.model, self.data)
        self.instruction = self.instructions[int(self.state.info["instruction"][0])]
        self.success, self._held = False, 0

    @property
    def limbs(self) -> dict[str, "Limb | World"]:
        """The arms by name; a single arm has none, and is moved through this world."""
        return {"": self}

    @property
    def pose(self) -> np.ndarray:
        """Joints [rad] and gripper opening [m], [7]."""
        return self._limb.pose

    def demonstration(self, seed: int) -> np.ndarray:
        """Return the scripted expert's actions [T, 7] from the start of this layout."""
        _, key = jax.random.split(jax.random.key(seed))  # the first is the layout's
        return np.asarray(_actions(self.env, self.state, key))

    def command(self, pose: np.ndarray) -> None:
        """Set the servos' targets [7]."""
        self._limb.command(pose)

    def support(self, by: Support) -> None:
        """Choose what carries the arm, as in `Limb`."""
        with self._lock:
            self._limb.support(by)

    def advance(self, seconds: float) -> None:
        """Simulate a multiple of the time step."""
        with self._lock:
            mujoco.mj_step(self.model, self.data, round(seconds / TIMESTEP))

    def judge(self) -> bool:
        """Test for success, as the environment does after every control step."""
        self._held = self._held + 1 if bool(self._check(self._arrays())) else 0
        self.success |= self._held >= self._hold_steps
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


def unlike_training(model: mujoco.MjModel) -> None:
    """Change a scene's physics."""
    model.opt.timestep = TIMESTEP
    model.actuator_gainprm *= _GAINS
    model.actuator_biasprm *= _GAINS
    model.geom_friction *= _FRICTION
    hinges = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE  # only arms have any
    model.dof_frictionloss[model.jnt_dofadr[hinges]] = _DRY_FRICTION


def _check(env: envs.Env, arrays: dict[str, jax.Array]) -> jax.Array:
    zero = jnp.zeros(0)
    data = envs.state.Data(qacc_warmstart=zero, xquat=zero, **arrays)
    return env.task.check(View(env.model, data))[0]


@functools.partial(jax.jit, static_argnums=0)
def _actions(env: envs.Env, state: envs.State, key: jax.Array) -> jax.Array:
    """Return the expert's actions [T, 7] from a state of one world."""
    plan = expert.plan(env, state, key)

    def act(step: jax.Array) -> jax.Array:
        at_step = dataclasses.replace(state, info=state.info | {"steps": step[None]})
        return expert.act(env, plan, at_step)[0]

    return jax.vmap(act)(jnp.arange(env.expert_steps))
