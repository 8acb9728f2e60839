"""Learn from recordings with outcomes: which of their episodes and steps count.

A dataset without failures or corrections holds demonstrations, also one without labels, but not one
whose labels all say unknown. Of an episode that does not count, corrected steps still do.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rich.console import Console

from lorasp_jax.config import Config
from lorasp_jax.data.cache import UNLABELLED, Cache


@dataclass(frozen=True)
class Chosen:
    """What is learned from E episodes.

    Attributes:
        outcome: int `[E]`, 1 success, 0 failure, -1 unknown; demonstrations succeeded.
        demonstrated: bool `[E]`, episodes of demonstrations.
        helped: bool `[E]`, episodes with corrected steps.
        left_out: numbers of the episodes that do not count.
        corrected: numbers of those of which only corrected steps count.
    """

    outcome: np.ndarray
    demonstrated: np.ndarray
    helped: np.ndarray
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
    said = np.full(len(cache), UNLABELLED) if cache.success is None else np.array(cache.success)
    demonstrated, helped = np.zeros((2, len(cache)), bool)
    if cache.corrected is not None:
        helped[cache.episodes[cache.corrected]] = True
    for index in range(len(cache.parts)):
        rows = cache.dataset == index
        policy = (said[rows] == 0).any() or helped[rows].any()
        demonstrated[rows] = not policy and said[rows] != -1
    outcome = np.maximum(said, -1)
    if config.learn == "imitation":
        return Chosen(outcome, demonstrated, helped)
    if (said < 0).all() and not (config.learn == "filtered" and helped.any()):
        raise ValueError(
            f"{' '.join(config.data.source)} does not say which episodes succeeded, as --learn "
            f"{config.learn} needs: see docs/datasets.md"
        )
    outcome[demonstrated] = 1
    if config.learn == "recap" and not (outcome == 0).any():
        raise ValueError("no recorded episode failed, so --learn recap has nothing to compare")
    unused = outcome < (0 if config.learn == "recap" else 1)
    numbers = (np.flatnonzero(rows).tolist() for rows in (unused & ~helped, unused & helped))
    return Chosen(outcome, demonstrated, helped, *map(tuple, numbers))


def check(chosen: Chosen, cache: Cache, held_out: Sequence[int], learn: str) -> None:
    """Raise ValueError if nothing good is left to learn from for a task, or for its instructions.

    Different datasets may call the same task differently.
    """
    if learn == "imitation":
        return
    good = (chosen.outcome == 1) | chosen.helped
    good[[*held_out]] = False
    tasks, phrases = cache.tasks, cache.phrases
    for task in cache.metadata["tasks"]:
        if not good[(tasks == task) | np.isin(phrases, phrases[tasks == task])].any():
            raise ValueError(f"no episode of {task} succeeded, so --learn {learn} cannot learn it")


def describe(
    chosen: Chosen, cache: Cache, held_out: Sequence[int], learn: str, console: Console
) -> None:
    """Print how many episodes count as what; warn if those of one side all failed."""
    wins, failures, unknown = ((chosen.outcome == value).sum() for value in (1, 0, -1))
    if not (failures or chosen.left_out or chosen.corrected):
        return
    text = f"{wins} successes, {failures} failures, {unknown} episodes without an outcome"
    if cache.corrected is not None:
        text += f", {cache.corrected.sum()} corrected steps"
    console.print(text, highlight=False)
    shown = {*cache.dataset[chosen.demonstrated].tolist()}
    names = [part.name for index, part in enumerate(cache.parts) if index in shown]
    if learn == "imitation":
        text = "failures are imitated, too: --learn filtered leaves them out"
        console.print(text, style="yellow", highlight=False)
        if doubt := _only_failures(chosen, held_out):
            console.print(f"warning: {doubt}", style="yellow", highlight=False, soft_wrap=True)
    elif names:
        console.print(f"demonstrations: {', '.join(names)}", highlight=False, markup=False)


def _only_failures(chosen: Chosen, held_out: Sequence[int]) -> str:
    """Say whether all episodes that are held out, or all others, failed; "" if not."""
    failed = chosen.outcome == 0
    if np.delete(failed, [*held_out]).all():
        return "all episodes to learn from failed: record successes, or hold out other episodes"
    if held_out and failed[[*held_out]].all():
        return (
            "all held-out episodes failed, so the adapters that best imitate failures count as the "
            "best: name others with --data.validation"
        )
    return ""


def run_ends(corrected: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return where the run of corrected steps around each step ends, `[N]`; at the latest `end`."""
    breaks = np.append(np.flatnonzero(~corrected), len(corrected))
    following = breaks[np.searchsorted(breaks, np.arange(len(corrected)))]
    return np.minimum(following, end).astype(np.int32)
