"""Success of a policy, and the active ranks of its layers at the end of training."""

import dataclasses
import re
from collections.abc import Iterable, Sequence
from typing import Any

import jax.numpy as jnp
from flax import nnx

from lorasp_jax.adapters import paths
from lorasp_jax.dense import AdaptedLayer, AdapterParam
from lorasp_jax.evaluation.callback import training_ranks
from lorasp_jax.models import presets
from lorasp_jax.peft import LoRA, LoRASP
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training.run import Run
from studies.few.judge import judge as judge_scenes
from studies.few.page import SCENES
from studies.where_it_pays import names


def judge(run: Run, scenes: Iterable[str] = SCENES) -> dict[str, Any]:
    """Return what `few.judge` does, and the active ranks by tower and layer.

    Raises:
        ValueError: the ranks are lost, since another process has trained the policy.
    """
    ranks, trained = training_ranks(run), {"trainable_parameters": run.parameters[0]}
    if isinstance(run.config.peft, LoRASP) and not ranks:
        raise ValueError("its active ranks are lost with the process that trained it: delete it")
    shown = run.with_policy(padded(run.policy, run.config.targets))
    return judge_scenes(shown, scenes) | trained | {"layer_active_rank": ranks}


def padded(policy: Policy, targets: Sequence[str]) -> Policy:
    """Return an equal policy whose LoRA has rank `WIDE` in all target layers, filled up with zeros.

    Policies of all lower ranks and plans then share the programs of evaluation. Those with other
    adapters come back as they are.
    """
    root, wide = nnx.List([nnx.clone(policy.model)]), LoRA(rank=names.WIDE)
    patterns = presets.patterns(targets)
    found = [
        location.child
        for location in paths.locate(root, AdaptedLayer)
        if any(re.search(pattern, location.path) for pattern in patterns)
    ]
    for method in (layer.method for layer in found if layer.method):
        if type(method) is not LoRA or method.scale != wide.scale or method.rank > wide.rank:
            return policy
    for layer in found:
        *stack, d_in, d_out = layer.kernel_matrices().shape
        a, b = jnp.zeros((*stack, d_in, wide.rank)), jnp.zeros((*stack, wide.rank, d_out))
        if layer.adapter is not None:
            params, rank = layer.adapter.get_value(), layer.method.rank
            a, b = a.at[..., :rank].set(params["lora_a"]), b.at[..., :rank, :].set(params["lora_b"])
        layer.method, layer.adapter = wide, AdapterParam({"lora_a": a, "lora_b": b})
    return dataclasses.replace(policy, model=root[0])
