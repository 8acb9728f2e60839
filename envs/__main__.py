"""Command line: `python -m envs collect | gallery | play --help`."""

import argparse
import math
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from envs import actions
from envs.cli import commands
from envs.cli.refusals import parsed, refused
from envs.compilation import alarms, cache
from envs.experts.collection import Record
from envs.names import names
from envs.scene import distractors


def main(
    arguments: Sequence[str], program: str = "python -m envs", record: Record | None = None
) -> int:
    """Runs one command; returns the exit code: 0 done, 2 bad input, 130 stopped.

    Args:
        arguments: of the command line.
        program: its name in help and errors.
        record: as for `envs.collect`.
    """
    options = parsed(parser(program), arguments)
    options.record = record
    console = Console(stderr=True)
    # JAX would reserve most of a GPU at its start, which takes a second (measured) for a command of
    # half a minute.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    cache.enable()
    try:
        options.command(options, console)
    except Exception as error:
        return refused(error, console)
    except KeyboardInterrupt as stop:
        console.print(f"stopped: {str(stop) or 'no unfinished file is left'}", soft_wrap=True)
        return 130
    return 0


def parser(program: str) -> argparse.ArgumentParser:
    """The commands and their options."""
    parser = argparse.ArgumentParser(prog=program, description="Scripted expert episodes.")
    subparsers = parser.add_subparsers(required=True, metavar="command")
    tasks = ", ".join(names("task"))
    robots = f"{', '.join(names('robot'))}, or the path of an MJCF file"

    def add(command: Callable[..., None], image_size: int, of: str = "") -> Callable[..., Any]:
        text = command.__doc__
        sub = subparsers.add_parser(command.__name__, help=text, description=text)
        sub.set_defaults(command=command)
        sub.add_argument("--overwrite", action="store_true", help=f"{of}replace what is there")
        pixels = f"{of}pixels (%(default)s)"
        sub.add_argument("--image-size", type=int, default=image_size, help=pixels)
        sub.add_argument("--seed", type=seed, default=0, help="of all randomness (%(default)s)")
        return sub.add_argument

    option = add(commands.collect, image_size=64)
    option("--task", required=True, nargs="+", help=f"{tasks}; all for all")
    option("--robot", required=True, help=robots)
    option("--out", required=True, type=Path, help="folder; one task: a dataset or an .npz file")
    option("--num-episodes", type=int, default=64, help="of each task (%(default)s)")
    option("--num-envs", type=int, help="worlds at once (default: by device)")
    option("--control-dt", type=finite, default=0.1, help="s between two actions (%(default)s)")
    option("--actions", default="joint", help=f"{', '.join(actions.MODES)} (%(default)s)")
    option("--action-noise", type=finite, default=0.0, help="rad (%(default)s)")
    option("--distractors", type=int, default=0, help=f"up to {distractors.MOST} (%(default)s)")
    option("--randomize", action="store_true", help="masses, cameras, light and more differ")
    option("--antialias", type=int, default=1, help="rays a pixel, squared (%(default)s)")

    option = add(commands.gallery, image_size=128)
    option("--task", help=f"{tasks} (default: all)")
    option("--robot", help=f"{robots} (default: all)")
    option("--out", required=True, type=Path, help="folder")

    option = add(commands.play, image_size=256, of="with --out: ")
    option("--task", required=True, help=tasks)
    option("--robot", required=True, help=robots)
    option("--out", type=Path, help=".mp4 file (default: a window)")
    return parser


def seed(text: str) -> int:
    """A seed of JAX, which takes no more than 32 bits of one; argparse says what does not fit."""
    if not 0 <= (value := int(text)) < 2**32:
        raise argparse.ArgumentTypeError(f"must be 0 to {2**32 - 1}, not {value}")
    return value


def finite(text: str) -> float:
    """A number, neither infinite nor nan; argparse says what is none."""
    if not math.isfinite(value := float(text)):
        raise argparse.ArgumentTypeError(f"must be a finite number, not {text}")
    return value


if __name__ == "__main__":
    alarms.silence()
    sys.exit(main(sys.argv[1:]))
