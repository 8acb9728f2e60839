"""Command line: `python -m envs collect | gallery | play --help`."""

import argparse
import pkgutil
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import jax
import numpy as np
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

import envs
import envs.robots
import envs.tasks
from envs import physics
from envs.episodes import Episodes, replacing

_WORLDS = 4  # tries at once where one episode is wanted: the expert may fail in one
_EVERY, _COLOURS = 2, 256  # of a GIF: control steps to a picture, size of its palette


def main(arguments: Sequence[str]) -> int:
    """Runs one command; returns the exit code: 0 done, 2 bad input, 130 stopped."""
    options = _parser().parse_args(arguments)
    console = Console(stderr=True)
    physics.enable_fast_cpu()  # before anything starts a JAX backend
    physics.enable_compilation_cache()
    try:
        options.command(options, console)
    except (ValueError, OSError) as error:
        console.print(f"error: {error}", style="red", soft_wrap=True, highlight=False)
        return 2
    except KeyboardInterrupt:
        console.print("stopped, nothing was written")
        return 130
    return 0


def collect(options: argparse.Namespace, console: Console) -> None:
    """Writes successful expert episodes to one .npz file."""
    _refuse_existing(options, options.out)
    episodes = _episodes(options, console, options.task, options.robot, options.num_episodes)
    episodes.save(options.out)
    console.print(
        f"{options.out}: {episodes.num_episodes} episodes of {episodes.attempted} tried, "
        f"{episodes.num_steps} steps, {options.out.stat().st_size / 1e6:.0f} MB"
    )


def gallery(options: argparse.Namespace, console: Console) -> None:
    """Writes a GIF of an expert episode, all cameras together, for every task and robot."""
    from PIL import Image

    tasks = [options.task] if options.task else _names(envs.tasks)
    robots = [options.robot] if options.robot else _names(envs.robots)
    for task in tasks:
        for robot in robots:
            file = options.out / f"{task}_{robot}.gif"
            _refuse_existing(options, file)
            episode = _episodes(options, console, task, robot, 1)
            views = _views(episode)[::_EVERY]
            # One palette for all of it: colours do not flicker, and the file is half the size.
            method = Image.Quantize.MAXCOVERAGE  # small things keep their colour
            palette = Image.fromarray(np.concatenate(views)).quantize(_COLOURS, method)
            none = Image.Dither.NONE
            first, *rest = (
                Image.fromarray(v).quantize(palette=palette, dither=none) for v in views
            )
            options.out.mkdir(parents=True, exist_ok=True)
            with replacing(file) as unfinished:
                first.save(
                    unfinished,
                    format="gif",
                    save_all=True,
                    append_images=rest,
                    duration=round(1000 * _EVERY * episode.control_dt),
                    loop=0,
                )
            console.print(str(file))


def play(options: argparse.Namespace, console: Console) -> None:
    """Writes a video of an expert episode, the cameras beside one another."""
    if options.image_size % 2:
        raise ValueError(f"a video needs an even --image-size, not {options.image_size}")
    _refuse_existing(options, options.out)
    episode = _episodes(options, console, options.task, options.robot, 1)
    views = _views(episode)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with replacing(options.out) as unfinished:
        _write_video(unfinished, views, round(1 / episode.control_dt))
    text = episode.instructions[int(episode.instruction[0])]
    console.print(f"{options.out}: {len(views)} steps, {text!r}")


def _views(episode: Episodes) -> np.ndarray:
    """The first episode as seen by all cameras beside one another, uint8 [T, H, K W, 3]."""
    steps = int(episode.length[0])
    return np.concatenate([np.asarray(p[0, :steps]) for p in episode.image.values()], axis=2)


def _write_video(path: Path, frames: np.ndarray, rate: int) -> None:
    """H.264 in MP4 from uint8 `[T, H, W, 3]` frames, `rate` a second."""
    import av

    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("h264", rate=rate)
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def _episodes(
    options: argparse.Namespace, console: Console, task: str, robot: str, number: int
) -> envs.Episodes:
    """Expert episodes with a progress bar."""
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task(f"{task}, {robot}: compiling ...", total=number, rate="")

        def report(done: int, total: int) -> None:
            if done:
                rate = f"{done / (progress.tasks[bar].elapsed or 1):.1f} episodes/s"
                text = f"{task}, {robot}: collecting"
                progress.update(bar, completed=done, total=total, description=text, rate=rate)

        return envs.collect(
            task,
            robot=robot,
            num_episodes=number,
            key=jax.random.key(options.seed),
            image_size=options.image_size,
            num_envs=options.num_envs,
            action_noise=options.action_noise,
            antialias=options.antialias,
            progress=report,
        )


def _names(package: ModuleType) -> list[str]:
    return sorted(module.name for module in pkgutil.iter_modules(package.__path__))


def _refuse_existing(options: argparse.Namespace, *files: Path) -> None:
    for file in files:
        if file.exists() and not options.overwrite:
            raise ValueError(f"{file} exists already: choose another --out or add --overwrite")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m envs", description="Scripted expert episodes.")
    commands = parser.add_subparsers(required=True, metavar="command")
    for command, size in ((collect, 64), (gallery, 128), (play, 256)):
        sub = commands.add_parser(
            command.__name__, help=command.__doc__, description=command.__doc__
        )
        sub.set_defaults(command=command, num_envs=_WORLDS, action_noise=0.0, antialias=2)
        one = command is not gallery
        every = "" if one else " (default: all)"
        sub.add_argument("--task", required=one, help=", ".join(_names(envs.tasks)) + every)
        sub.add_argument("--robot", required=one, help=", ".join(_names(envs.robots)) + every)
        sub.add_argument("--out", required=True, type=Path, help="file, for gallery a folder")
        sub.add_argument("--overwrite", action="store_true", help="replace what is there")
        sub.add_argument("--image-size", type=int, default=size, help="pixels (%(default)s)")
        sub.add_argument("--seed", type=int, default=0, help="of all randomness (%(default)s)")
        if command is collect:
            sub.add_argument("--num-episodes", type=int, default=64, help="(%(default)s)")
            sub.add_argument("--num-envs", type=int, default=None, help="worlds at once")
            sub.add_argument("--antialias", type=int, default=1, help="rays a pixel, squared")
            sub.add_argument("--action-noise", type=float, default=0.0, help="rad (%(default)s)")
    return parser


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
