"""The processor of a run: what its demonstrations say of the robot, and of each dataset."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.datasets.episodes import Episodes, full_name
from lorasp_jax.data.batches import flatten, windows
from lorasp_jax.data.joined import Part
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.inputs import InputConfig
from lorasp_jax.policies.processor import (
    Datasets,
    Processor,
    known_actions,
    known_state,
    robot_slots,
)
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.statistics import Statistics


def processor(
    episodes: Sequence[Episodes],
    model_config: BackboneConfig,
    prompts: PromptTable,
    *,
    cameras: Sequence[str] = (),
) -> Processor:
    """Build the processor from the prompts and the statistics of the demonstrations.

    `cameras`, by default all sorted by name, fill the backbone's camera slots in order. Statistics
    are those of the values that the model's config has: ALOHA's converted, and relative actions.
    """
    joints, length = episodes[0].state.shape[-1] - 1, episodes[0].action.shape[-1]
    inputs = model_config.inputs
    slots: dict[str, Any] = {"slots": robot_slots(joints, inputs), "dim": model_config.action_dim}
    slots["action_slots"] = robot_slots(length - 1, inputs)
    images = episodes[0].image
    ordered = [full_name(name, images) for name in cameras] or sorted(images)
    return Processor.of(
        model_config,
        _measure(episodes, inputs, model_config.chunk, **slots),
        prompts,
        num_joints=joints,
        action_length=length,
        cameras=dict(zip(model_config.cameras, ordered, strict=False)),
    )


def of_datasets(
    inputs: Processor,
    model_config: BackboneConfig,
    parts: Sequence[Part],
    groups: Sequence[Sequence[Episodes]] = (),
) -> Processor:
    """Return a processor that knows the cameras of each dataset, and its own statistics.

    Args:
        inputs: the processor of all datasets.
        model_config: config of the backbone.
        parts: the datasets.
        groups: the episodes of each, for its own statistics; the robot then has those of the first.
            Empty: the statistics are shared.
    """
    slots: dict[str, Any] = {"slots": inputs.state_slots, "action_slots": inputs.action_slots}
    slots["dim"] = model_config.action_dim
    chunk = model_config.chunk
    each = [
        _measure(group, model_config.inputs, chunk, **slots) if group else inputs.statistics
        for group in groups
    ]
    each = each or [inputs.statistics] * len(parts)
    present = {
        name: jnp.array([name in part.cameras for part in parts])
        for _, name in inputs.cameras
        if name
    }
    names = tuple(part.name for part in parts)
    stacked = jax.tree.map(lambda *arrays: jnp.stack(arrays), *each)
    datasets = Datasets(stacked, {name: x for name, x in present.items() if not x.all()}, names)
    return dataclasses.replace(inputs, statistics=each[0], datasets=datasets)


def _measure(
    episodes: Sequence[Episodes], inputs: InputConfig, chunk: int, **slots: Any
) -> Statistics:
    """Return the statistics of all steps, of values as the weights know them."""
    steps = flatten([dataclasses.replace(group, image={}) for group in episodes])
    chunk = chunk if inputs.delta else 1
    window, _ = windows(steps, jnp.arange(len(steps.end)), chunk)
    state = jnp.asarray(steps.state)
    action = np.asarray(known_actions(jnp.asarray(steps.action[window]), state, inputs))
    action = action.reshape(-1, action.shape[-1])
    state = np.repeat(np.asarray(known_state(state, inputs)), chunk, axis=0)
    return Statistics.measure(state, action, np.ones(len(state), bool), **slots)
