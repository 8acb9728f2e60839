"""What the figure of LoRA-SP shows, from a real forward pass of a run's policy."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from films import prompted

import envs
from envs.compilation import cache
from envs.rendering.renderer import RayRenderer
from lorasp_jax.models.transformer.depth import unstack
from lorasp_jax.models.transformer.siglip import patches
from lorasp_jax.peft.lora_sp import reference
from lorasp_jax.policies import Policy
from lorasp_jax.training import load_policy
from lorasp_jax.training.run_folder import read_json

WORLDS, PIXELS = 4, 320
CAMERA = "side"
ROUNDED = 2
"""Directions by which a model that computes in bfloat16 may differ from the equations in fp32."""


def measure(run: Path, task: str, steps: int) -> dict[str, Any]:
    """Scores and active ranks of the first layer's keys, after some control steps of a task.

    The scores are those that the paper's equations give for the layer's input, and their active
    rank is compared with that of the model's own forward pass.

    Args:
        run: folder of a finished run that adapted the vision tower with LoRA-SP.
        task: the policy acts in it.
        steps: control steps before the picture.

    Raises:
        ValueError: no finished run, or another method.
    """
    cache.enable()
    policy = load_policy(run)
    told = read_json(run / "adapter.json")["metadata"]
    config, tower = policy.model.config, policy.model.vision
    block = unstack(tower.blocks)[0]
    layer = block.k_proj
    if layer.adapter is None or layer.method.name != "lora_sp":
        raise ValueError(f"{run} has no LoRA-SP in its vision tower")
    env = envs.make(task, robot=told["robot"], num_envs=WORLDS, image_size=config.image_size)
    policy = prompted(policy, env)
    state = acted(policy, env, steps)
    seen = policy.processor.encode(env.observe(state), state.info["instruction"])
    _, _, aux = jax.jit(lambda model, obs: model.encode_images(obs))(policy.model, seen)
    number = config.cameras.index(CAMERA)
    ranks = aux["vision"]["k_proj"].active_rank[0].reshape(WORLDS, len(config.cameras), -1)
    x, _ = tower.patch_embed(patches(seen.images[CAMERA], config.vision.patch), return_aux=True)
    x = block.layer_norm1(x + tower.position_embedding.get_value())
    scores, _ = reference.router_scores(layer.adapter.get_value()["router"], x)
    gated, _ = reference.energy_gate(scores, layer.method.energy_target)
    mask = np.asarray(gated)
    rounded = 0 if config.dtype == "float32" else ROUNDED
    np.testing.assert_allclose(mask.sum(-1), ranks[:, number], atol=rounded)
    world = int(np.argmax(mask.sum(-1).std(-1)))
    rank, side = mask[world].sum(-1), config.image_size // config.vision.patch
    token = np.array([rank.argmin(), rank.argmax()])
    return {
        "image": filmed(env, state, world),
        "active_rank": rank.reshape(side, side),
        "token": token,
        "scores": np.asarray(scores)[world, token],
        "mask": mask[world, token],
        "energy_target": layer.method.energy_target,
    }


def acted(policy: Policy, env: envs.Env, steps: int) -> envs.State:
    """Worlds in which the policy has acted for some control steps."""

    @jax.jit
    def rollout(policy: Policy, key: jax.Array) -> envs.State:
        def look(state: envs.State, key: jax.Array) -> tuple[envs.State, None]:
            chunk = policy.sample(key, env.observe(state), state.info["instruction"])
            return jax.lax.scan(act, state, jnp.moveaxis(chunk[:, :4], 1, 0))

        def act(state: envs.State, action: jax.Array) -> tuple[envs.State, None]:
            return env.step(state, action), None

        keys = jax.random.split(key, 1 + steps // 4)
        return jax.lax.scan(look, env.reset(keys[0]), keys[1:])[0]

    return rollout(policy, jax.random.key(0))


def filmed(env: envs.Env, state: envs.State, world: int) -> np.ndarray:
    """The camera's picture in a size to look at, uint8 `[PIXELS, PIXELS, 3]`."""
    large = dataclasses.replace(env, renderer=RayRenderer(env.render_model, PIXELS, 2))
    return np.asarray(jax.jit(large.observe)(state)["image"][CAMERA][world])
