"""Batched manipulation environments: pure functions over W worlds.

    env = envs.make("press", robot="piper", num_envs=64, image_size=64)
    state = env.reset(jax.random.key(0))
    state = env.step(state, action)
    pictures = env.observe(state)["image"]

Nothing is rendered unless `observe` is called, and no world restarts unless `reset_done` is.
"""

import dataclasses
import enum
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs import actions, checks, observations, rewards
from envs.compilation import fast_cpu, messages
from envs.physics.physics import Physics
from envs.rendering.renderer import Look, Renderer, RenderModel
from envs.robots import Robot
from envs.scene import distractors, placing, randomization, scene
from envs.scene.randomization import Draw, Randomization
from envs.state import Changes, Data, State, Trajectory, where
from envs.tasks import Layout, Task, View

_HOME_NOISE = 0.03  # rad, half the range of the random start pose around home
_START_OPENING = 0.04  # m, of the gripper


@enum.unique
class _LayoutStream(enum.IntEnum):
    """What is drawn at random beside a layout, from a key of its own derived from the layout's."""

    DISTRACTORS = 1
    RANDOMIZATION = 2


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Env:
    """A task for a robot in `num_envs` worlds W, made by `envs.make`; methods are pure."""

    task: Task
    robot: Robot
    num_envs: int
    distractors: int
    control_dt: float
    actions: actions.Mode
    reward: rewards.Reward
    discount: float
    model: mujoco.MjModel
    physics: Physics
    renderer: Renderer

    physics_dt = scene.PHYSICS_DT
    cameras = scene.CAMERAS

    def __repr__(self) -> str:
        return f"<Env {self.task.name!r} for {self.robot.name!r}, num_envs={self.num_envs}>"

    @property
    def render_model(self) -> RenderModel:
        """What the renderer draws."""
        return self.renderer.model

    @property
    def num_joints(self) -> int:
        """J, without the gripper."""
        return self.robot.num_joints

    @property
    def image_size(self) -> int:
        """Height and width of the pictures in pixels."""
        return self.renderer.image_size

    @property
    def antialias(self) -> int:
        """n for n x n rays a pixel."""
        return self.renderer.samples

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

    def reset(self, key: jax.Array, ranges: Randomization | None = None) -> State:
        """Fresh worlds: random layout, phrasing and start pose near home, all from `key`.

        Args:
            key: all randomness.
            ranges: what else differs from world to world; None for nothing.

        Raises:
            TypeError: if the key is none.
            ValueError: if the ranges make no sense.
        """
        ranges = randomization.prepared(ranges, self.control_dt)
        with self._calls.first("reset", ranges is None):
            return self._resets(checks.key(key), ranges)

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
            TypeError: if the action is no array of numbers, or the state none.
            ValueError: if the action has another shape, or the state other worlds.
        """
        self._check_worlds(state)
        action = checks.action(action, (self.num_envs, len(self.action_low)))
        # A weakly typed action, such as jnp.full(shape, 0.0), would compile all anew.
        action = jax.lax.convert_element_type(action, jnp.float32)
        with self._calls.first("step", state.info["draw"] is None):
            return self._steps(state, action)

    def observe(self, state: State) -> dict[str, Any]:
        """What a policy may see.

        Returns:
            `image`: camera name -> uint8 [W, image_size, image_size, 3]; `state`: f32 [W, J + 1]
            measured joint angles [rad] and gripper opening [m].

        Raises:
            TypeError, ValueError: as `step`, for the state.
        """
        self._check_worlds(state)
        with self._calls.first("pictures", state.info["draw"] is None):
            return self._observes(state)

    @functools.partial(fast_cpu.jit, static_argnums=0)
    def _observes(self, state: State) -> dict[str, Any]:
        data = state.data
        poses = (data.geom_xpos, data.geom_xmat, data.cam_xpos, data.cam_xmat)
        return {
            "image": self.render(*poses, draw=state.info["draw"]),
            "state": self.proprio(state),
        }

    def rollout(
        self,
        policy: Callable[[dict[str, Any], jax.Array], jax.Array],
        key: jax.Array,
        ranges: Randomization | None = None,
    ) -> tuple[State, Trajectory]:
        """Fresh worlds with a policy in the loop until the time limit; may be called under jit.

        Args:
            policy: (observation, key) -> action [W, A]. The observation is that of `observe`, with
                `instruction` int32 [W]; pictures that the policy does not read are not rendered.
            key: all randomness.
            ranges: as for `reset`.

        Raises:
            TypeError, ValueError: as `reset` and `step`, or if the policy cannot be called.
        """
        if not callable(policy):
            what = checks.short(policy)
            raise TypeError(f"policy must be a function (observation, key) -> action, got {what}")
        checks.key(key)
        reset_key, policy_key = jax.random.split(key)

        def body(state: State, key: jax.Array) -> tuple[State, Trajectory]:
            seen = self.observe(state) | {"instruction": state.info["instruction"]}
            action = policy(seen, key)
            after = self.step(state, action)
            return after, Trajectory(seen["state"], action, after.reward, after.done)

        keys = jax.random.split(policy_key, self.max_steps)
        start = self.reset(reset_key, ranges)
        with self._calls.said("rollout"):  # always: JAX knows no policy again
            return jax.lax.scan(body, start, keys)

    def reset_done(
        self, state: State, key: jax.Array, ranges: Randomization | None = None
    ) -> State:
        """The same worlds, those that are done started afresh, with the ranges of their `reset`.

        Raises:
            TypeError: as `reset` and `step`.
            ValueError: if only one of the two had ranges, or they make no sense.
        """
        self._check_worlds(state)
        if (ranges is None) != (state.info["draw"] is None):
            raise ValueError("reset_done needs ranges if, and only if, reset was given some")
        return jax.jit(where)(state.done, self.reset(key, ranges), state)

    def proprio(self, state: State) -> jax.Array:
        """Measured joint angles [rad] and gripper opening [m], f32 [W, J + 1].

        Raises:
            TypeError: if the state is none.
        """
        checks.instance("state", state, State, "what reset gave")
        joints = state.data.qpos[:, : self.num_joints]
        fingers = state.data.qpos[:, self.num_joints : self.num_joints + 2]
        return jnp.concatenate([joints, jnp.sum(fingers, axis=1, keepdims=True)], axis=1)

    def full_state(self, state: State) -> jax.Array:
        """All that a learner may know beside pictures, f32 [W, D]; `full_state_layout` says what.

        Joints, speeds and last targets of the robot, where its tool is, and relative to that where
        the task's objects are and how they move: see `envs.observations.parts`.

        Raises:
            TypeError: if the state is none.
        """
        checks.instance("state", state, State, "what reset gave")
        return self._full_states(state)

    @functools.partial(jax.jit, static_argnums=0)
    def _full_states(self, state: State) -> jax.Array:
        return jax.vmap(self._full_state)(state)

    def _full_state(self, state: State) -> jax.Array:
        """That of one world, f32 [D]."""
        found = observations.parts(self.model, state.data, state.info["command"], self._placed)
        return jnp.concatenate([*found.values()])

    @functools.cached_property
    def full_state_layout(self) -> dict[str, slice]:
        """Name -> where it lies in the last axis of `full_state`."""
        return observations.layout(self.model, self.num_joints, self._placed)

    def render(
        self,
        geom_xpos: jax.Array,
        geom_xmat: jax.Array,
        cam_xpos: jax.Array,
        cam_xmat: jax.Array,
        *,
        draw: Draw | None = None,
    ) -> dict[str, jax.Array]:
        """Pictures of N recorded scenes: camera name -> uint8 [N, image_size, image_size, 3].

        Args:
            geom_xpos: `[N, ...]`, from the data of a state.
            geom_xmat: likewise.
            cam_xpos: likewise.
            cam_xmat: likewise.
            draw: what the worlds drew, leading axis N, from the info of that state.
        """
        look, size = jax.vmap(self._looks)(draw) if draw else (None, None)
        pictures = self.renderer((geom_xpos, geom_xmat, cam_xpos, cam_xmat), look, size)
        return {name: pictures[:, i] for i, name in enumerate(self.cameras)}

    def _check_worlds(self, state: Any) -> None:
        checks.instance("state", state, State, "what reset gave")
        if state.done.shape != (self.num_envs,):
            found = state.done.shape[0] if state.done.shape else "no axis of"
            raise ValueError(f"state has {found} worlds, this environment {self.num_envs}")

    @functools.cached_property
    def _calls(self) -> messages.Calls:
        worlds = "one world" if self.num_envs == 1 else f"{self.num_envs} worlds"
        return messages.Calls(f"{self.task.name}, {worlds}")

    @functools.partial(fast_cpu.jit, static_argnums=0)
    def _steps(self, state: State, action: jax.Array) -> State:
        return jax.vmap(self._step)(state, action)

    @functools.partial(fast_cpu.jit, static_argnums=0)
    def _resets(self, key: jax.Array, ranges: Randomization | None) -> State:
        keys = jax.random.split(key, self.num_envs)
        return jax.vmap(functools.partial(self._reset, ranges))(keys)

    def _reset(self, ranges: Randomization | None, key: jax.Array) -> State:
        layout_key, pose_key, instruction_key = jax.random.split(key, 3)
        layout = self.task.place(layout_key)
        others_key = jax.random.fold_in(layout_key, _LayoutStream.DISTRACTORS)
        layout |= distractors.place(others_key, layout, self.distractors)
        draw = None
        if ranges:
            draw_key = jax.random.fold_in(layout_key, _LayoutStream.RANDOMIZATION)
            draw, layout = randomization.draw(draw_key, ranges, self.model, layout)
        noise = jax.random.uniform(pose_key, (self.num_joints,), minval=-1.0, maxval=1.0)
        joints = jnp.asarray(self.robot.home, jnp.float32) + _HOME_NOISE * noise
        low, high = self.robot.action_low, self.robot.action_high
        command = jnp.clip(jnp.append(joints, _START_OPENING), low, high)
        data = self._start(draw, layout, command)
        _, metrics = self._check(draw, data)
        number = jax.random.randint(instruction_key, (), 0, len(self.instructions), jnp.int32)
        zero, false = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
        info = {
            "success": false,
            "steps": zero,
            "instruction": number,
            "command": command,
            "earlier": command,
            "held": zero,
            "broken": false,
            "layout": layout,
            "draw": draw,
        }
        state = State(data, jnp.zeros((), jnp.float32), false, metrics, info)
        return state if self.reward == "sparse" else rewards.started(state, self._stages(state))

    def _step(self, state: State, action: jax.Array) -> State:
        after = self._move(state, action)
        if self.reward == "sparse":
            return after
        return rewards.earned(state, after, self._stages(after), self.discount)

    def _move(self, state: State, action: jax.Array) -> State:
        info = state.info
        reach = jnp.asarray(self.robot.action_speed) * self.control_dt
        action = jnp.clip(action, self.action_low, self.action_high)
        target = actions.to_targets(self.actions, self.robot, info["command"], action)
        target = jnp.clip(target, self.robot.action_low, self.robot.action_high)
        target = jnp.clip(target, info["command"] - reach, info["command"] + reach)
        draw = info["draw"]
        commands = jnp.stack([info["earlier"], info["command"], target])
        latency = draw.latency if draw else 0.0
        controls = actions.interpolate(commands, self.control_dt, latency)
        changes = self._changes(draw, info["layout"])
        data = self._filmed(draw, self.physics.advance(changes, state.data, controls))
        reached, metrics = self._check(draw, data)
        held = jnp.where(reached, info["held"] + 1, 0)
        steps = info["steps"] + 1
        success = held >= self.task.hold_steps
        after = State(
            data=data,
            reward=success.astype(jnp.float32),
            done=success | (steps >= self.max_steps),
            metrics=state.metrics | metrics,
            info=info
            | {"success": success, "steps": steps, "held": held}
            | {"command": target, "earlier": info["command"]},
        )
        finite = jnp.all(jnp.isfinite(data.qpos)) & jnp.all(jnp.isfinite(data.qvel))
        true = jnp.ones((), bool)
        broken = dataclasses.replace(state, done=true, info=info | {"broken": true})
        return where(state.done, state, where(finite, after, broken))

    def _start(self, draw: Draw | None, layout: Layout, command: jax.Array) -> Data:
        """A world at rest, its robot where the command wants it."""
        joints = jnp.concatenate([command[:-1], jnp.full(2, command[-1] / 2)])
        qpos = placing.positions(self.model, layout, joints)
        return self._filmed(draw, self.physics.start(self._changes(draw, layout), qpos))

    def _changes(self, draw: Draw | None, layout: Layout) -> Changes:
        """How one world's model differs: what it drew, and where its fixed bodies stand."""
        changes = randomization.changes(draw, self.model, self._objects) if draw else {}
        return changes | placing.fixed_bodies(self.model, layout, changes)

    @functools.cached_property
    def _objects(self) -> np.ndarray:
        """Which bodies the task and its distractors are made of, bool [bodies]."""
        names = [*self._placed, *distractors.names(self.distractors)]
        return randomization.belonging(self.model, names)

    @functools.cached_property
    def _placed(self) -> list[str]:
        """Names of the bodies that the task places."""
        return sorted(jax.eval_shape(self.task.place, jax.random.key(0)))

    def _looks(self, draw: Draw) -> tuple[Look, jax.Array]:
        """Look of one world, and the sizes of its geoms."""
        look = randomization.look(draw, self.render_model.look)
        return look, randomization.geom_sizes(draw, self.model, self._objects)

    def _filmed(self, draw: Draw | None, data: Data) -> Data:
        return randomization.move_cameras(draw, data) if draw else data

    def _check(self, draw: Draw | None, data: Data) -> tuple[jax.Array, dict[str, jax.Array]]:
        return self.task.check(self._view(draw, data))

    def _stages(self, state: State) -> dict[str, jax.Array]:
        return self.task.stages(self._view(state.info["draw"], state.data))

    def _view(self, draw: Draw | None, data: Data) -> View:
        return View(self.model, data, draw.size if draw else 1.0)
