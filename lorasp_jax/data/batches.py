"""Training batches: windows of demonstrations.

Episodes are stored as flat per-step arrays, on the device if they fit there, otherwise in files. A
batch depends only on the run's key or seed and on the training step, so the step number is all that
is needed to resume.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.datasets.episodes import Array, Episodes
from lorasp_jax.policies.policy import Observation
from lorasp_jax.policies.processor import Processor, RawObservation


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Batch:
    """Input of one training step.

    Attributes:
        observation: normalized model input, leading axis B.
        actions: `[B, C, A]` normalized action chunks in the policy's slots.
        action_mask: `[B, C, A]` bool, True within the episode and in `Processor.flow_slots`.
    """

    observation: Observation
    actions: jax.Array
    action_mask: jax.Array


class Mixture(NamedTuple):
    """Weights of datasets.

    Attributes:
        bounds: `[D+1]` int32, the number of the first window of each dataset, and of all windows.
        shares: `[D]` f32, how many of the windows that are drawn come from each dataset; sum 1.
    """

    bounds: Array
    shares: Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Steps:
    """All steps of all episodes, concatenated.

    Attributes:
        image: camera name -> `[N, H, W, 3]` uint8.
        state: `[N, J+1]` joints [rad] and gripper opening [m].
        action: `[N, J+1]` joint targets [rad] and gripper opening [m], or of another length.
        end: `[N]` int32, index just past the last step of the episode.
        instruction: `[N]` int32, row of the processor's token table.
        starts: `[S]` int32, the steps at which a window may start; None: all.
        dataset: `[N]` int32, index of the dataset among several; None: there is one.
        mixture: how often windows are drawn from each dataset; None: each window equally often.
    """

    image: dict[str, Array]
    state: Array
    action: Array
    end: Array
    instruction: Array
    starts: Array | None = None
    dataset: Array | None = None
    mixture: Mixture | None = None

    @property
    def num_starts(self) -> int:
        """Number of windows."""
        return len(self.end if self.starts is None else self.starts)

    def start(self, window: Array) -> Array:
        """Return the steps at which windows start, given their numbers."""
        return window if self.starts is None else self.starts[window]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RawBatch:
    """A batch before normalization: the observations at B steps and the actions that follow.

    Attributes:
        image: camera name -> `[B, H, W, 3]` uint8.
        state: `[B, J+1]` joints [rad] and gripper opening [m].
        actions: `[B, C, J+1]` joint targets [rad] and gripper opening [m]; past the end of the
            episode, the last action is repeated.
        inside: `[B, C]` bool, False past the end of the episode.
        instruction: `[B]` int32, row of the processor's token table.
        dataset: `[B]` int32, index of the dataset among several; None: there is one.
    """

    image: dict[str, Array]
    state: Array
    actions: Array
    inside: Array
    instruction: Array
    dataset: Array | None = None


def flatten(episodes: Sequence[Episodes]) -> Steps:
    """Concatenate all episodes without padding, and number their instructions consecutively.

    The result is in host memory: on a device, the copies would take several times its size.
    """
    parts: list[Steps] = []
    step_offset = instruction_offset = 0
    for group in episodes:
        length = np.asarray(group.length)
        valid = np.flatnonzero(np.arange(group.state.shape[1]) < length[:, None])

        def keep(array: Array, valid: np.ndarray = valid) -> np.ndarray:
            return np.asarray(array).reshape(-1, *array.shape[2:])[valid]

        parts.append(
            Steps(
                image={name: keep(image) for name, image in group.image.items()},
                state=keep(group.state),
                action=keep(group.action),
                end=np.repeat(np.cumsum(length) + step_offset, length).astype(np.int32),
                instruction=np.repeat(
                    np.asarray(group.instruction, np.int32) + np.int32(instruction_offset), length
                ),
            )
        )
        step_offset += int(length.sum())
        instruction_offset += len(group.instructions)
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def fit_to_size(steps: Steps, size: int) -> Steps:
    """Truncate to `size` steps, or repeat the steps cyclically to reach `size`."""
    number = len(steps.end)
    rows = np.arange(size) % number
    fitted = jax.tree.map(lambda array: array[rows], steps)
    end = fitted.end + np.int32(number) * (np.arange(size, dtype=np.int32) // number)
    return dataclasses.replace(fitted, end=jnp.minimum(end, size))


def windows(steps: Steps, start: Array, chunk: int) -> tuple[Array, Array]:
    """Compute the step indices of chunks, repeating the last step past the end of an episode.

    Args:
        steps: the N steps to index.
        start: `[B]` int32, first step of each chunk; a NumPy array gives NumPy results.
        chunk: C.

    Returns:
        Indices, `[B, C]` int32, and a mask, `[B, C]` bool, False where the last step is repeated.
    """
    xp = jnp if isinstance(start, jax.Array) else np
    window = start[:, None] + xp.arange(chunk)
    last = steps.end[start][:, None] - 1
    return xp.minimum(window, last), window <= last


def gather(steps: Steps, start: Array, chunk: int) -> RawBatch:
    """Gather the windows that start at steps `start`, `[B]`; see `windows`."""
    window, inside = windows(steps, start, chunk)
    return RawBatch(
        image={name: image[start] for name, image in steps.image.items()},
        state=steps.state[start],
        actions=steps.action[window],
        inside=inside,
        instruction=steps.instruction[start],
        dataset=None if steps.dataset is None else steps.dataset[start],
    )


def draw(key: jax.Array, steps: Steps, *, batch_size: int, chunk: int) -> RawBatch:
    """Gather `batch_size` random windows, by `Steps.mixture` if there is one."""
    low, high = 0, steps.num_starts
    if steps.mixture is not None:
        bounds, shares = steps.mixture
        which, key = jax.random.split(key)
        dataset = jax.random.choice(which, len(shares), (batch_size,), p=shares)
        low, high = bounds[dataset], bounds[dataset + 1]
    window = jax.random.randint(key, (batch_size,), low, high)
    return gather(steps, steps.start(window), chunk)


def encode(key: jax.Array, raw: RawBatch, processor: Processor, *, state_noise: float) -> Batch:
    """Normalize a batch for the model; `key` seeds the noise added to the normalized state."""
    batch: Any = jax.tree.map(jnp.asarray, raw)
    processor = processor.of_rows(batch.dataset)
    observed: RawObservation = {"image": batch.image, "state": batch.state}
    noise = state_noise * jax.random.normal(key, (len(batch.state), processor.statistics.dim))
    observation = processor.encode(observed, batch.instruction, state_noise=noise)
    actions = processor.normalize_actions(batch.actions, batch.state)
    return Batch(observation, actions, batch.inside[..., None] & processor.flow_slots)


def sample_batch(
    key: jax.Array,
    steps: Steps,
    processor: Processor,
    *,
    batch_size: int,
    chunk: int,
    state_noise: float,
) -> Batch:
    """Draw and normalize `batch_size` windows."""
    start_key, noise_key = jax.random.split(key)
    raw = draw(start_key, steps, batch_size=batch_size, chunk=chunk)
    return encode(noise_key, raw, processor, state_noise=state_noise)


def nbytes(tree: Any) -> int:
    """Return the size of the arrays or shapes in a pytree [bytes]."""
    leaves = [leaf for leaf in jax.tree.leaves(tree) if hasattr(leaf, "dtype")]
    return sum(leaf.size * leaf.dtype.itemsize for leaf in leaves)
