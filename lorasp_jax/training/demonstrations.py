"""Demonstrations of a run: collected once by the scripted expert, then read from its cache."""

import functools
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax

import envs
from envs.datasets.episodes import Episodes
from lorasp_jax.config import Config
from lorasp_jax.training.random_streams import RandomStream

Progress = Callable[[str, int, int], None]
"""Called with task, episodes done and episodes wanted."""


def demonstrations(config: Config, folder: Path, progress: Progress) -> dict[str, Episodes]:
    """Episodes of every task of `config`, from `folder`/cache where they are already there."""
    paths = [folder / "cache" / f"{task}.npz" for task in config.tasks]
    one = functools.partial(_task_demonstrations, config, progress=progress)
    return dict(
        zip(config.tasks, side_by_side(one, paths, config.tasks, _keys(config)), strict=True)
    )


def fresh_demonstrations(config: Config, generation: int) -> dict[str, Episodes]:
    """Other episodes of every task for each generation, 1 and on, which no file ever holds."""
    keys = jax.vmap(lambda key: jax.random.fold_in(key, generation))(_keys(config))
    one = functools.partial(_collected, config)
    return dict(zip(config.tasks, side_by_side(one, config.tasks, keys), strict=True))


def _keys(config: Config) -> jax.Array:
    """One for each task."""
    return jax.random.split(RandomStream.DEMONSTRATIONS.key(config.seed), len(config.tasks))


def side_by_side(function: Callable, *arguments: Iterable[Any]) -> list[Any]:
    """`map` in threads, because compilation is most of the time; an interrupt does not wait."""
    pool = ThreadPoolExecutor()
    try:
        return list(pool.map(function, *arguments))
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _task_demonstrations(
    config: Config, path: Path, task: str, key: jax.Array, *, progress: Progress
) -> Episodes:
    """Episodes of one task."""
    if path.exists():
        return Episodes.load(path, control_dt=config.control_dt)
    told = lambda done, total: progress(task, done, total)  # noqa: E731
    episodes = _collected(config, task, key, told)
    path.parent.mkdir(parents=True, exist_ok=True)
    episodes.save(path)
    return episodes


def _collected(
    config: Config, task: str, key: jax.Array, progress: Callable[[int, int], None] | None = None
) -> Episodes:
    """Episodes of one task from the expert."""
    return envs.collect(
        task,
        robot=config.robot,
        num_episodes=config.data.episodes,
        key=key,
        image_size=config.image_size,
        control_dt=config.control_dt,
        num_envs=config.data.num_envs,
        action_noise=config.data.action_noise,
        progress=progress,
    )
