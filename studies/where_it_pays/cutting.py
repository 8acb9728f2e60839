"""LoRA cut after training by one threshold, as it is and trained on: the rival of plans."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.adapters import paths
from lorasp_jax.dense import AdaptedLayer, AdapterParam
from lorasp_jax.extras.deployment import healing
from lorasp_jax.extras.study.held_out import shared_demonstrations
from lorasp_jax.peft import LoRA
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training.run import Run
from studies.few.judge import judge as judge_scenes
from studies.paper.transforms import cut
from studies.where_it_pays.judge import padded


def judge(run: Run, rank: int, steps: int, pool: int) -> dict[str, Any]:
    """Return the outcomes as recorded of the run's policy, cut and trained on, and its parameters.

    It has no more parameters than LoRA of a rank in all layers.
    """
    policy, count = as_lora(cut(run.policy, rank, by_size=True))
    if steps:
        episodes = shared_demonstrations(run.folder.parents[3], pool, run.config)
        policy = healing.train_on(policy, dataclasses.replace(run, episodes=episodes), steps)
    shown = run.with_policy(padded(policy, run.config.targets))
    return judge_scenes(shown, ("recorded",)) | {"trainable_parameters": count}


def as_lora(policy: Policy) -> tuple[Policy, int]:
    """Return a policy that `cut` made with LoRA in place of triplets, and its parameters.

    A and B share the singular values. A direction that was cut has neither, hence no gradient: it
    stays zero in training. The arrays of a stack are as large as its largest rank.
    """
    root, count = nnx.List([nnx.clone(policy.model)]), 0
    for location in paths.locate(root, AdaptedLayer):
        layer = location.child
        if layer.adapter is None:
            continue
        method, params = layer.method_and_params()
        a, values, b = (np.asarray(params[f"lora_{name}"]) for name in "aeb")
        lora = LoRA(rank=values.shape[-1])
        half = np.sqrt(values * method.scale / lora.scale)
        arrays = {"lora_a": a * half[..., None, :], "lora_b": half[..., None] * b}
        layer.method = lora
        layer.adapter = AdapterParam({name: jnp.asarray(x) for name, x in arrays.items()})
        count += int(np.count_nonzero(values)) * (a.shape[-2] + b.shape[-1])
    return dataclasses.replace(policy, model=root[0]), count
