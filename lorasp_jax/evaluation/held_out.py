"""Measure a policy on recorded episodes that it was not trained on, without a simulator."""

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.data.batches import RawBatch, encode, flatten, gather
from lorasp_jax.data.cache import Cache
from lorasp_jax.data.source import Source
from lorasp_jax.policies.policy import Policy

MAX_WINDOWS = 256
"""Largest number of windows that are measured, over all tasks."""
Units = list[tuple[str, float]]
"""Name of each dimension of an action with its unit, and the factor to that unit."""
_BATCH = 16  # windows per call
_NOISES = 4  # draws of noise and flow time per window, for the loss


@dataclass(frozen=True)
class Windows:
    """N windows of recorded episodes: what the robot saw, did before, and did next.

    Attributes:
        raw: the windows, in host memory.
        still: f32 `[N, J+1]`, the action that holds still: the state, or zeros where actions are
            displacements, which have another length than states.
        previous: f32 `[N, J+1]`, the action before each window; first in an episode: `still`.
        task: the task of each window.
        episode, step: int `[N]`, where each window starts.
        control_dt: time between two actions [s].
    """

    raw: RawBatch
    still: np.ndarray
    previous: np.ndarray
    task: tuple[str, ...]
    episode: np.ndarray
    step: np.ndarray
    control_dt: float

    @property
    def units(self) -> Units:
        """Degrees and mm for joint targets [rad, m]; otherwise the numbers as recorded."""
        actions = np.abs(np.asarray(self.raw.actions)).max((0, 1))
        joints, gripper = actions[:-1], actions[-1]
        if self.raw.state.shape[-1] != len(actions) or joints.max() > 2 * np.pi or gripper > 1:
            return [(f"action {i}", 1.0) for i in range(1, len(actions) + 1)]
        degrees = [(f"joint {i} [°]", 180 / np.pi) for i in range(1, len(actions))]
        return [*degrees, ("gripper [mm]", 1000.0)]


@dataclass(frozen=True)
class Errors:
    """Mean distance between some actions and the recorded ones.

    Attributes:
        action: over the chunk, by dimension, `[J+1]` [rad, m].
        first: of the first action, by dimension, `[J+1]` [rad, m].
        horizon: by step of the chunk, `[C]`, in standard deviations of the recorded actions, of
            each dataset by its own.
        mean: over the chunk and all dimensions, in standard deviations of the recorded actions, at
            least a tenth of their median.
    """

    action: np.ndarray
    first: np.ndarray
    horizon: np.ndarray
    mean: float


@dataclass(frozen=True)
class HeldOut:
    """A policy on held-out windows.

    Attributes:
        loss: flow-matching loss at fixed noise and times.
        policy: errors of the sampled chunks.
        hold, repeat: errors of holding still and of repeating the previous action.
        actions: f32 `[N, C, J+1]`, the sampled chunks [rad, m].
        units: those of the table and of what is logged.
    """

    loss: float
    policy: Errors
    hold: Errors
    repeat: Errors
    actions: np.ndarray
    units: Units

    @property
    def scalars(self) -> dict[str, float]:
        """What is logged."""
        errors = {"": self.policy, "hold_still/": self.hold, "repeat/": self.repeat}
        values = {f"validation/{name}action_error": x.mean for name, x in errors.items()}
        pairs = zip(self.units, self.policy.action, strict=True)
        by_dimension = {
            f"validation/{name.partition(' [')[0].replace(' ', '_')}": factor * float(x)
            for (name, factor), x in pairs
        }
        return {"validation/loss": self.loss, **values, **by_dimension}


def windows(
    source: Source, episodes: Sequence[int], policy: Policy, *, every: int | None = None
) -> Windows:
    """Choose windows of some episodes: evenly spaced, equally many per episode.

    Args:
        source: the dataset.
        episodes: their numbers; if there are more than `MAX_WINDOWS`, only some are used.
        policy: gives the length of the chunk and the prompts.
        every: take the windows this many steps apart instead.

    Raises:
        ValueError: the policy has no prompt for an instruction, an episode is damaged, or its
            actions are not what policies give.
    """
    chunk, chosen = policy.model.config.chunk, _evenly([*episodes], MAX_WINDOWS)
    share = MAX_WINDOWS // len(chosen)
    parts, still, previous, where = [], [], [], []
    for number in chosen:
        episode = source.episode(number)
        if episode.actions != "joint":
            raise ValueError(f"policies give joint targets, but {episode.actions} was recorded")
        steps = flatten([episode])
        rows = policy.processor.prompts.rows(episode.instructions)
        steps = dataclasses.replace(steps, instruction=rows[steps.instruction])
        if isinstance(source, Cache) and source.parts[1:]:
            steps = dataclasses.replace(
                steps, dataset=np.full_like(steps.end, source.dataset[number])
            )
        all_starts = [*range(0, len(steps.end), every or 1)]
        starts = np.array(_evenly(all_starts, MAX_WINDOWS if every else share), np.int32)
        parts.append(gather(steps, starts, chunk))
        is_target = steps.state.shape[-1] == steps.action.shape[-1]
        still.append(steps.state[starts] if is_target else 0 * steps.action[starts])
        previous.append(np.where(starts[:, None] > 0, steps.action[starts - 1], still[-1]))
        where += [(episode.task, number, int(start)) for start in starts]
    raw = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    task, number, start = zip(*where, strict=True)
    actions = np.concatenate(still), np.concatenate(previous)
    return Windows(raw, *actions, task, np.array(number), np.array(start), source.control_dt)


def _evenly(values: Sequence[int], count: int) -> list[int]:
    """Return up to `count` of the values, evenly spaced, the first included."""
    count = min(count, len(values))
    return [values[i * len(values) // count] for i in range(count)]


def measure(policy: Policy, found: Windows, *, num_steps: int = 10) -> HeldOut:
    """Measure a policy on windows; the same policy and windows give the same values.

    Args:
        policy: policy with its training model, not its sampler.
        found: from `windows`.
        num_steps: Euler steps of the flow-matching sampler.
    """
    chunks = sample(policy, found, num_steps=num_steps)
    sums = [_loss(policy, raw, fresh, keys[0]) for raw, fresh, keys in _batches(found)]
    loss, valid = np.array(jax.device_get(sums), np.float64).T.sum(axis=1).tolist()
    compared = chunks, found.still[:, None], found.previous[:, None]
    errors = (_errors(actions, found.raw) for actions in compared)
    return HeldOut(loss / valid, *errors, actions=chunks, units=found.units)


def sample(policy: Policy, found: Windows, *, num_steps: int = 10) -> np.ndarray:
    """Return the chunks `[N, C, J+1]` that `measure` compares; same arguments."""
    sampling = policy.with_sampler()
    chunks = [
        np.asarray(_actions(sampling, raw, keys[1], num_steps=num_steps))[fresh]
        for raw, fresh, keys in _batches(found)
    ]
    return np.concatenate(chunks)


def _batches(found: Windows) -> Iterator[tuple[RawBatch, np.ndarray, jax.Array]]:
    """Yield batches of windows, which of their rows are new, and two keys."""
    count, key = len(found.task), jax.random.key(0)
    for first in range(0, count, _BATCH):
        rows = np.arange(first, first + _BATCH)
        raw = jax.tree.map(lambda x, rows=rows: x[rows % count], found.raw)  # the last wraps around
        yield raw, rows < count, jax.random.split(jax.random.fold_in(key, first), 2)


@jax.jit
def _loss(
    policy: Policy, raw: RawBatch, fresh: jax.Array, key: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the sum of the flow-matching loss over valid elements, and their number."""
    batch = encode(key, raw, policy.processor, state_noise=0.0)
    mask = batch.action_mask & jnp.asarray(fresh)[:, None, None]

    def one(key: jax.Array) -> jax.Array:
        observed, actions = batch.observation, batch.actions
        loss, _ = policy.model.loss(key, observed, actions, action_mask=batch.action_mask)
        return jnp.sum(loss * mask)

    return jax.lax.map(one, jax.random.split(key, _NOISES)).sum(), _NOISES * mask.sum()


@functools.partial(jax.jit, static_argnames="num_steps")
def _actions(policy: Policy, raw: RawBatch, key: jax.Array, *, num_steps: int) -> jax.Array:
    observed: Any = {"image": raw.image, "state": raw.state}
    observed = jax.tree.map(jnp.asarray, observed)
    dataset = None if raw.dataset is None else jnp.asarray(raw.dataset)
    policy = dataclasses.replace(policy, processor=policy.processor.of_rows(dataset))
    return policy.sample(key, observed, jnp.asarray(raw.instruction), num_steps=num_steps)


def _errors(actions: np.ndarray, raw: RawBatch) -> Errors:
    """Compare actions `[N, C, J+1]` (or broadcast to it) with the recorded ones."""
    inside = np.asarray(raw.inside)[..., None]
    recorded = np.asarray(raw.actions, np.float64)
    distance = np.abs(actions - recorded) * inside
    dataset = np.zeros(len(recorded), np.int32) if raw.dataset is None else np.asarray(raw.dataset)
    spread = np.ones_like(recorded[:, :1])
    for index in np.unique(dataset):
        spread[dataset == index] = _spread(recorded[dataset == index], inside[dataset == index])
    relative = (distance / spread).mean(-1)
    horizon = relative.sum(0) / np.maximum(inside.sum((0, 2)), 1)
    action, mean = distance.sum((0, 1)) / inside.sum(), float(relative.sum() / inside.sum())
    return Errors(action, distance[:, 0].mean(0), horizon, mean)


def _spread(recorded: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return the standard deviations of actions `[N, C, J+1]` inside their episodes."""
    spread = recorded[inside[..., 0]].std(0)
    # What hardly moves must not decide: its standard deviation is the noise of its sensor.
    return np.maximum(spread, max(0.1 * float(np.median(spread)), 1e-6))


COLUMNS = ("first action", "chunk", "hold still", "repeat previous")
"""Columns of `table`: errors of the policy's first action and chunk, and of two that do nothing."""


def table(found: HeldOut) -> dict[str, list[float]]:
    """Return the errors by dimension, in `COLUMNS`."""
    errors = (found.policy.first, found.policy.action, found.hold.action, found.repeat.action)
    rows = zip(found.units, zip(*errors, strict=True), strict=True)
    return {name: [factor * float(x) for x in row] for (name, factor), row in rows}
