"""Windows of demonstrations as training batches, sampled on the device.

All episodes that fit in memory lie there as flat per-step arrays; a batch is a gather. What a step
trains on is a function of the run's key and the step number alone, so the data position of a run is
one integer.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from envs.episodes import Array, Episodes
from lorasp_jax.models.policy import Observation
from lorasp_jax.models.processing import Processor


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Batch:
    """What one training step sees.

    Attributes:
        observation: normalised model input, leading axis B.
        actions: `[B, C, A]` normalised action chunks in the policy's slots.
        action_mask: `[B, C, A]` bool, True inside the episode and in the slots that flow.
    """

    observation: Observation
    actions: jax.Array
    action_mask: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Steps:
    """Every step of every episode, one after the other.

    Attributes:
        image: camera name -> `[N, H, W, 3]` uint8.
        state: `[N, J+1]` joints [rad] and gripper opening [m].
        action: `[N, J+1]` joint targets [rad] and gripper opening [m].
        end: `[N]` int32, index just past the last step of the same episode.
        instruction: `[N]` int32, row of the processor's token table.
    """

    image: dict[str, jax.Array]
    state: jax.Array
    action: jax.Array
    end: jax.Array
    instruction: jax.Array


def flatten(episodes: Sequence[Episodes]) -> Steps:
    """Concatenate the valid steps of sets of episodes; instructions are renumbered in order."""
    parts: list[Steps] = []
    offset = phrase = 0
    for group in episodes:
        length = np.asarray(group.length)
        valid = np.flatnonzero(np.arange(group.state.shape[1]) < length[:, None])

        def keep(array: Array, valid: np.ndarray = valid) -> jax.Array:
            return jnp.asarray(array).reshape(-1, *array.shape[2:])[valid]

        parts.append(
            Steps(
                image={name: keep(image) for name, image in group.image.items()},
                state=keep(group.state),
                action=keep(group.action),
                end=jnp.asarray(np.repeat(np.cumsum(length), length) + offset, jnp.int32),
                instruction=jnp.asarray(np.repeat(group.instruction, length) + phrase, jnp.int32),
            )
        )
        offset += int(length.sum())
        phrase += len(group.instructions)
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def windows(steps: Steps, start: jax.Array, chunk: int) -> tuple[jax.Array, jax.Array]:
    """Chunks of steps; one that would reach past its episode repeats the last step there.

    Args:
        steps: N of them.
        start: `[B]` int32, index of each chunk's first step.
        chunk: C.

    Returns:
        `[B, C]` int32 indices, and `[B, C]` bool, False where a step is a repetition.
    """
    window = start[:, None] + jnp.arange(chunk)
    last = steps.end[start][:, None] - 1
    return jnp.minimum(window, last), window <= last


def sample_batch(
    key: jax.Array,
    steps: Steps,
    processor: Processor,
    *,
    batch_size: int,
    chunk: int,
    state_noise: float,
) -> Batch:
    """Draw `batch_size` windows uniformly over steps; `key` is consumed.

    The mask is False where a chunk repeats its episode's last action, see `windows`.
    """
    start_key, noise_key = jax.random.split(key)
    start = jax.random.randint(start_key, (batch_size,), 0, steps.end.shape[0])
    window, inside = windows(steps, start, chunk)
    raw = {
        "image": {name: image[start] for name, image in steps.image.items()},
        "state": steps.state[start],
    }
    noise = state_noise * jax.random.normal(noise_key, (batch_size, processor.statistics.dim))
    observation = processor.encode(raw, steps.instruction[start], state_noise=noise)
    actions = processor.normalize_actions(steps.action[window], raw["state"])
    return Batch(observation, actions, inside[..., None] & processor.flow_slots)
