"""The commands of `python -m envs`: each gets the parsed options and a console to report to."""

import argparse
import contextlib
import shutil
import threading
from collections.abc import Mapping
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

import envs
from envs.cli import recipes
from envs.cli.bars import Report, bars, collecting
from envs.datasets import rlds, writing
from envs.datasets.episodes import Episodes
from envs.datasets.files import check_local
from envs.datasets.locks import locked
from envs.experts import collection
from envs.names import names
from envs.rendering import video

WORLDS = 4
"""Tries at once for a window, which draws but one: the expert may fail in one."""
_EVERY = 2  # control steps to a picture of a GIF


def collect(options: argparse.Namespace, console: Console) -> None:
    """Writes successful expert episodes, an RLDS dataset for every task; continues if stopped."""
    tasks = names("task") if options.task == ["all"] else list(dict.fromkeys(options.task))
    out: Path = options.out
    if len(tasks) > 1 and out.suffix == ".npz":
        raise ValueError(f"{out} can hold one task, not {len(tasks)}: give a folder as --out")
    files = [out / task for task in tasks] if len(tasks) > 1 else [out]
    scenes = [_scene(options, task) for task in tasks]  # bad input shows before any work
    with contextlib.ExitStack() as locks:
        for file in files:
            locks.enter_context(locked(file))
            writing.recover_folder(file)
        left = {f: e for f, e in zip(files, scenes, strict=True) if not _is_done(options, e, f)}
        try:
            found = _side_by_side(options, left, console)
        except KeyboardInterrupt:
            kept = [_kept(f, options.num_episodes) for f in left if _unfinished(f).exists()]
            raise KeyboardInterrupt("; ".join(kept)) from None
    for file in files:
        if file in found:
            console.print(f"{file}: {found[file]}", soft_wrap=True)
        else:
            console.print(f"{file} is there already", soft_wrap=True)


def gallery(options: argparse.Namespace, console: Console) -> None:
    """Writes a GIF of an expert episode, all cameras together, for every task and robot."""
    tasks = [options.task] if options.task else names("task")
    robots = [options.robot] if options.robot else names("robot")
    for task in tasks:
        for robot in robots:
            file = options.out / f"{task}_{Path(robot).stem}.gif"
            _refuse_existing(options, file)
            episode = _episode(options, console, task, robot)
            views = _views(episode)[::_EVERY]
            options.out.mkdir(parents=True, exist_ok=True)
            with writing.atomic_file(file) as unfinished:
                video.write_gif(unfinished, views, _EVERY * episode.control_dt)
            console.print(str(file))


def play(options: argparse.Namespace, console: Console) -> None:
    """Shows an expert episode in a window, or writes a video of it, all cameras together."""
    if options.out is None:
        from envs.cli import viewer  # opens a connection to the display

        viewer.check_display()
        env = envs.make(options.task, options.robot, num_envs=WORLDS)
        with console.status("simulating an episode ..."):
            scene, positions = viewer.episode(env, jax.random.key(options.seed))
        viewer.show(scene, positions, env.control_dt)
        return
    if options.image_size % 2:
        raise ValueError(f"a video needs an even --image-size, not {options.image_size}")
    _refuse_existing(options, options.out)
    episode = _episode(options, console, options.task, options.robot)
    views = _views(episode)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with writing.atomic_file(options.out) as unfinished:
        video.write_video(unfinished, views, fps=1 / episode.control_dt)
    text = episode.instructions[int(episode.instruction[0])]
    console.print(f"{options.out}: {len(views)} steps, {text!r}")


def _scene(options: argparse.Namespace, task: str) -> envs.Env:
    """The worlds to collect in."""
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
    if ranges := recipes.ranges(options):
        ranges.check(env.control_dt)
    return env


def _is_done(options: argparse.Namespace, env: envs.Env, file: Path) -> bool:
    """Whether the same command has made this dataset before.

    Raises:
        ValueError: if something else stands there that must not be replaced.
    """
    if not file.exists():
        return False
    recipe, left = recipes.recipe(options, env), _unfinished(file)
    if file.suffix != ".npz":
        made = rlds.metadata(file)["options"]  # nothing but a dataset is ever replaced
        if made == recipe and not options.overwrite:
            return True
    elif left.exists() and _is_complete(rlds.metadata(left), recipe):
        return False  # perhaps killed when all but these parts was in order: `_save` finds out
    _refuse_existing(options, file)
    return False


def _is_complete(facts: Mapping[str, Any], recipe: Mapping[str, Any]) -> bool:
    """Whether parts with these facts are all that was asked for."""
    return facts["options"] == recipe and sum(facts["parts"]) == recipe["num_episodes"]


def _side_by_side(
    options: argparse.Namespace, scenes: Mapping[Path, envs.Env], console: Console
) -> dict[Path, str]:
    """Collects all tasks at once, because compilation is most of the time; returns what was made.

    Raises:
        KeyboardInterrupt: after Ctrl-C, once the parts under way are finished.
    """
    stop = threading.Event()
    running: dict[Path, Future[str]] = {}
    with bars(console, "episodes") as progress, ThreadPoolExecutor() as pool:
        try:
            # The longest first: it runs while the others are still traced.
            for file, env in sorted(scenes.items(), key=lambda item: -item[1].expert_steps):
                report = collecting(progress, f"{env.task.name}, {env.robot.name}", stop)
                running[file] = pool.submit(_collect, options, env, file, report)
            wait(running.values(), return_when=FIRST_EXCEPTION)
        finally:
            stop.set()
    errors = [future.exception() for future in running.values()]
    # Where one failed, the others were stopped.
    for error in sorted(filter(None, errors), key=lambda e: isinstance(e, KeyboardInterrupt)):
        raise error
    return {file: future.result() for file, future in running.items()}


def _collect(options: argparse.Namespace, env: envs.Env, out: Path, report: Report) -> str:
    """Collects one task, from where an earlier call was stopped; returns what was made."""
    parts = rlds.ShardWriter(_unfinished(out), recipes.recipe(options, env))
    report(parts.num_episodes, options.num_episodes)
    for part in collection.gather(
        env,
        options.num_episodes,
        jax.random.key(options.seed),
        options.action_noise,
        recipes.ranges(options),
        kept=parts.num_episodes,
        attempted=parts.attempted,
        record=options.record,
    ):
        parts.append(part)
        report(parts.num_episodes, options.num_episodes)
    parts.complete()
    size = sum(file.stat().st_size for file in parts.folder.iterdir())
    if out.suffix == ".npz":
        _save(options, parts.folder, out)
        size = out.stat().st_size
    else:
        writing.replace_folder(parts.folder, out, rlds.metadata)  # raises for all but datasets
    return (
        f"{parts.num_episodes} of {parts.attempted} attempted episodes, "
        f"{parts.metadata['steps']} steps, {size / 1e6:.0f} MB"
    )


def _save(options: argparse.Namespace, folder: Path, out: Path) -> None:
    """Makes one file of a dataset, which it deletes; an earlier call may have been killed between.

    Raises:
        ValueError: if another file stands there that must not be replaced.
    """
    episodes = rlds.read(folder)
    if options.overwrite or not (out.exists() and _are_same(episodes, Episodes.load(out))):
        _refuse_existing(options, out)
        episodes.save(out)
    shutil.rmtree(folder)


def _are_same(one: Episodes, other: Episodes) -> bool:
    """Whether arrays and facts agree."""
    trees = [jax.tree.flatten(episodes) for episodes in (one, other)]
    (leaves, facts), (other_leaves, other_facts) = trees
    return facts == other_facts and all(map(np.array_equal, leaves, other_leaves))


def _unfinished(out: Path) -> Path:
    """Where the finished parts of a dataset are until all are there."""
    return out.with_name(f"{out.name}.partial")


def _kept(out: Path, num_episodes: int) -> str:
    """What a stopped collection has left."""
    folder = _unfinished(out)
    kept = sum(rlds.metadata(folder)["parts"])
    return f"{kept} of {num_episodes} episodes are kept in {folder}, the same command goes on there"


def _episode(options: argparse.Namespace, console: Console, task: str, robot: str) -> Episodes:
    """One episode of the expert."""
    with bars(console, "episodes") as progress:
        return envs.collect(
            task,
            robot,
            num_episodes=1,
            key=jax.random.key(options.seed),
            image_size=options.image_size,
            num_envs=1,  # pictures are most of the work; where the expert fails, it tries again
            antialias=2,
            progress=collecting(progress, f"{task}, {robot}", threading.Event()),
        )


def _views(episode: Episodes) -> np.ndarray:
    """The first episode as seen by all cameras beside one another, uint8 [T, H, K W, 3]."""
    steps = int(episode.length[0])
    return video.side_by_side({k: np.asarray(p[0, :steps]) for k, p in episode.image.items()})


def _refuse_existing(options: argparse.Namespace, file: Path) -> None:
    check_local(file)
    if file.exists() and not options.overwrite:
        raise ValueError(f"{file} already exists: choose another --out or add --overwrite")
