"""The processor of a run: what its demonstrations say of the robot, and of each dataset."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.datasets.episodes import Episodes
from lorasp_jax.data.batches import flatten, windows
from lorasp_jax.data.joined import Part
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.policies.processor import Datasets, Processor, robot_slots, to_delta
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.statistics import Statistics


def processor(
    episodes: Sequence[Episodes],
    model_config: BackboneConfig,
    prompts: PromptTable,
    *,
    relative: bool = False,
    cameras: Sequence[str] = (),
) -> Processor:
    """Build the processor from the prompts and the statistics of the demonstrations.

    `cameras`, by default all sorted by name, fill the backbone's camera slots in order. With
    `relative`, joint targets are relative to the state at the start of the chunk; otherwise the
    model's config decides.
    """
    joints, length = episodes[0].state.shape[-1] - 1, episodes[0].action.shape[-1]
    slots, dim = robot_slots(joints, model_config.inputs), model_config.action_dim
    action_slots = robot_slots(length - 1, model_config.inputs)
    delta = (*[True] * (length - 1), False) if relative else model_config.inputs.delta
    slots = {"slots": slots, "dim": dim, "action_slots": action_slots}
    statistics = _measure(episodes, delta, model_config.chunk, **slots)
    ordered = cameras or sorted(episodes[0].image)
    return Processor.of(
        model_config,
        statistics,
        prompts,
        num_joints=joints,
        action_length=length,
        cameras=dict(zip(model_config.cameras, ordered, strict=False)),
        delta=delta,
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
    delta, chunk = inputs.inputs.delta, model_config.chunk
    each = [_measure(group, delta, chunk, **slots) for group in groups]
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
    episodes: Sequence[Episodes], delta: Sequence[bool], chunk: int, **slots: Any
) -> Statistics:
    """Return the statistics of all steps, of actions relative to the state where `delta` is."""
    steps = flatten([dataclasses.replace(group, image={}) for group in episodes])
    chunk = chunk if delta else 1
    window, _ = windows(steps, jnp.arange(len(steps.end)), chunk)
    action = to_delta(jnp.asarray(steps.action[window]), jnp.asarray(steps.state), delta)
    action = np.asarray(action).reshape(-1, action.shape[-1])
    state = np.repeat(np.asarray(steps.state), chunk, axis=0)
    return Statistics.measure(state, action, np.ones(len(state), bool), **slots)
