"""Learn from recordings with outcomes: which of their episodes and steps count.

A dataset without outcomes or without failures holds demonstrations. Of an episode that does not
count, the steps that a person corrected still do.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rich.console import Console

from lorasp_jax.config import Config
from lorasp_jax.data.cache import Cache


@dataclass(frozen=True)
class Chosen:
    """What is learned from E episodes.

    Attributes:
        outcome: int `[E]`, 1 success, 0 failure, -1 unknown; demonstrations succeeded.
        demonstrated: bool `[E]`, episodes of demonstrations.
        left_out: numbers of the episodes that do not count.
        corrected: numbers of those of which only corrected steps count.
    """

    outcome: np.ndarray
    demonstrated: np.ndarray
    left_out: tuple[int, ...] = ()
    corrected: tuple[int, ...] = ()

    @property
    def successes(self) -> list[int]:
        """Numbers of the episodes that succeeded."""
        return np.flatnonzero(self.outcome == 1).tolist()


def choose(cache: Cache, config: Config) -> Chosen:
    """Choose by `Config.learn`.

    Raises:
        ValueError: the recordings have no outcomes, or recap has no failure to learn from.
    """
    outcome = np.full(len(cache), -1) if cache.success is None else np.array(cache.success)
    demonstrated = np.zeros(len(cache), bool)
    for index in range(len(cache.parts)):
        rows = cache.dataset == index
        demonstrated[rows] = (outcome[rows] == -1).all() or (outcome[rows] == 1).all()
    if config.learn == "imitation":
        return Chosen(outcome, demonstrated)
    if (outcome == -1).all():
        raise ValueError(
            f"{' '.join(config.data.source)} does not say which episodes succeeded, as --learn "
            f"{config.learn} needs: see docs/datasets.md"
        )
    outcome[demonstrated] = 1
    if config.learn == "recap" and not (outcome == 0).any():
        raise ValueError("no recorded episode failed, so --learn recap has nothing to compare")
    unused = outcome < (0 if config.learn == "recap" else 1)
    helped = np.zeros(len(cache), bool)
    if cache.corrected is not None:
        helped[np.unique(cache.episodes[cache.corrected])] = True
    numbers = (np.flatnonzero(rows).tolist() for rows in (unused & ~helped, unused & helped))
    return Chosen(outcome, demonstrated, *map(tuple, numbers))


def check(chosen: Chosen, tasks: Sequence[str], held_out: Sequence[int], learn: str) -> None:
    """Raise ValueError if nothing good is left to learn from for one of the tasks `[E]`."""
    if learn == "imitation":
        return
    good = {*chosen.successes, *chosen.corrected} - {*held_out}
    for task in dict.fromkeys(tasks):
        if not good & {number for number, name in enumerate(tasks) if name == task}:
            raise ValueError(f"no episode of {task} succeeded, so --learn {learn} cannot learn it")


def describe(chosen: Chosen, cache: Cache, learn: str, console: Console) -> None:
    """Print how many episodes count as what."""
    wins, failures, unknown = ((chosen.outcome == value).sum() for value in (1, 0, -1))
    if not failures:
        return
    text = f"{wins} successes, {failures} failures, {unknown} episodes without an outcome"
    if cache.corrected is not None:
        text += f", {cache.corrected.sum()} corrected steps"
    console.print(text, highlight=False)
    names = [part.name for i, part in enumerate(cache.parts) if _all(chosen, cache, i)]
    if learn == "imitation":
        text = "failures are imitated, too: --learn filtered leaves them out"
        console.print(text, style="yellow", highlight=False)
    elif names:
        console.print(f"demonstrations: {', '.join(names)}", highlight=False, markup=False)


def _all(chosen: Chosen, cache: Cache, index: int) -> bool:
    return bool(chosen.demonstrated[cache.dataset == index].all())


def run_ends(corrected: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return where the run of corrected steps around each step ends, `[N]`; at the latest `end`."""
    breaks = np.append(np.flatnonzero(~corrected), len(corrected))
    following = breaks[np.searchsorted(breaks, np.arange(len(corrected)))]
    return np.minimum(following, end).astype(np.int32)
