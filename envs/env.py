"""Batched manipulation environments: pure functions over W worlds.

    env = envs.make("press", robot="piper", num_envs=64, image_size=64)
    state = env.reset(jax.random.key(0))
    state = env.step(state, action)
    pictures = env.observe(state)["image"]

Nothing is rendered unless `observe` is called, and no world restarts unless `reset_done` is.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs import actions, distractors, physics, render, scene
from envs.robots import Robot
from envs.tasks import Task, View

TARGET_DT = 0.02  # s, joint targets are interpolated to this rate between two actions
_HOME_NOISE = 0.03  # rad, half the range of the random start pose around home
_START_OPENING = 0.04  # m, of the gripper


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """W worlds; every leaf has leading axis W.

    Attributes:
        data: MJX data, poses up to date.
        reward: f32 [W], 1 where the task is done successfully.
        done: bool [W], latched; a done world stands still until `reset_done`.
        metrics: f32 [W] each, what the task measures.
        info: success bool [W]; steps int32 [W]; instruction int32 [W], index into
            `env.instructions`; command f32 [W, J + 1], the last targets sent to the robot [rad, m];
            held int32 [W], consecutive control steps at the goal; broken bool [W], ended at its
            last good moment because physics was not finite after it; layout, body name -> [W, 4]
            at reset: x, y, z [m], turn about z [rad].
    """

    data: Any
    reward: jax.Array
    done: jax.Array
    metrics: dict[str, jax.Array]
    info: dict[str, Any]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Trajectory:
    """What W worlds went through in T control steps.

    Attributes:
        state: f32 [T, W, J + 1] joints [rad] and gripper opening [m] before each action.
        action: f32 [T, W, A].
        reward: f32 [T, W] after it.
        done: bool [T, W] after it.
    """

    state: jax.Array
    action: jax.Array
    reward: jax.Array
    done: jax.Array


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Env:
    """A task for a robot in `num_envs` worlds W, made by `envs.make`; methods are pure."""

    task: Task
    robot: Robot
    num_envs: int
    image_size: int
    antialias: int
    distractors: int
    control_dt: float
    actions: actions.Mode
    model: mujoco.MjModel
    physics_model: Any
    render_model: Any
    template: Any

    physics_dt = scene.PHYSICS_DT
    cameras = scene.CAMERAS

    @property
    def num_joints(self) -> int:
        """J, without the gripper."""
        return self.robot.num_joints

    @property
    def action_low(self) -> np.ndarray:
        """Lowest action [A], float32; units as in `envs.actions`."""
        return actions.bounds(self.actions, self.robot, self.control_dt)[0]

    @property
    def action_high(self) -> np.ndarray:
        """Highest action [A], float32."""
        return actions.bounds(self.actions, self.robot, self.control_dt)[1]

    @property
    def instructions(self) -> tuple[str, ...]:
        """Phrasings of the task; `info["instruction"]` indexes them."""
        return self.task.instructions

    @property
    def max_steps(self) -> int:
        """Control steps after which an episode ends."""
        return round(self.task.time_limit / self.control_dt)

    @property
    def expert_steps(self) -> int:
        """Control steps that the expert is given."""
        return round(self.task.expert_time / self.control_dt)

    @functools.partial(jax.jit, static_argnums=0)
    def reset(self, key: jax.Array) -> State:
        """Fresh worlds: random layout, phrasing and start pose near home, all from `key`."""
        return jax.vmap(self._reset)(jax.random.split(key, self.num_envs))

    def step(self, state: State, action: jax.Array) -> State:
        """Simulate one control step.

        Args:
            state: W worlds.
            action: [W, A], by default A = J + 1 joint targets [rad] and gripper opening [m]; other
                conventions in `envs.actions`. Clipped to `action_low`, `action_high` and to what
                the robot's speed limits allow.

        Returns:
            The worlds `control_dt` later. Worlds that were done have not moved.

        Raises:
            ValueError: if the action has another shape.
        """
        expected = (self.num_envs, len(self.action_low))
        if action.shape != expected:
            raise ValueError(f"action must have shape {expected}, got {action.shape}")
        # A weakly typed action, such as jnp.full(shape, 0.0), would compile all anew.
        return self._steps(state, jax.lax.convert_element_type(action, jnp.float32))

    @functools.partial(jax.jit, static_argnums=0)
    def observe(self, state: State) -> dict[str, Any]:
        """What a policy may see.

        Returns:
            `image`: camera name -> uint8 [W, image_size, image_size, 3]; `state`: f32 [W, J + 1]
            measured joint angles [rad] and gripper opening [m].
        """
        data = state.data
        return {
            "image": self.render(data.geom_xpos, data.geom_xmat, data.cam_xpos, data.cam_xmat),
            "state": self.proprio(state),
        }

    def rollout(
        self, policy: Callable[[dict[str, Any], jax.Array], jax.Array], key: jax.Array
    ) -> tuple[State, "Trajectory"]:
        """Fresh worlds with a policy in the loop until the time limit; may be called under jit.

        Args:
            policy: (observation, key) -> action [W, A]. The observation is that of `observe`, with
                `instruction` int32 [W]; pictures that the policy does not read are not rendered.
            key: all randomness.
        """
        reset_key, policy_key = jax.random.split(key)

        def body(state: State, key: jax.Array) -> tuple[State, Trajectory]:
            seen = self.observe(state) | {"instruction": state.info["instruction"]}
            action = policy(seen, key)
            after = self.step(state, action)
            return after, Trajectory(seen["state"], action, after.reward, after.done)

        keys = jax.random.split(policy_key, self.max_steps)
        return jax.lax.scan(body, self.reset(reset_key), keys)

    def reset_done(self, state: State, key: jax.Array) -> State:
        """The same worlds, those that are done started afresh."""
        return jax.jit(_where)(state.done, self.reset(key), state)

    def proprio(self, state: State) -> jax.Array:
        """Measured joint angles [rad] and gripper opening [m], f32 [W, J + 1]."""
        joints = state.data.qpos[:, : self.num_joints]
        fingers = state.data.qpos[:, self.num_joints : self.num_joints + 2]
        return jnp.concatenate([joints, jnp.sum(fingers, axis=1, keepdims=True)], axis=1)

    def render(
        self, geom_xpos: jax.Array, geom_xmat: jax.Array, cam_xpos: jax.Array, cam_xmat: jax.Array
    ) -> dict[str, jax.Array]:
        """Pictures of N recorded scenes: camera name -> uint8 [N, image_size, image_size, 3]."""
        poses, size = (geom_xpos, geom_xmat, cam_xpos, cam_xmat), self.image_size
        pictures = render.render_batch(
            self.render_model, *poses, height=size, width=size, samples=self.antialias
        )
        return {name: pictures[:, i] for i, name in enumerate(self.cameras)}

    @functools.partial(jax.jit, static_argnums=0)
    def _steps(self, state: State, action: jax.Array) -> State:
        return jax.vmap(self._step)(state, action)

    def _reset(self, key: jax.Array) -> State:
        layout_key, pose_key, instruction_key = jax.random.split(key, 3)
        layout = self.task.place(layout_key)
        others = jax.random.fold_in(layout_key, 1)
        layout |= distractors.place(others, layout, self.distractors)
        noise = jax.random.uniform(pose_key, (self.num_joints,), minval=-1.0, maxval=1.0)
        joints = jnp.asarray(self.robot.home, jnp.float32) + _HOME_NOISE * noise
        low, high = self.robot.action_low, self.robot.action_high
        command = jnp.clip(jnp.append(joints, _START_OPENING), low, high)
        fingers = jnp.full(2, command[-1] / 2)
        qpos = self.template.qpos.at[: self.num_joints + 2].set(
            jnp.concatenate([command[:-1], fingers])
        )
        for name, place in layout.items():
            body = self.model.body(name)
            if body.jntnum[0]:  # free; the others are moved in `_placed`
                start = self.model.jnt_qposadr[body.jntadr[0]]
                qpos = qpos.at[start : start + 7].set(_pose(place))
        data = physics.kinematics(self._placed(layout), self.template.replace(qpos=qpos))
        _, metrics = self.task.check(View(self.model, data))
        number = jax.random.randint(instruction_key, (), 0, len(self.instructions), jnp.int32)
        zero, false = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
        info = {
            "success": false,
            "steps": zero,
            "instruction": number,
            "command": command,
            "held": zero,
            "broken": false,
            "layout": layout,
        }
        return State(data, jnp.zeros((), jnp.float32), false, metrics, info)

    def _step(self, state: State, action: jax.Array) -> State:
        info = state.info
        reach = jnp.asarray(self.robot.action_speed) * self.control_dt
        action = jnp.clip(action, self.action_low, self.action_high)
        target = actions.to_targets(self.actions, self.robot, info["command"], action)
        target = jnp.clip(target, self.robot.action_low, self.robot.action_high)
        target = jnp.clip(target, info["command"] - reach, info["command"] + reach)
        controls = self._controls(info["command"], target)
        data = physics.advance(self._placed(info["layout"]), state.data, controls)
        reached, metrics = self.task.check(View(self.model, data))
        held = jnp.where(reached, info["held"] + 1, 0)
        steps = info["steps"] + 1
        success = held >= self.task.hold_steps
        after = State(
            data=data,
            reward=success.astype(jnp.float32),
            done=success | (steps >= self.max_steps),
            metrics=metrics,
            info=info | {"success": success, "steps": steps, "command": target, "held": held},
        )
        finite = jnp.all(jnp.isfinite(data.qpos)) & jnp.all(jnp.isfinite(data.qvel))
        true = jnp.ones((), bool)
        broken = dataclasses.replace(state, done=true, info=info | {"broken": true})
        return _where(state.done, state, _where(finite, after, broken))

    def _placed(self, layout: dict[str, jax.Array]) -> Any:
        """The physics model of one world: fixed bodies stand where the layout says."""
        # Mocap bodies would be the usual way, but MJX leaves their children behind.
        position, rotation = self.physics_model.body_pos, self.physics_model.body_quat
        for name, place in layout.items():
            body, pose = self.model.body(name), _pose(place)
            if not body.jntnum[0]:  # free ones have their place in qpos
                position = position.at[body.id].set(pose[:3])
                rotation = rotation.at[body.id].set(pose[3:])
        return self.physics_model.replace(body_pos=position, body_quat=rotation)

    def _controls(self, start: jax.Array, end: jax.Array) -> jax.Array:
        """Actuator targets [S, J + 1] of the S physics steps between two commands."""
        moves = round(self.control_dt / TARGET_DT)
        fraction = jnp.arange(1, moves + 1, dtype=jnp.float32)[:, None] / moves
        targets = start + fraction * (end - start)
        targets = targets.at[:, -1].multiply(0.5)  # each finger makes half of the opening
        return jnp.repeat(targets, round(TARGET_DT / scene.PHYSICS_DT), axis=0)


def _pose(place: jax.Array) -> jax.Array:
    """Position in m and unit quaternion [7] of a place of a layout."""
    half = place[3] / 2
    return jnp.stack([*place[:3], jnp.cos(half), 0.0 * half, 0.0 * half, jnp.sin(half)])


def _where(condition: jax.Array, yes: Any, no: Any) -> Any:
    """`jnp.where` over two trees; the condition's axes are the leading ones of every leaf."""

    def choose(a: jax.Array, b: jax.Array) -> jax.Array:
        shape = condition.shape + (1,) * (a.ndim - condition.ndim)
        return jnp.where(condition.reshape(shape), a, b)

    return jax.tree.map(choose, yes, no)
