"""Run episodes of tasks and count successes."""

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lorasp_jax.base.intervals import wilson_interval
from lorasp_jax.extras.judge.actors import Actor
from lorasp_jax.extras.judge.task import GymTask

Progress = Callable[[str, int, int], None]
"""Called with a task, its finished episodes and their successes."""
FILM_FPS = 10.0
"""Frames per second of films of environments that do not name their rate."""


@dataclass
class EpisodeResult:
    """An episode, as it runs.

    Attributes:
        success: whether the environment has reported success; None: it has not said either.
        steps: environment steps.
        ended: whether it is over.
        keys: keys of `info` that were seen.
        frames: pictures of the first camera at every action, if filmed.
    """

    success: bool | None = None
    steps: int = 0
    ended: bool = False
    keys: set[str] = field(default_factory=set)
    frames: list[np.ndarray] = field(default_factory=list)


def run_episode(
    task: GymTask, env: Any, actor: Actor, seed: int, *, film: bool = False
) -> EpisodeResult:
    """Run one episode.

    Raises:
        ValueError: task, environment and policy do not fit together; see `GymTask`.
    """
    observation, _ = env.reset(seed=seed)
    actor.reset(seed)
    episode = EpisodeResult()
    while not episode.ended:
        images, state = task.images(env, observation), task.read_state(observation)
        chunk = actor.act(images, state, task.instruction)
        if len(chunk) < task.replan:
            raise ValueError(
                f"task {task.name} executes {task.replan} actions of each chunk, but the policy "
                f"predicts {len(chunk)}: lower the task's replan"
            )
        for action in chunk[: task.replan]:
            if film:
                episode.frames.append(next(iter(task.images(env, observation).values())))
            observation = _hold(task, env, action, episode)
            if episode.ended:
                break
    if episode.success is None:
        raise ValueError(
            f"the environment of task {task.name} never reported {task.success!r} in info, which "
            f"had {', '.join(sorted(episode.keys)) or 'no entries'}: set the task's success"
        )
    return episode


def _hold(task: GymTask, env: Any, action: np.ndarray, episode: EpisodeResult) -> Any:
    """Apply an action for `task.hold` environment steps; return the last observation."""
    command, observation = task.command(env, action), None
    for _ in range(task.hold):
        observation, _, terminated, truncated, info = env.step(command)
        episode.steps += 1
        episode.keys |= {str(key) for key in info}
        if task.success in info:
            episode.success = bool(info[task.success])
        is_late = episode.steps >= task.max_steps
        if episode.success or terminated or truncated or is_late:
            episode.ended = True
            break
    return observation


def judge(
    tasks: Sequence[GymTask],
    actor: Actor,
    episodes: int,
    *,
    seed: int = 0,
    films: Path | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Measure success on every task.

    Args:
        tasks: the tasks.
        actor: source of actions.
        episodes: at least 1, episodes per task; they reset with `seed`, `seed` + 1 and so on.
        seed: first seed.
        films: folder for a film of each task's first episode; None: no films.
        progress: called after each episode.

    Returns:
        success rate, 95 % Wilson interval, number of episodes and mean environment steps of all
        ("success", "ci95", "episodes", "steps"), of each of "groups" and of each of "tasks", which
        also have "outcomes" by seed; "steps_per_second" of the environments, policy included.

    Raises:
        ValueError: task, environment and policy do not fit together.
    """
    started = time.perf_counter()
    runs = {
        task.name: judge_task(task, actor, episodes, seed=seed, films=films, progress=progress)
        for task in tasks
    }
    return summarize(tasks, runs, time.perf_counter() - started)


def judge_task(
    task: GymTask,
    actor: Actor,
    episodes: int,
    *,
    seed: int = 0,
    films: Path | None = None,
    progress: Progress | None = None,
) -> list[EpisodeResult]:
    """Run the episodes of one task; arguments and errors are those of `judge`."""
    done = list[EpisodeResult]()
    with contextlib.closing(task.make()) as env:
        for number in range(episodes):
            film = films is not None and number == 0
            done.append(run_episode(task, env, actor, seed + number, film=film))
            if progress:
                progress(task.name, len(done), sum(bool(each.success) for each in done))
        if films is not None:
            write_film(films / f"{task.name}.webp", done[0].frames, _fps(task, env))
    return done


def summarize(
    tasks: Sequence[GymTask], runs: Mapping[str, Sequence[EpisodeResult]], seconds: float
) -> dict[str, Any]:
    """Return what `judge` returns, from the episodes of each task and the time they took."""
    names = dict.fromkeys(task.group for task in tasks if task.group)
    groups = {name: [task.name for task in tasks if task.group == name] for name in names}
    everything = [each for done in runs.values() for each in done]
    return {
        **_rate(everything),
        "seconds": seconds,
        "steps_per_second": sum(each.steps for each in everything) / seconds,
        "groups": {
            name: _rate([each for member in members for each in runs[member]])
            for name, members in groups.items()
        },
        "tasks": {
            name: {**_rate(done), "outcomes": [bool(each.success) for each in done]}
            for name, done in runs.items()
        },
    }


def _rate(episodes: Sequence[EpisodeResult]) -> dict[str, Any]:
    successes = sum(bool(each.success) for each in episodes)
    return {
        "success": successes / len(episodes),
        "episodes": len(episodes),
        "ci95": list(wilson_interval(successes, len(episodes))),
        "steps": sum(each.steps for each in episodes) / len(episodes),
    }


def _fps(task: GymTask, env: Any) -> float:
    rate = (getattr(env, "metadata", None) or {}).get("render_fps")
    return rate / task.hold if rate else FILM_FPS


def write_film(path: Path, frames: Sequence[np.ndarray], fps: float) -> None:
    """Write pictures uint8 `[H, W, 3]` as an animated WebP, which browsers play in a loop."""
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    first, *rest = map(Image.fromarray, frames)
    with path.open("xb") as file:
        more = {"save_all": True, "append_images": rest, "duration": round(1000 / fps), "loop": 0}
        first.save(file, format="webp", **more)
