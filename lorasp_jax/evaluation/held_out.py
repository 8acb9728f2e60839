"""Measure a policy on recorded episodes that it was not trained on, without a simulator."""

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.datasets.episodes import Episodes, joint_names
from lorasp_jax.adapters.compress.quantization import is_quantized
from lorasp_jax.config import VALIDATION_WINDOWS
from lorasp_jax.data.batches import RawBatch, Steps, encode, flatten, gather
from lorasp_jax.data.joined import dataset_of, parts_of
from lorasp_jax.data.source import Source, dimension_names, grippers
from lorasp_jax.models import flow_matching
from lorasp_jax.models.sampling import Sampler
from lorasp_jax.policies.policy import Policy

MAX_WINDOWS, FEW_WINDOWS = 256, 64
"""Largest number of windows that are measured, over all tasks; the second while a CPU trains."""
MAX_INSTRUCTIONS = 8
"""Largest number of instructions whose errors are shown."""
Units = list[tuple[str, float]]
"""Name of each dimension of an action with its unit, and the factor to that unit."""
_DEGREES, _MILLIMETRES = " [°]", " [mm]"
_MAX_NAME = 40  # characters of a dimension's name
_NOISES = 4  # draws of noise and flow time per window, for the loss


@dataclass(frozen=True)
class Windows:
    """N windows of recorded episodes: what the robot saw, did before, and did next.

    Attributes:
        raw: the windows, in host memory.
        targets: whether actions are joint targets, not displacements.
        still: f32 `[N, J+1]`, the action that holds still: the state, or zeros for displacements.
        previous: f32 `[N, J+1]`, the action before each window; first in an episode: `still`.
        task, phrase: the task of each window, and its instruction.
        episode, step: int `[N]`, where each window starts.
        control_dt: time between two actions [s].
        names: those that the dataset has for the dimensions of actions; empty: none.
        grippers: which of these are grippers.
    """

    raw: RawBatch
    targets: bool
    still: np.ndarray
    previous: np.ndarray
    task: tuple[str, ...]
    phrase: tuple[str, ...]
    episode: np.ndarray
    step: np.ndarray
    control_dt: float
    names: tuple[str, ...]
    grippers: tuple[int, ...]

    @property
    def units(self) -> Units:
        """Degrees and mm for joint targets [rad] and grippers [m]; otherwise as recorded."""
        actions = np.abs(np.asarray(self.raw.actions)).max((0, 1))
        is_gripper = np.isin(np.arange(len(actions)), self.grippers)
        in_radians = not (actions[~is_gripper] > 2 * np.pi).any()
        in_metres = not (actions[is_gripper] > 1).any()
        if not self.targets or not (in_radians or in_metres):
            titles = self._titles([f"action {i}" for i in range(1, len(actions) + 1)])
            return [(title, 1.0) for title in titles]
        joints = iter(joint_names(len(actions)))
        titles = self._titles(["gripper" if gripper else next(joints) for gripper in is_gripper])
        joint, gripper = (
            (_DEGREES, 180 / np.pi) if in_radians else ("", 1.0),
            (_MILLIMETRES, 1000.0) if in_metres else ("", 1.0),
        )
        shown = [gripper if each else joint for each in is_gripper]
        return [(title + unit, x) for title, (unit, x) in zip(titles, shown, strict=True)]

    def _titles(self, default: list[str]) -> list[str]:
        """Return unique names of the dimensions: the dataset's, or else the default ones."""
        printed = ["".join(filter(str.isprintable, name))[:_MAX_NAME] for name in self.names]
        names = printed or default
        repeated = {name for name in names if names.count(name) > 1}
        return [f"{name} ({i})" if name in repeated else name for i, name in enumerate(names, 1)]


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
        instructions: instruction -> mean errors of the policy, of holding still and of repeating,
            as `Errors.mean`; the worst first.
    """

    loss: float
    policy: Errors
    hold: Errors
    repeat: Errors
    actions: np.ndarray
    units: Units
    instructions: dict[str, list[float]]

    @property
    def scalars(self) -> dict[str, float]:
        """What is logged."""
        errors = {"": self.policy, "hold_still/": self.hold, "repeat/": self.repeat}
        values = {f"validation/{name}action_error": x.mean for name, x in errors.items()}
        titles = (name.removesuffix(_DEGREES).removesuffix(_MILLIMETRES) for name, _ in self.units)
        by_dimension = {
            f"validation/{title.replace(' ', '_')}": factor * float(x)
            for title, (_, factor), x in zip(titles, self.units, self.policy.action, strict=True)
        }
        # Last, as a dimension may have any name.
        return {**by_dimension, "validation/loss": self.loss, **values}


def windows(
    source: Source,
    episodes: Sequence[int],
    policy: Policy,
    *,
    every: int | None = None,
    limit: int = MAX_WINDOWS,
) -> Windows:
    """Choose windows of some episodes: evenly spaced, equally many per episode.

    Args:
        source: the dataset.
        episodes: their numbers; if there are more than `limit`, only some are used.
        policy: gives the length of the chunk and the prompts.
        every: take the windows this many steps apart instead.
        limit: largest number of windows; of an episode, with `every`.

    Raises:
        ValueError: the policy has no prompt for an instruction, an episode is damaged, or its
            actions are not what policies give.
    """
    chosen = _evenly([*episodes], limit)
    share = limit if every else limit // len(chosen)
    read = [_read(source, number, policy, every or 1, share) for number in chosen]
    parts, previous, lists = zip(*read, strict=True)
    raw = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    where = itertools.chain(*lists)
    task, phrases, number, start = zip(*where, strict=True)
    targets = _are_targets(raw.state, raw.actions[:, 0])
    still = raw.state if targets else 0 * raw.actions[:, 0]
    starts = np.array(start)
    return Windows(
        raw,
        targets,
        still,
        np.where(starts[:, None] > 0, np.concatenate(previous), still),
        task,
        phrases,
        np.array(number),
        starts,
        source.control_dt,
        tuple(dimension_names(source).get("action", ())),
        tuple(grippers(source)),
    )


def episodes_of(source: Source, dataset: str) -> list[int]:
    """Return the numbers of the episodes of one of the datasets in a cache, or of all episodes."""
    names = [part.name for part in parts_of(source)]
    if dataset in names:
        return np.flatnonzero(dataset_of(source) == names.index(dataset)).tolist()
    return [*range(len(source))]


def _read(
    source: Source, number: int, policy: Policy, every: int, limit: int
) -> tuple[RawBatch, np.ndarray, list[tuple[str, str, int, int]]]:
    """Return windows of an episode, the actions before them, and where they are.

    That is task, instruction, number of the episode and step.
    """
    episode = source.episode(number)
    steps = _steps(episode, policy)
    if parts_of(source)[1:]:
        dataset = np.full_like(steps.end, dataset_of(source)[number])
        steps = dataclasses.replace(steps, dataset=dataset)
    starts = np.array(_evenly(range(0, len(steps.end), every), limit), np.int32)
    where = [(episode.task, episode.phrases[0], number, int(start)) for start in starts]
    raw = gather(steps, starts, policy.model.config.chunk)
    return raw, np.asarray(steps.action[starts - 1]), where


def _steps(episode: Episodes, policy: Policy) -> Steps:
    """Return the steps of an episode, with instructions as rows of the policy's prompts."""
    if episode.actions != "joint":
        raise ValueError(f"policies give joint targets, but {episode.actions} was recorded")
    steps = flatten([episode])
    rows = policy.processor.prompts.rows(episode.instructions)
    return dataclasses.replace(steps, instruction=rows[steps.instruction])


def _are_targets(state: np.ndarray, action: np.ndarray) -> bool:
    """Whether actions `[N, n]` are closer to the states than to zero, where displacements are."""
    same = state.shape[-1] == action.shape[-1]
    return same and bool(np.abs(action - state).mean() <= np.abs(action).mean())


def _evenly(values: Sequence[int], count: int) -> list[int]:
    """Return up to `count` of the values, evenly spaced, the first included."""
    count = min(count, len(values))
    return [values[i * len(values) // count] for i in range(count)]


def measure(policy: Policy, found: Windows, *, num_steps: int) -> HeldOut:
    """Measure a policy on windows; the same policy and windows give the same values.

    Args:
        policy: policy with its training model, not its sampler.
        found: from `windows`.
        num_steps: Euler steps of the flow-matching sampler.
    """
    actions, loss = _run(policy, found, num_steps)
    compared = actions, found.still[:, None], found.previous[:, None]
    errors = (_errors(values, found.raw) for values in compared)
    return HeldOut(
        loss,
        *errors,
        actions=actions,
        units=found.units,
        instructions=_by_instruction(compared, found),
    )


def sample(policy: Policy, found: Windows, *, num_steps: int) -> np.ndarray:
    """Return the chunks `[N, C, J+1]` that `measure` compares; same arguments."""
    return _run(policy, found, num_steps)[0]


def _run(policy: Policy, found: Windows, num_steps: int) -> tuple[np.ndarray, float]:
    """Return the chunks `[N, C, J+1]` and the mean loss.

    A policy that is quantized to save memory is not copied into a sampler, which would be faster.
    """
    policy = policy if is_quantized(policy.model) else policy.with_sampler()
    count, key = len(found.task), jax.random.key(0)
    chunks, sums = [], []
    for first in range(0, count, VALIDATION_WINDOWS):
        rows = np.arange(first, first + VALIDATION_WINDOWS)
        raw = jax.tree.map(lambda x, rows=rows: x[rows % count], found.raw)  # the last wraps around
        fresh, keys = rows < count, jax.random.split(jax.random.fold_in(key, first), 2)
        chunk, *loss = jax.device_get(_program(policy, raw, fresh, keys, num_steps=num_steps))
        chunks.append(chunk[fresh])
        sums.append(loss)
    loss, valid = np.array(sums, np.float64).sum(axis=0).tolist()
    return np.concatenate(chunks), loss / valid


@functools.partial(jax.jit, static_argnames="num_steps")
def _program(
    policy: Policy, raw: RawBatch, fresh: jax.Array, keys: jax.Array, *, num_steps: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return chunks, the sum of the flow-matching loss over valid elements, and their number.

    Both see the same encoded observations. Rows that are not `fresh` do not count in the loss.
    """
    batch, model = encode(keys[0], raw, policy.processor, state_noise=0.0), policy.model
    sampler = model if isinstance(model, Sampler) else Sampler.from_model(model, once=True)
    velocity, _ = sampler.encode(batch.observation)
    mask = batch.action_mask & jnp.asarray(fresh)[:, None, None]

    def loss(key: jax.Array) -> jax.Array:
        used = batch.action_mask.any(axis=1, keepdims=True)
        return jnp.sum(mask * flow_matching.loss(velocity, key, batch.actions, slots=used)[0])

    losses = jax.lax.map(loss, jax.random.split(keys[0], _NOISES))
    noise = jax.random.normal(keys[1], batch.actions.shape)
    flow: Any = {"num_steps": num_steps, "slots": jnp.asarray(policy.processor.flow_slots)}
    noise = sampler.initial_noise(velocity, batch.observation, noise, **flow)
    chunk, _ = flow_matching.sample(velocity, noise, **flow)
    dataset: Any = raw.dataset
    actions = policy.processor.of_rows(dataset).decode(chunk, jnp.asarray(raw.state))
    return actions, losses.sum(), _NOISES * mask.sum()


def _errors(actions: np.ndarray, raw: RawBatch) -> Errors:
    """Compare actions `[N, C, J+1]` (or broadcast to it) with the recorded ones."""
    inside = np.asarray(raw.inside)[..., None]
    recorded, spread = np.asarray(raw.actions, np.float64), _spread(raw)
    distance = np.abs(actions - recorded) * inside
    relative = (distance / spread).mean(-1)
    horizon = relative.sum(0) / np.maximum(inside.sum((0, 2)), 1)
    action, mean = distance.sum((0, 1)) / inside.sum(), float(relative.sum() / inside.sum())
    return Errors(action, distance[:, 0].mean(0), horizon, mean)


def _spread(raw: RawBatch) -> np.ndarray:
    """Return the standard deviations of the actions in each row's dataset, `[N, 1, J+1]`."""
    recorded, inside = np.asarray(raw.actions, np.float64), np.asarray(raw.inside)
    dataset = np.zeros(len(recorded), np.int32) if raw.dataset is None else np.asarray(raw.dataset)
    spread = np.ones_like(recorded[:, :1])
    for index in np.unique(dataset):
        rows = dataset == index
        spread[rows] = _deviation(recorded[rows][inside[rows]])
    return spread


def _deviation(recorded: np.ndarray) -> np.ndarray:
    """Return the standard deviations of actions `[N, J+1]`."""
    spread = recorded.std(0)
    # What hardly moves must not decide: its standard deviation is the noise of its sensor.
    return np.maximum(spread, max(0.1 * float(np.median(spread)), 1e-6))


def _by_instruction(compared: Sequence[np.ndarray], found: Windows) -> dict[str, list[float]]:
    """Return `HeldOut.instructions` of actions `[N, C, J+1]`, the policy's first."""
    inside = np.asarray(found.raw.inside)[..., None] / _spread(found.raw)
    recorded = np.asarray(found.raw.actions, np.float64)
    errors: dict[str, list[float]] = {}
    for phrase in dict.fromkeys(found.phrase):
        rows = [i for i, other in enumerate(found.phrase) if other == phrase]
        valid = np.asarray(found.raw.inside)[rows].sum()
        distances = (np.abs(np.broadcast_to(x, recorded.shape) - recorded)[rows] for x in compared)
        errors[phrase] = [float((x * inside[rows]).sum((0, 1)).mean() / valid) for x in distances]
    return dict(sorted(errors.items(), key=lambda item: -item[1][0])[:MAX_INSTRUCTIONS])


COLUMNS = ("first action", "chunk", "hold still", "repeat previous")
"""Columns of `table`: errors of the policy's first action and chunk, and of two that do nothing."""
DONE = ("policy", "hold still", "repeat previous")
"""Columns of `HeldOut.instructions`."""


def table(found: HeldOut) -> dict[str, list[float]]:
    """Return the errors by dimension, in `COLUMNS`."""
    errors = (found.policy.first, found.policy.action, found.hold.action, found.repeat.action)
    rows = zip(found.units, zip(*errors, strict=True), strict=True)
    return {name: [factor * float(x) for x in row] for (name, factor), row in rows}
