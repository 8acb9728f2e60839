"""The commands of `python -m envs`; each takes parsed options and a console for output."""

import argparse
import contextlib
import threading
from collections.abc import Mapping
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
from rich.console import Console

import envs
from envs import traced
from envs.datasets import rlds
from envs.datasets.episodes import Episodes
from envs.experts import collection
from envs.names import names
from envs.rendering import video
from lorasp_jax.base import writing
from lorasp_jax.base.bars import Report, bars, collecting
from lorasp_jax.base.files import check_local
from lorasp_jax.base.locks import locked

WORLDS = 4
"""Number of parallel attempts in `play`, which shows one success; the expert may fail."""
_EVERY = 2  # control steps per frame of a GIF


def collect(options: argparse.Namespace, console: Console) -> None:
    """Collect successful expert episodes, one RLDS dataset per task; run again to resume."""
    tasks = names("task") if options.task == ["all"] else list(dict.fromkeys(options.task))
    out: Path = options.out
    files = [out / task for task in tasks] if len(tasks) > 1 else [out]
    scenes = [_env(options, task) for task in tasks]  # fail early on bad input
    with contextlib.ExitStack() as locks:
        for file in files:
            locks.enter_context(locked(file))
        todo = {f: e for f, e in zip(files, scenes, strict=True) if not _is_done(options, e, f)}
        try:
            summaries = _collect_concurrently(options, todo, console)
        except KeyboardInterrupt:
            saved = [_progress(f, options.num_episodes) for f in todo if _partial(f).exists()]
            raise KeyboardInterrupt("; ".join(saved)) from None
    for file in files:
        summary = f": {summaries[file]}" if file in summaries else " is already complete"
        console.print(f"{file}{summary}", soft_wrap=True)


def gallery(options: argparse.Namespace, console: Console) -> None:
    """Write a GIF of an expert episode, cameras side by side, for every task and robot."""
    tasks = [options.task] if options.task else names("task")
    robots = [options.robot] if options.robot else names("robot")
    for task in tasks:
        for robot in robots:
            file = options.out / f"{task}_{Path(robot).stem}.gif"
            _refuse_existing(file)
            episode = _episode(options, console, task, robot)
            views = _views(episode)[::_EVERY]
            options.out.mkdir(parents=True, exist_ok=True)
            with writing.atomic_file(file) as temporary:
                video.write_gif(temporary, views, _EVERY * episode.control_dt)
            console.print(str(file))


def play(options: argparse.Namespace, console: Console) -> None:
    """Show an expert episode in a window, or write a video of it, cameras side by side."""
    if options.out is None:
        from envs.cli import viewer  # opens a connection to the display

        viewer.check_display()
        env = envs.make(options.task, options.robot, num_envs=WORLDS)
        with console.status("simulating an episode ..."):
            scene, positions = viewer.episode(env, jax.random.key(options.seed))
        viewer.show(scene, positions, env.control_dt)
        return
    if options.image_size % 2:
        raise ValueError(f"--image-size of a video must be even, got {options.image_size}")
    _refuse_existing(options.out)
    episode = _episode(options, console, options.task, options.robot)
    views = _views(episode)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with writing.atomic_file(options.out) as temporary:
        video.write_video(temporary, views, fps=1 / episode.control_dt)
    console.print(f"{options.out}: {len(views)} steps, {episode.phrases[0]!r}")


def _env(options: argparse.Namespace, task: str) -> envs.Env:
    env = collection.make_repeatable(
        task,
        options.robot,
        num_envs=collection.worlds(options.num_episodes, options.num_envs),
        image_size=options.image_size,
        antialias=options.antialias,
        control_dt=options.control_dt,
        actions=options.actions,
        distractors=options.distractors,
    )
    if ranges := _ranges(options):
        ranges.check(env.control_dt)
    return env


def _is_done(options: argparse.Namespace, env: envs.Env, file: Path) -> bool:
    """Return whether the same command has already completed this dataset.

    Raises:
        ValueError: another file or dataset exists.
    """
    if not file.exists():
        return False
    if rlds.metadata(file)["options"] != _recipe(options, env):  # raises for other folders
        _refuse_existing(file)
    return True


def _collect_concurrently(
    options: argparse.Namespace, scenes: Mapping[Path, envs.Env], console: Console
) -> dict[Path, str]:
    """Collect all tasks concurrently, since compilation dominates; return their summaries.

    Raises:
        KeyboardInterrupt: after Ctrl-C, once the current shards are complete.
    """
    stop = threading.Event()
    running: dict[Path, Future[str]] = {}
    with bars(console, "episodes") as progress, ThreadPoolExecutor() as pool:
        try:
            # Start the longest task first: it runs while the others are still being traced.
            for file, env in sorted(scenes.items(), key=lambda item: -item[1].expert_steps):
                report = collecting(progress, f"{env.task.name}, {env.robot.name}", stop)
                running[file] = pool.submit(_collect, options, env, file, report)
            wait(running.values(), return_when=FIRST_EXCEPTION)
        finally:
            stop.set()
    errors = [future.exception() for future in running.values()]
    # An error stops the other tasks with KeyboardInterrupt: raise the error, not the interrupts.
    for error in sorted(filter(None, errors), key=lambda e: isinstance(e, KeyboardInterrupt)):
        raise error
    return {file: future.result() for file, future in running.items()}


def _collect(options: argparse.Namespace, env: envs.Env, out: Path, report: Report) -> str:
    """Collect the episodes of one task, resuming an interrupted call; return a summary."""
    writer = rlds.ShardWriter(_partial(out), _recipe(options, env))
    report(writer.num_episodes, options.num_episodes)
    for shard in collection.gather(
        env,
        options.num_episodes,
        jax.random.key(options.seed),
        options.action_noise,
        _ranges(options),
        collected=writer.num_episodes,
        attempted=writer.attempted,
    ):
        writer.append(shard)
        report(writer.num_episodes, options.num_episodes)
    writer.complete()
    size = sum(file.stat().st_size for file in writer.folder.iterdir())
    writing.rename(writer.folder, out)
    return (
        f"{writer.num_episodes} of {writer.attempted} attempted episodes, "
        f"{writer.metadata['steps']} steps, {size / 1e6:.0f} MB"
    )


def _partial(out: Path) -> Path:
    """Return the folder that holds the shards of an incomplete dataset."""
    return out.with_name(f"{out.name}.partial")


def _progress(out: Path, num_episodes: int) -> str:
    folder = _partial(out)
    done = sum(rlds.metadata(folder)["parts"])
    return f"{done} of {num_episodes} episodes are in {folder}; run the same command to resume"


def _episode(options: argparse.Namespace, console: Console, task: str, robot: str) -> Episodes:
    """Collect one successful episode of the expert."""
    with bars(console, "episodes") as progress:
        return envs.collect(
            task,
            robot,
            num_episodes=1,
            key=jax.random.key(options.seed),
            image_size=options.image_size,
            num_envs=1,  # rendering dominates; a failed attempt is repeated
            antialias=2,
            progress=collecting(progress, f"{task}, {robot}", threading.Event()),
        )


def _views(episode: Episodes) -> np.ndarray:
    """Return the first episode's images from K cameras side by side, uint8 [T, H, K W, 3]."""
    steps = int(episode.length[0])
    return video.side_by_side({k: np.asarray(x[0, :steps]) for k, x in episode.image.items()})


def _refuse_existing(file: Path) -> None:
    check_local(file)
    if file.exists():
        raise ValueError(f"{file} already exists: choose another --out")


def _recipe(options: argparse.Namespace, env: envs.Env) -> dict[str, Any]:
    """Return everything that the episodes depend on, as JSON values."""
    ranges = _ranges(options)
    return {
        "task": env.task.name,
        "robot": options.robot,
        "model": traced.digest(env),  # changes if the user edits the robot's file
        "num_episodes": options.num_episodes,
        "num_envs": env.num_envs,
        "image_size": env.image_size,
        "antialias": env.antialias,
        "control_dt": env.control_dt,
        "actions": env.actions,
        "distractors": env.distractors,
        "action_noise": options.action_noise,
        "randomize": ranges and {name: [*each] for name, each in vars(ranges).items()},
        "seed": options.seed,
        "physics": env.physics.backend,
        "device": jax.default_backend(),
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
    }


def _ranges(options: argparse.Namespace) -> envs.Randomization | None:
    """Return the ranges of domain randomization, if any."""
    return envs.Randomization.typical() if options.randomize else None
