"""This project's tasks as a benchmark of vla-eval, to judge policies of other projects in them.

    benchmarks:
      - benchmark: lorasp_jax.extras.judge.vla_eval:SimulatedTasks
        episodes_per_task: 50
        params: {tasks: [press, pour], robot: piper, image_size: 224, seed: 0}

Written to a file, this is judged by `vla-eval run --config FILE --server-url ws://HOST:PORT
--no-docker`, or by `vla_eval.evaluate` in Python. Written for vla-eval 0.8.0.
"""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.specs import IMAGE_RGB, LANGUAGE, STATE_JOINT, DimSpec

import envs
from envs.env import Env
from envs.names import names
from envs.state import State


class SimulatedTasks(StepBenchmark):
    """Tasks of this project's simulation, by default on the PiPER.

    An observation has `images`, a map from the cameras side and wrist to uint8 `[S, S, 3]`;
    `states`, f32 `[J+1]`, joint angles [rad] and the gripper's opening [m]; and `task_description`,
    one of the task's phrasings. An action is f32 `[J+1]`, joint targets [rad] and the opening [m].
    Seed and number of an episode determine its layout, start pose and phrasing.
    """

    render_backends: ClassVar[frozenset[str]] = frozenset({"gpu", "cpu"})

    @classmethod
    def configure_render(cls, mode: str) -> dict[str, str]:
        """Simulate and render on the CPU, if asked to; "gpu" leaves the choice to JAX."""
        if mode == "gpu":
            return {}
        jax.config.update("jax_platforms", "cpu")
        return {"JAX_PLATFORMS": "cpu"}

    def __init__(
        self,
        tasks: list[str] | None = None,
        robot: str = "piper",
        image_size: int = 64,
        control_dt: float = 0.1,
        seed: int = 0,
        send_wrist_image: bool = True,
        send_state: bool = True,
    ) -> None:
        """Make the environments, which compile when first used.

        Args:
            tasks: names; None or empty: all.
            robot, image_size, control_dt: see `envs.make`.
            seed: seed of the episodes.
            send_wrist_image, send_state: whether observations have the second camera and `states`.

        Raises:
            ValueError: see `envs.make`.
        """
        super().__init__()
        settings: dict[str, Any] = {"image_size": image_size, "control_dt": control_dt}
        self._envs = {name: envs.make(name, robot, **settings) for name in tasks or names("task")}
        self._env: Env = next(iter(self._envs.values()))
        self._seed, self._send_state = seed, send_state
        self._cameras = self._env.cameras if send_wrist_image else self._env.cameras[:1]

    def get_tasks(self) -> list[dict[str, Any]]:
        """Return the tasks' names."""
        return [{"name": name} for name in self._envs]

    def reset(self, task: dict[str, Any]) -> State:
        """Start an episode, that of number `episode_idx`, which vla-eval counts for each task."""
        self._env = self._envs[task["name"]]
        key = jax.random.fold_in(jax.random.key(self._seed), task["episode_idx"])
        return self._env.reset(key)

    def step(self, action: dict[str, Any]) -> StepResult:
        """Simulate one control step.

        Raises:
            ValueError: there are no actions, or their shape is not `[J+1]`.
        """
        if "actions" not in action:
            raise ValueError(f"the server must send actions, got {', '.join(action) or 'nothing'}")
        target = jnp.asarray(action["actions"], jnp.float32)
        state = self._env.step(self._last_result.obs, target[None])
        info = {"success": bool(state.info["success"][0])}
        return StepResult(state, float(state.reward[0]), bool(state.done[0]), info)

    def make_obs(self, raw_obs: State, task: dict[str, Any]) -> dict[str, Any]:  # noqa: ARG002
        """Render and measure what a policy observes."""
        seen = jax.device_get(self._env.observe(raw_obs))
        self._recorder.record_video(seen["image"][self._cameras[0]][0])
        phrasing = self._env.instructions[int(raw_obs.info["instruction"][0])]
        return {
            "images": {name: seen["image"][name][0] for name in self._cameras},
            "task_description": phrasing,
            **({"states": seen["state"][0]} if self._send_state else {}),
        }

    def get_step_result(self, step_result: StepResult) -> dict[str, Any]:
        """Return whether the episode succeeded."""
        return step_result.info

    def get_metadata(self) -> dict[str, Any]:
        """Return the longest task's limit; each episode ends at that of its own task."""
        return {"max_steps": max(env.max_steps for env in self._envs.values())}

    def get_action_spec(self) -> dict[str, DimSpec]:
        """Describe actions; "raw" is what servers declare that leave the meaning open."""
        accepts, size = frozenset({"joint_targets", "raw"}), self._env.num_joints + 1
        return {"actions": DimSpec("actions", size, "joint_targets", accepts=accepts)}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        """Describe observations."""
        state = dataclasses.replace(STATE_JOINT, dims=self._env.num_joints + 1)
        spec = {"language": LANGUAGE, **dict.fromkeys(("image", *self._cameras), IMAGE_RGB)}
        return {**spec, "state": state} if self._send_state else spec
