"""Demonstrations of a run: collected once by the scripted expert, then read from a cache."""

import functools
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax

import envs
from envs.datasets.episodes import Episodes
from lorasp_jax.config import Config
from lorasp_jax.training.random_streams import RandomStream

Demonstrations = dict[str, Episodes]
"""Episodes by task."""
Progress = Callable[[str, int, int], None]
"""Called with the task, the number of collected episodes and the total."""


def demonstrations(config: Config, folder: Path, progress: Progress) -> Demonstrations:
    """Load the episodes of every task from `folder`/cache, or collect and cache them there."""
    paths = _paths(config, folder)
    load = functools.partial(_load_or_collect, config, progress=progress)
    episodes = map_threads(load, paths, config.tasks, _keys(config))
    return dict(zip(config.tasks, episodes, strict=True))


def are_cached(config: Config, folder: Path) -> bool:
    """Say whether `demonstrations` would collect nothing."""
    return all(path.exists() for path in _paths(config, folder))


def _paths(config: Config, folder: Path) -> list[Path]:
    return [folder / "cache" / f"{task}.npz" for task in config.tasks]


def fresh_demonstrations(config: Config, generation: int) -> Demonstrations:
    """Collect new episodes of every task for one generation (1, 2, ...), without caching them."""
    keys = jax.vmap(lambda key: jax.random.fold_in(key, generation))(_keys(config))
    collect = functools.partial(_collect, config)
    return dict(zip(config.tasks, map_threads(collect, config.tasks, keys), strict=True))


def _keys(config: Config) -> jax.Array:
    return jax.random.split(RandomStream.DEMONSTRATIONS.key(config.seed), len(config.tasks))


def map_threads(function: Callable, *arguments: Iterable[Any]) -> list[Any]:
    """Map in threads, to compile in parallel; an interrupt does not wait for the threads."""
    pool = ThreadPoolExecutor()
    try:
        return list(pool.map(function, *arguments))
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def in_thread(function: Callable, *arguments: Any) -> Future[Any]:
    """Call `function` in a new thread and return its future."""
    pool = ThreadPoolExecutor(1)
    future = pool.submit(function, *arguments)
    pool.shutdown(wait=False)
    return future


def _load_or_collect(
    config: Config, path: Path, task: str, key: jax.Array, *, progress: Progress
) -> Episodes:
    if path.exists():
        return Episodes.load(path, control_dt=config.control_dt)
    report = lambda done, total: progress(task, done, total)  # noqa: E731
    episodes = _collect(config, task, key, report)
    path.parent.mkdir(parents=True, exist_ok=True)
    episodes.save(path)
    return episodes


def _collect(
    config: Config, task: str, key: jax.Array, progress: Callable[[int, int], None] | None = None
) -> Episodes:
    return envs.collect(
        task,
        robot=config.robot,
        num_episodes=config.data.episodes,
        key=key,
        image_size=config.image_size,
        control_dt=config.control_dt,
        num_envs=config.data.num_envs,
        action_noise=config.data.action_noise,
        ranges=config.ranges,
        progress=progress,
    )
