"""Hold episodes of a dataset out of training."""

import re
from collections.abc import Sequence

import numpy as np

SHARE, MINIMUM = 0.1, 10
"""Share of a user's recordings that is held out by default, if they have this many episodes."""
_EPISODE = re.compile(r"episode_(\d+)")


def held_out(
    choice: Sequence[str],
    tasks: Sequence[str],
    phrases: Sequence[str] = (),
    *,
    recorded: bool,
    among: Sequence[int] | None = None,
) -> list[int]:
    """Return the numbers of the episodes to hold out, in ascending order.

    A share or a number of episodes is spread over the tasks, within a task over its instructions,
    and then over the time in which the episodes were recorded. Every task keeps an episode to learn
    from, and every instruction does if those of its task have enough others for the share.

    Args:
        choice: `DataConfig.validation`.
        tasks: the task of each episode.
        phrases: the instruction of each episode; empty: one for each task.
        recorded: whether the episodes were recorded rather than simulated, see "auto".
        among: numbers of the episodes of which a share is taken; None: all.

    Raises:
        ValueError: the choice is none of what `DataConfig.validation` describes, names an episode
            that does not exist, or leaves none to learn from.
    """
    named = [_EPISODE.fullmatch(name) for name in choice if not _is_number(name)]
    if named and [*choice] != ["auto"]:
        return _named(choice, named, tasks)
    numbers = [*range(len(tasks))] if among is None else [*among]
    phrases = [(phrases or tasks)[number] for number in numbers]
    tasks = [tasks[number] for number in numbers]
    if [*choice] == ["auto"]:
        choice = [str(SHARE if recorded and len(tasks) >= MINIMUM else 0)]
    if len(choice) != 1:
        raise ValueError(f"data.validation must be one number or episodes' names, got {choice}")
    number = float(choice[0])
    count = round(number if number >= 1 else max(number * len(tasks), number > 0))
    if number < 0 or (number % 1 and number > 1) or 0 < count >= len(tasks):
        raise ValueError(
            f"data.validation must leave some of the {len(tasks)} episodes that "
            f"{'there are' if among is None else 'succeeded'}: a share below 1 or a number, got "
            f"{choice[0]}"
        )
    chosen = _spread(count, tasks, phrases)
    if count and not chosen:
        raise ValueError("data.validation can hold out nothing: every task has few episodes")
    return [numbers[index] for index in chosen]


def _is_number(text: str) -> bool:
    try:
        return np.isfinite(float(text))
    except ValueError:
        return False


def _named(
    choice: Sequence[str], found: Sequence[re.Match[str] | None], tasks: Sequence[str]
) -> list[int]:
    """Return the numbers in names such as episode_000012, as LeRobot names its files."""
    numbers = sorted({int(match[1]) for match in found if match})
    valid = f"episode_0 to episode_{len(tasks) - 1}"
    if None in found or len(found) < len(choice) or numbers[-1] >= len(tasks):
        raise ValueError(
            f"data.validation must be a share, a number of episodes, or names from {valid}, got "
            f"{' '.join(choice)}"
        )
    if left := set(tasks) - {t for number, t in enumerate(tasks) if number not in numbers}:
        raise ValueError(f"data.validation leaves no episode of {sorted(left)[0]!r} to learn from")
    return numbers


def _spread(count: int, tasks: Sequence[str], phrases: Sequence[str]) -> list[int]:
    """Choose `count` episodes, evenly over tasks, instructions and the episodes of each."""
    chosen: list[int] = []
    before = 0
    for task in dict.fromkeys(tasks):
        episodes = [number for number, name in enumerate(tasks) if name == task]
        first, before = round(count * before / len(tasks)), before + len(episodes)
        share = min(round(count * before / len(tasks)) - first, len(episodes) - 1)
        candidates = _by_phrase(episodes, phrases, share)
        chosen += [candidates[int((i + 0.5) * len(candidates) / share)] for i in range(share)]
    return sorted(chosen)


def _by_phrase(episodes: list[int], phrases: Sequence[str], share: int) -> list[int]:
    """Order the episodes of a task by instruction; leave one of each out if `share` remain."""
    groups: dict[str, list[int]] = {}
    for number in episodes:
        groups.setdefault(phrases[number], []).append(number)
    if len(groups) == 1:
        return episodes
    rest = [number for group in groups.values() for number in group[:-1]]
    return rest if len(rest) >= share else [n for group in groups.values() for n in group]
