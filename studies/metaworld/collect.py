"""Record Meta-World's scripted experts as a LeRobot dataset: `--help` says how.

    MUJOCO_GL=egl python -m studies.metaworld.collect data/mt50 --episodes 50

Runs where metaworld is installed, and needs nothing of lorasp_jax but NumPy and lazy_loader.
"""

import argparse
import functools
import multiprocessing
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

from studies.metaworld.tasks import INSTALL, INSTRUCTIONS, SETS

try:
    from studies.metaworld import dataset
    from studies.metaworld.expert import demonstrate
    from studies.metaworld.world import IMAGE_SIZE, World
except ModuleNotFoundError as error:
    raise SystemExit(f"error: {error.name} is missing: {INSTALL}") from error

FIRST_SEED = 1_000_000
"""Seeds of demonstrations start here; those of the judge start at 0."""
MAX_ATTEMPTS = 10
"""Attempts per demonstration after which a task is given up."""


def record(name: str, episodes: int) -> tuple[str, list[dataset.Recorded], int, int]:
    """Return a task's name, its successful episodes, the attempts and the environment steps."""
    warnings.filterwarnings("ignore", "Constant")  # experts' own remark that actions are clipped
    world, recorded, steps, attempts = World(name), [], 0, 0
    while len(recorded) < episodes:
        if attempts == MAX_ATTEMPTS * episodes:
            raise ValueError(f"the expert of {name} solved {len(recorded)} of {attempts} layouts")
        shown = demonstrate(world, name, FIRST_SEED + attempts)
        attempts, steps = attempts + 1, steps + shown.steps
        if shown.success:
            pictures = [dataset.png(picture) for picture in shown.pictures]
            recorded.append((pictures, shown.state, shown.action))
    world.close()
    return name, recorded, attempts, steps


def main(arguments: Sequence[str]) -> int:
    """Record the tasks; return the exit code."""
    options = _parser().parse_args(arguments)
    started = time.perf_counter()
    try:
        writer = dataset.Writer(options.out, IMAGE_SIZE)
    except FileExistsError:
        print(f"error: {options.out} exists: choose another folder", file=sys.stderr)
        return 2
    context = multiprocessing.get_context("spawn")
    with context.Pool(options.processes) as pool:
        work = functools.partial(record, episodes=options.episodes)
        for name, recorded, attempts, steps in pool.imap(work, options.tasks or SETS[options.set]):
            writer.add_task(INSTRUCTIONS[name], recorded)
            frames = sum(len(pictures) for pictures, *_ in recorded)
            print(
                f"{name}: {len(recorded)} of {attempts} succeed, {frames} pictures, {steps} steps"
            )
    writer.close()
    print(f"written: {options.out} in {time.perf_counter() - started:.0f} s")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m studies.metaworld.collect")
    add = parser.add_argument
    add("out", type=Path, help="folder to create")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--tasks", nargs="+", choices=INSTRUCTIONS, metavar="TASK")
    text = "all fifty tasks, the 45 or the 5 of ML45, or a smaller set (default: %(default)s)"
    which.add_argument("--set", choices=SETS, default="mt50", help=text)
    add("--episodes", type=int, default=50, metavar="N", help="successful episodes per task")
    add("--processes", type=int, default=2, metavar="N")
    return parser


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
