"""Repeat an episode of a run's final evaluation and record active ranks at every control step."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.env import Env
from envs.scene.randomization import Draw
from envs.state import Poses, State
from lorasp_jax.base import fast_cpu, messages
from lorasp_jax.evaluation import metrics
from lorasp_jax.evaluation.rollout import RECORDED_WORLDS
from lorasp_jax.peft import Aux
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import RawObservation
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run_folder import recorded_ranges


@dataclass(frozen=True)
class RankEpisode:
    """An episode of T control steps in one world.

    The policy runs at every step, so that ranks belong to the images shown; as in evaluation, the
    robot executes `execute_steps` actions of a chunk and ignores the chunks in between.

    Attributes:
        instruction: what the policy was told.
        success: whether the episode succeeded.
        poses: poses before each step, leading axis T.
        patches: robot camera -> `[T, P, P]`, see `patch_ranks`.
        towers: tower -> `[T]` active rank, averaged over layers and tokens.
        draw: randomized values of the world; None if the run was not randomized.
    """

    instruction: str
    success: bool
    poses: Poses
    patches: dict[str, np.ndarray]
    towers: dict[str, np.ndarray]
    draw: Draw | None = None


class RankRecorder:
    """Records episodes of a run's policy; all tasks share one compilation of the policy."""

    def __init__(self, policy: Policy, config: Mapping[str, Any]) -> None:
        """Prepare the policy.

        Args:
            policy: the run's policy.
            config: the run's config, as JSON values.
        """
        self._policy, self._settings = policy.with_sampler(), config["evaluation"]
        self._seed, self._ranges = config["seed"], recorded_ranges(config)
        self._worlds = min(self._settings["episodes"], self._settings["num_envs"])
        run_policy = functools.partial(_run_policy, self._settings["denoise_steps"])
        options = fast_cpu.without_simulation()
        self._run_policy = jax.jit(run_policy, compiler_options=options)

    def record(self, env: Env) -> RankEpisode:
        """Record the first successful episode of the final evaluation, or else its first episode.

        Tries only the episodes from which the run's own video was chosen.

        Args:
            env: the task's environment with one world.

        Raises:
            ValueError: the policy has no prompt for one of the task's instructions.
        """
        key = RandomStream.FINAL_EVALUATION.key(self._seed, env.task.name)
        key = jax.random.split(key, self._settings["episodes"] // self._worlds)[0]
        episodes = (self.play(env, key, i) for i in range(min(self._worlds, RECORDED_WORLDS)))
        first = next(episodes)
        return next((e for e in itertools.chain([first], episodes) if e.success), first)

    def play(self, env: Env, key: jax.Array, world: int) -> RankEpisode:
        """Repeat the episode that `evaluation.make_rollout` runs in one world with this key."""
        reset_key, sample_key = jax.random.split(key)
        worlds = dataclasses.replace(env, num_envs=self._worlds).reset(reset_key, self._ranges)
        state: State = jax.tree.map(lambda x: x[world : world + 1], worlds)
        instruction = int(state.info["instruction"][0])
        rows = self._policy.processor.prompts.rows(env.instructions)
        row = jnp.array(rows[[instruction]])
        horizon, chunk = self._settings["execute_steps"], jnp.empty(0)
        steps, observation = [], env.observe(state)
        with messages.announce("the policy"):
            self._call(sample_key, world, observation, row)
        while not state.done[0]:
            call, index = divmod(len(steps), horizon)
            call_key = jax.random.fold_in(sample_key, call)
            actions, patches, towers = self._call(call_key, world, env.observe(state), row)
            steps.append(jax.tree.map(np.asarray, (Poses.of(state.data), patches, towers)))
            chunk = chunk if index else actions
            state = env.step(state, chunk[:, index])
        poses, patches, towers = jax.tree.map(lambda *x: np.stack(x), *steps)
        poses = jax.tree.map(lambda x: x[:, 0], poses)
        text = env.instructions[instruction]
        draw = jax.tree.map(lambda x: x[0], state.info["draw"])
        return RankEpisode(text, bool(state.info["success"][0]), poses, patches, towers, draw)

    def _call(
        self, key: jax.Array, world: int, observation: RawObservation, row: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array], dict[str, jax.Array]]:
        """Run the policy with the noise that this world has among all worlds."""
        config = self._policy.model.config
        noise = jax.random.normal(key, (self._worlds, config.chunk, config.action_dim))
        return self._run_policy(self._policy, observation, row, noise[world : world + 1])


def _run_policy(
    denoise_steps: int,
    policy: Policy,
    observation: RawObservation,
    instruction: jax.Array,
    noise: jax.Array,
) -> tuple[jax.Array, dict[str, jax.Array], dict[str, jax.Array]]:
    """Return actions `[1, C, J+1]`, the ranks of the patches, and the mean rank of each tower."""
    inputs = policy.processor.encode(observation, instruction)
    chunk, aux = policy.model.sample_actions(
        jax.random.key(0),  # unused
        inputs,
        num_steps=denoise_steps,
        noise=noise,
        slots=policy.processor.flow_slots,
        return_aux=True,
    )
    layers = metrics.layer_ranks(aux, jnp.ones(1, bool))
    towers = {
        tower: jnp.concatenate([*linears.values()]).mean()
        for tower, linears in layers.items()
        if linears
    }
    actions = policy.processor.decode(chunk, observation["state"])
    return actions, patch_ranks(aux["vision"], policy), towers


def patch_ranks(vision: Mapping[str, Aux], policy: Policy) -> dict[str, jax.Array]:
    """Return the active rank of each image patch, averaged over the vision tower's linear layers.

    Tokens are in row-major order, camera after camera in the backbone's order. Simulated images are
    square, hence scaled to the backbone's size without padding. After the pixel shuffle, one token
    stands for a square of patches, which all get its rank.

    Args:
        vision: aux of the vision tower for one observation.
        policy: the policy.

    Returns:
        robot camera -> `[P, P]`, with P patches per side.
    """
    config = policy.model.config
    side, maps = config.image_size // config.vision.patch, []
    for linear in vision.values():
        if linear.active_rank is not None:
            tokens = math.isqrt(linear.active_rank.shape[-1])
            grid = linear.active_rank.reshape(-1, len(config.cameras), tokens, tokens)
            maps.append(grid.repeat(side // tokens, axis=2).repeat(side // tokens, axis=3))
    mean = jnp.concatenate(maps).mean(0)
    sources = dict(policy.processor.cameras) or {name: name for name in config.cameras}
    found = {sources[slot]: mean[i] for i, slot in enumerate(config.cameras)}
    return {camera: ranks for camera, ranks in found.items() if camera}
