"""Advantage-conditioned learning from recordings (RECAP, arXiv 2511.14759).

A step costs 1, a failure as much as the longest episode of its task. The value of an observation
is the expected return, read off features of the frozen base by ridge regression; each episode's
values come from fits to other episodes. The advantage of a step is the return of the next
`recap.steps` steps, plus the change of the value; past the end of an episode, it is its whole
return. Steps of high advantage, demonstrations and corrections are good, and prompts say so.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.base.files import as_value_error, check_regular
from lorasp_jax.base.writing import atomic_file
from lorasp_jax.config import Config
from lorasp_jax.data.batches import RawBatch, encode, gather
from lorasp_jax.data.cache import Cache
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.policies.processor import Processor
from lorasp_jax.training.distributed import processes
from lorasp_jax.training.offline import Chosen
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run import Run
from lorasp_jax.training.run_folder import ADVANTAGES

_FOLDS = 5
_BATCH = 32  # observations whose features are computed at once
_MIXED = 32  # random mixtures of tokens, and of their features: 1,024 numbers an observation
_HIDDEN = 512  # random rectified units of the nonlinear fit
_RIDGES = (0.01, 0.1, 1.0)  # relative to the variance of a feature, times the number of steps


class Advantages(NamedTuple):
    """Of N recorded steps.

    Attributes:
        value: f32 `[N]`, expected return in units of twice the task's longest episode, -1 to 0.
        advantage: f32 `[N]`, in the same units.
        good: bool `[N]`.
        correlation: `[]`, rank correlation of values and returns.
    """

    value: np.ndarray
    advantage: np.ndarray
    good: np.ndarray
    correlation: np.ndarray


def prompt_rows(run: Run, model: Backbone, processor: Processor) -> np.ndarray:
    """Return the rows of the prompt table for all steps, `[N]` int32; see `prompts.ADVANTAGE`.

    What they are made of is kept in the run's folder, so that a resumed run learns the same.

    Raises:
        ValueError: the file of an earlier process is damaged.
    """
    cache, chosen, config = run.recordings, run.chosen, run.config
    assert cache is not None
    assert chosen is not None
    path = run.folder / ADVANTAGES
    with processes.first_process_first("advantages"):
        if not path.exists():
            with run.timed("value"):
                found = advantages(cache, chosen, config, features(cache, model, processor))
            with atomic_file(path) as temporary, temporary.open("wb") as file:
                np.savez(file, **found._asdict())
        with as_value_error(path), check_regular(path).open("rb") as file, np.load(file) as archive:
            found = Advantages(**archive)
    share = found.good[_compared(cache, chosen)].mean()
    run.console.print(
        f"value of held-out episodes: rank correlation {found.correlation:.2f} with returns; "
        f"{100 * share:.0f} % of the policy's steps are good",
        highlight=False,
    )
    key, steps = RandomStream.CONDITION.key(config.seed), cache.steps
    untold = np.asarray(jax.random.bernoulli(key, config.recap.dropout, (cache.num_steps,)))
    ending = np.where(untold, 2, np.where(found.good, 0, 1))
    rows = np.asarray(steps.instruction)
    return (rows + len(cache.instructions) * ending).astype(np.int32)


def advantages(cache: Cache, chosen: Chosen, config: Config, observed: np.ndarray) -> Advantages:
    """Compute the advantage of every step from features `[N, F]` of what was observed."""
    episode, end, recap = cache.episodes, np.asarray(cache.steps.end), config.recap
    task, longest = _tasks(cache)
    known = (chosen.outcome >= 0)[episode]
    scale, failed = 2 * longest[task][episode], (chosen.outcome == 0)[episode]
    returns = -(end - 1 - np.arange(len(end)) + failed * scale / 2) / scale
    value = _values(observed, returns, episode, known)
    ahead = np.arange(len(end)) + recap.steps
    later = value[np.minimum(ahead, len(end) - 1)] - recap.steps / scale
    advantage = np.where(ahead < end, later, returns) - value
    good, compared = np.array(chosen.demonstrated[episode]), _compared(cache, chosen)
    for index in range(len(longest)):
        rows = np.flatnonzero(compared & (task[episode] == index))
        lots = np.random.default_rng(0).permutation(len(rows))  # among equal advantages
        best = np.lexsort((lots, -advantage[rows]))[: round(recap.share * len(rows))]
        good[rows[best]] = True
    if cache.corrected is not None:
        good |= cache.corrected
    correlation = _rank_correlation(value[known], returns[known])
    numbers = value.astype(np.float32), advantage.astype(np.float32)
    return Advantages(*numbers, good, np.asarray(correlation))


def _tasks(cache: Cache) -> tuple[np.ndarray, np.ndarray]:
    """Return the task of each episode, `[E]`, and the longest episode of each task, in steps."""
    length = np.bincount(cache.episodes)
    task = np.unique(cache.tasks, return_inverse=True)[1]
    return task, np.array([length[task == index].max() for index in range(task.max() + 1)])


def _compared(cache: Cache, chosen: Chosen) -> np.ndarray:
    """Return the steps that a policy took and whose outcome is known, `[N]` bool."""
    rows = ((chosen.outcome >= 0) & ~chosen.demonstrated)[cache.episodes]
    return rows if cache.corrected is None else rows & ~cache.corrected


def features(cache: Cache, model: Backbone, processor: Processor) -> np.ndarray:
    """Return features of what was observed in every step, f32 `[N, F]`.

    These are random mixtures of the tokens that the frozen base makes of images and instruction,
    and the normalized state.
    """
    steps, rows = cache.steps, []
    for first in range(0, cache.num_steps, _BATCH):
        index = np.minimum(np.arange(first, first + _BATCH), cache.num_steps - 1)
        rows.append(np.asarray(_features(model, processor, gather(steps, index, 1))))
    return np.concatenate(rows)[: cache.num_steps]


@jax.jit
def _features(model: Backbone, processor: Processor, raw: RawBatch) -> jax.Array:
    keys = jax.random.split(jax.random.key(0), 3)
    observation = encode(keys[0], raw, processor, state_noise=0.0).observation
    tokens, valid, _ = model.embed_prefix(observation)
    tokens = tokens.astype(jnp.float32) * valid[..., None]
    across = jax.random.normal(keys[1], (tokens.shape[1], _MIXED))
    within = jax.random.normal(keys[2], (tokens.shape[2], _MIXED))
    mixed = jnp.einsum("btd,tm,dn->bmn", tokens, across, within)
    return jnp.concatenate([mixed.reshape(len(mixed), -1), observation.state], axis=1)


def _values(
    observed: np.ndarray, returns: np.ndarray, episode: np.ndarray, known: np.ndarray
) -> np.ndarray:
    """Predict the return of every step by fits that leave the step's episode out, `[N]`.

    Of linear and nonlinear fits of several strengths, the one with the least error is taken.
    """
    x = (observed - observed.mean(0)) / np.maximum(observed.std(0), 1e-6)
    random = np.random.default_rng(0).normal(size=(x.shape[1], _HIDDEN)) / np.sqrt(x.shape[1])
    fold = np.random.default_rng(0).permutation(episode.max() + 1)[episode] % _FOLDS
    fits = []
    for features in (x, np.maximum(x @ random.astype(np.float32), 0)):
        fits += _held_out_fits(features, returns, fold, known)
    errors = [np.square(value - returns)[known].mean() for value in fits]
    return fits[int(np.argmin(errors))]


def _held_out_fits(
    x: np.ndarray, returns: np.ndarray, fold: np.ndarray, known: np.ndarray
) -> list[np.ndarray]:
    """Return predictions `[N]` by ridge regression on `[N, F]`, for each of `_RIDGES`."""
    mean, fits = returns[known].mean(), [np.zeros(len(x)) for _ in _RIDGES]
    for index in range(_FOLDS):
        rows, held_out = known & (fold != index), fold == index
        gram, target = x[rows].T @ x[rows], x[rows].T @ (returns[rows] - mean)
        for value, ridge in zip(fits, _RIDGES, strict=True):
            penalty = ridge * max(rows.sum(), 1) * np.eye(len(gram))
            weights = np.linalg.solve(gram + penalty, target)
            value[held_out] = np.clip(mean + x[held_out] @ weights, -1, 0)
    return fits


def _rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Spearman's correlation; equal values share a rank, and 0 if all are equal."""
    if not np.ptp(a) or not np.ptp(b):
        return 0.0

    def ranks(values: np.ndarray) -> np.ndarray:
        level, counts = np.unique(values, return_inverse=True, return_counts=True)[1:]
        return (np.cumsum(counts) - (counts - 1) / 2)[level]

    return float(np.corrcoef(ranks(a), ranks(b))[0, 1])
