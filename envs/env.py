"""Batched manipulation environments as pure functions over W worlds.

    env = envs.make("press", robot="piper", num_envs=64, image_size=64)
    state = env.reset(jax.random.key(0))
    state = env.step(state, action)
    images = env.observe(state)["image"]

`step` neither renders nor restarts worlds: see `observe` and `reset_done`.
"""

import dataclasses
import enum
import functools
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs import actions, checks, observations, rewards
from envs.physics.physics import Physics
from envs.rendering.renderer import Appearance, Renderer, RenderModel
from envs.robots import Robot
from envs.scene import distractors, placing, randomization, scene
from envs.scene.randomization import Draw
from envs.scene.ranges import Randomization
from envs.state import Changes, Data, Poses, State, Trajectory, where
from envs.tasks import Layout, Task, View
from lorasp_jax.base import fast_cpu, messages

_HOME_NOISE = 0.03  # rad, half the range of random start angles around home; our choice
_START_OPENING = 0.04  # m, gripper opening at reset; our choice


@enum.unique
class _LayoutStream(enum.IntEnum):
    """Numbers that `jax.random.fold_in` combines with the key of a layout."""

    DISTRACTORS = 1
    RANDOMIZATION = 2


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Env:
    """One task and one robot in W = `num_envs` worlds, made by `envs.make`. Methods are pure."""

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

    physics_dt: ClassVar[float] = scene.PHYSICS_DT
    cameras: ClassVar[tuple[str, ...]] = scene.CAMERAS

    def __repr__(self) -> str:
        return f"<Env {self.task.name!r} for {self.robot.name!r}, num_envs={self.num_envs}>"

    @property
    def render_model(self) -> RenderModel:
        """The renderer's model: visible geoms, cameras, appearance."""
        return self.renderer.model

    @property
    def num_joints(self) -> int:
        """Number of joints J, without the gripper."""
        return self.robot.num_joints

    @property
    def image_size(self) -> int:
        """Height and width of the images in pixels."""
        return self.renderer.image_size

    @property
    def antialias(self) -> int:
        """Square root of the number of rays per pixel."""
        return self.renderer.samples

    @property
    def action_low(self) -> np.ndarray:
        """Lowest action `[A]`, float32; units as in `envs.actions`."""
        return actions.bounds(self.actions, self.robot, self.control_dt)[0]

    @property
    def action_high(self) -> np.ndarray:
        """Highest action `[A]`, float32."""
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
        """Control steps after which the expert stops."""
        return round(self.task.expert_time / self.control_dt)

    def reset(self, key: jax.Array, ranges: Randomization | None = None) -> State:
        """Start W worlds, each with a random layout, instruction and start pose near home.

        Args:
            key: random key.
            ranges: ranges of domain randomization; None disables it.

        Raises:
            ValueError: a range is invalid.
        """
        ranges = randomization.prepare(ranges, self.control_dt)
        with self._calls.first("reset", ranges is None):
            return self._batched_reset(key, ranges)

    def step(self, state: State, action: jax.Array) -> State:
        """Simulate one control step.

        Args:
            state: W worlds.
            action: `[W, A]`, by default J joint targets [rad] and the gripper opening [m]; see
                `envs.actions` for other modes. Actions are clipped to `action_low`, `action_high`
                and the robot's speed limits.

        Returns:
            The worlds `control_dt` later. Worlds that were done are unchanged.

        Raises:
            ValueError: the action's shape is wrong.
        """
        action = checks.action(action, (self.num_envs, len(self.action_low)))
        # A weakly typed action, such as jnp.full(shape, 0.0), would make JAX recompile the step.
        action = jax.lax.convert_element_type(action, jnp.float32)
        with self._calls.first("step", state.info["draw"] is None):
            return self._batched_step(state, action)

    def observe(self, state: State) -> dict[str, Any]:
        """Render and measure what a policy observes.

        Returns:
            `image`: camera name -> uint8 `[W, image_size, image_size, 3]`.
            `state`: f32 `[W, J + 1]` measured joint angles [rad] and gripper opening [m].
        """
        with self._calls.first("images", state.info["draw"] is None):
            return self._batched_observe(state)

    @functools.partial(fast_cpu.jit, static_argnums=0)
    def _batched_observe(self, state: State) -> dict[str, Any]:
        return {
            "image": self.render(Poses.of(state.data), draw=state.info["draw"]),
            "state": self.proprio(state),
        }

    def rollout(
        self,
        policy: Callable[[dict[str, Any], jax.Array], jax.Array],
        key: jax.Array,
        ranges: Randomization | None = None,
    ) -> tuple[State, Trajectory]:
        """Run a policy in fresh worlds until the time limit; return the last state and all steps.

        Args:
            policy: (observation, key) -> action [W, A]. The observation is that of `observe`, plus
                `instruction`, int32 `[W]`. Images that the policy does not read are not rendered.
            key: random key.
            ranges: as in `reset`.

        Raises:
            ValueError: as in `reset` and `step`.
        """
        reset_key, policy_key = jax.random.split(key)

        def body(state: State, key: jax.Array) -> tuple[State, Trajectory]:
            observation = self.observe(state) | {"instruction": state.info["instruction"]}
            action = policy(observation, key)
            after = self.step(state, action)
            return after, Trajectory(observation["state"], action, after.reward, after.done)

        keys = jax.random.split(policy_key, self.max_steps)
        start = self.reset(reset_key, ranges)
        with self._calls.announce("rollout"):  # every time: JAX retraces for each policy
            return jax.lax.scan(body, start, keys)

    def reset_done(
        self, state: State, key: jax.Array, ranges: Randomization | None = None
    ) -> State:
        """Restart the worlds that are done; pass the same ranges as to `reset`.

        Raises:
            ValueError: as in `reset`, or only one of `reset` and `reset_done` got ranges.
        """
        if (ranges is None) != (state.info["draw"] is None):
            raise ValueError("pass ranges to reset_done if and only if reset had ranges")
        return jax.jit(where)(state.done, self.reset(key, ranges), state)

    def proprio(self, state: State) -> jax.Array:
        """Measure joint angles [rad] and gripper opening [m], f32 `[W, J + 1]`."""
        joints = state.data.qpos[:, : self.num_joints]
        fingers = state.data.qpos[:, self.num_joints : self.num_joints + 2]
        return jnp.concatenate([joints, jnp.sum(fingers, axis=1, keepdims=True)], axis=1)

    @functools.partial(jax.jit, static_argnums=0)
    def full_state(self, state: State) -> jax.Array:
        """Return the privileged state of robot and objects, f32 [W, D]; see `full_state_layout`."""
        return jax.vmap(self._full_state)(state)

    def _full_state(self, state: State) -> jax.Array:
        parts = observations.parts(self.model, state.data, state.info["command"], self._task_bodies)
        return jnp.concatenate([*parts.values()])

    @functools.cached_property
    def full_state_layout(self) -> dict[str, slice]:
        """Name of each part -> its slice of the last axis of `full_state`."""
        return observations.layout(self.model, self.num_joints, self._task_bodies)

    def render(self, poses: Poses, *, draw: Draw | None = None) -> dict[str, jax.Array]:
        """Render N recorded scenes: camera name -> uint8 `[N, image_size, image_size, 3]`.

        Args:
            poses: poses of all geoms and cameras, leading axis N.
            draw: randomized values of these scenes from `State.info`, leading axis N; None if they
                are not randomized.
        """
        appearance, size = jax.vmap(self._appearance)(draw) if draw else (None, None)
        images = self.renderer(poses, appearance, size)
        return {name: images[:, i] for i, name in enumerate(self.cameras)}

    @functools.cached_property
    def _calls(self) -> messages.Calls:
        worlds = "one world" if self.num_envs == 1 else f"{self.num_envs} worlds"
        return messages.Calls(f"{self.task.name}, {worlds}")

    @functools.partial(fast_cpu.jit, static_argnums=0)
    def _batched_step(self, state: State, action: jax.Array) -> State:
        return jax.vmap(self._step)(state, action)

    @functools.partial(fast_cpu.jit, static_argnums=0)
    def _batched_reset(self, key: jax.Array, ranges: Randomization | None) -> State:
        keys = jax.random.split(key, self.num_envs)
        return jax.vmap(functools.partial(self._reset, ranges))(keys)

    def _reset(self, ranges: Randomization | None, key: jax.Array) -> State:
        layout_key, pose_key, instruction_key = jax.random.split(key, 3)
        layout = self.task.place(layout_key)
        distractor_key = jax.random.fold_in(layout_key, _LayoutStream.DISTRACTORS)
        layout |= distractors.place(distractor_key, layout, self.distractors)
        draw = None
        if ranges:
            draw_key = jax.random.fold_in(layout_key, _LayoutStream.RANDOMIZATION)
            draw, layout = randomization.draw(draw_key, ranges, self.model, layout)
        noise = jax.random.uniform(pose_key, (self.num_joints,), minval=-1.0, maxval=1.0)
        joints = jnp.asarray(self.robot.home, jnp.float32) + _HOME_NOISE * noise
        low, high = self.robot.action_low, self.robot.action_high
        command = jnp.clip(jnp.append(joints, _START_OPENING), low, high)
        data = self._start(draw, layout, command)
        _, metrics = self.task.check(self._view(draw, data))
        instruction = jax.random.randint(instruction_key, (), 0, len(self.instructions), jnp.int32)
        zero, false = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
        info = {
            "success": false,
            "steps": zero,
            "instruction": instruction,
            "command": command,
            "earlier": command,
            "held": zero,
            "broken": false,
            "layout": layout,
            "draw": draw,
        }
        state = State(data, jnp.zeros((), jnp.float32), false, metrics, info)
        return state if self.reward == "sparse" else rewards.at_reset(state, self._stages(state))

    def _step(self, state: State, action: jax.Array) -> State:
        after = self._move(state, action)
        if self.reward == "sparse":
            return after
        return rewards.after_step(state, after, self._stages(after), self.discount)

    def _move(self, state: State, action: jax.Array) -> State:
        info = state.info
        max_change = jnp.asarray(self.robot.action_speed) * self.control_dt
        action = jnp.clip(action, self.action_low, self.action_high)
        target = actions.to_targets(self.actions, self.robot, info["command"], action)
        target = jnp.clip(target, self.robot.action_low, self.robot.action_high)
        target = jnp.clip(target, info["command"] - max_change, info["command"] + max_change)
        draw = info["draw"]
        commands = jnp.stack([info["earlier"], info["command"], target])
        latency = draw.latency if draw else 0.0
        controls = actions.interpolate(commands, self.control_dt, latency)
        changes = self._changes(draw, info["layout"])
        data = self._with_cameras(draw, self.physics.advance(changes, state.data, controls))
        reached, metrics = self.task.check(self._view(draw, data))
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
        """Start one world at rest, with the robot at `command` `[J + 1]`."""
        joints = jnp.concatenate([command[:-1], jnp.full(2, command[-1] / 2)])
        qpos = placing.positions(self.model, layout, joints)
        return self._with_cameras(draw, self.physics.start(self._changes(draw, layout), qpos))

    def _changes(self, draw: Draw | None, layout: Layout) -> Changes:
        changes = randomization.changes(draw, self.model, self._objects) if draw else {}
        return changes | placing.fixed_bodies(self.model, layout, changes)

    @functools.cached_property
    def _objects(self) -> np.ndarray:
        """Whether each body belongs to an object or distractor, bool [bodies]."""
        names = [*self._task_bodies, *distractors.names(self.distractors)]
        return randomization.in_subtrees(self.model, names)

    @functools.cached_property
    def _task_bodies(self) -> list[str]:
        """Names of the bodies that the task places."""
        return sorted(jax.eval_shape(self.task.place, jax.random.key(0)))

    def _appearance(self, draw: Draw) -> tuple[Appearance, jax.Array]:
        """Return appearance and geom sizes `[G, 3]` of one world."""
        appearance = randomization.appearance(draw, self.render_model.appearance)
        return appearance, randomization.geom_sizes(draw, self.model, self._objects)

    def _with_cameras(self, draw: Draw | None, data: Data) -> Data:
        return randomization.move_cameras(draw, data) if draw else data

    def _stages(self, state: State) -> dict[str, jax.Array]:
        return self.task.stages(self._view(state.info["draw"], state.data))

    def _view(self, draw: Draw | None, data: Data) -> View:
        return View(self.model, data, draw.size if draw else 1.0)
