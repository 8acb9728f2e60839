"""Measure the data of the LoRA-SP figure in a forward pass of a run's policy."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from films import with_prompts

import envs
from envs.rendering.renderer import RayRenderer
from lorasp_jax.base import compilation_cache as cache
from lorasp_jax.models.transformer.depth import unstack
from lorasp_jax.models.transformer.siglip import patches
from lorasp_jax.peft.lora_sp import reference
from lorasp_jax.policies import Policy
from lorasp_jax.training import load_policy
from lorasp_jax.training.export import denoise_steps
from lorasp_jax.training.run_folder import read_json

WORLDS, PIXELS = 4, 320
CAMERA = "side"
RANK_TOLERANCE = 2
"""Allowed active-rank difference between a bfloat16 model and the equations in fp32."""


def measure(run: Path, task: str, steps: int) -> dict[str, Any]:
    """Measure scores and active ranks of the first vision layer's key projection.

    The scores come from the paper's equations, applied to the layer's input. Their active rank is
    checked against the model's own forward pass.

    Args:
        run: folder of a finished run that adapted the vision tower with LoRA-SP.
        task: task in which the policy acts.
        steps: control steps before the measurement.

    Raises:
        ValueError: the run is not finished, or used another method.
    """
    cache.enable()
    policy = load_policy(run)
    metadata = read_json(run / "adapter.json")["metadata"]
    config, tower = policy.model.config, policy.model.vision
    block = unstack(tower.blocks)[0]
    layer = block.k_proj
    if layer.adapter is None or layer.method.name != "lora_sp":
        raise ValueError(f"{run} has no LoRA-SP adapter in its vision tower")
    env = envs.make(task, robot=metadata["robot"], num_envs=WORLDS, image_size=config.image_size)
    policy = with_prompts(policy, env)
    state = run_policy(policy, env, steps, denoise_steps(run))
    inputs = policy.processor.encode(env.observe(state), state.info["instruction"])
    _, _, aux = jax.jit(lambda model, inputs: model.encode_images(inputs))(policy.model, inputs)
    camera = config.cameras.index(CAMERA)
    ranks = aux["vision"]["k_proj"].active_rank[0].reshape(WORLDS, len(config.cameras), -1)
    x, _ = tower.patch_embed(patches(inputs.images[CAMERA], config.vision.patch), return_aux=True)
    x = block.layer_norm1(x + tower.position_embedding.get_value())
    scores, _ = reference.router_scores(layer.adapter.get_value()["router"], x)
    gate, _ = reference.energy_gate(scores, layer.method.energy_target)
    mask = np.asarray(gate)
    tolerance = 0 if config.dtype == "float32" else RANK_TOLERANCE
    np.testing.assert_allclose(mask.sum(-1), ranks[:, camera], atol=tolerance)
    world = int(np.argmax(mask.sum(-1).std(-1)))
    rank, side = mask[world].sum(-1), config.image_size // config.vision.patch
    token = np.array([rank.argmin(), rank.argmax()])
    return {
        "image": camera_image(env, state, world),
        "active_rank": rank.reshape(side, side),
        "token": token,
        "scores": np.asarray(scores)[world, token],
        "mask": mask[world, token],
        "energy_target": layer.method.energy_target,
    }


def run_policy(policy: Policy, env: envs.Env, steps: int, flow_steps: int) -> envs.State:
    """Run the policy for some control steps; return the final state."""

    @jax.jit
    def rollout(policy: Policy, key: jax.Array) -> envs.State:
        def observe_and_act(state: envs.State, key: jax.Array) -> tuple[envs.State, None]:
            observed = env.observe(state), state.info["instruction"]
            chunk = policy.sample(key, *observed, num_steps=flow_steps)
            return jax.lax.scan(act, state, jnp.moveaxis(chunk[:, :4], 1, 0))

        def act(state: envs.State, action: jax.Array) -> tuple[envs.State, None]:
            return env.step(state, action), None

        keys = jax.random.split(key, 1 + steps // 4)
        return jax.lax.scan(observe_and_act, env.reset(keys[0]), keys[1:])[0]

    return rollout(policy, jax.random.key(0))


def camera_image(env: envs.Env, state: envs.State, world: int) -> np.ndarray:
    """Render the camera image of one world at display size, uint8 `[PIXELS, PIXELS, 3]`."""
    large = dataclasses.replace(env, renderer=RayRenderer(env.render_model, PIXELS, 2))
    return np.asarray(jax.jit(large.observe)(state)["image"][CAMERA][world])
