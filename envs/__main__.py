"""Command line: `python -m envs collect | gallery | play --help`."""

import argparse
import math
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from envs.cli import commands
from envs.names import MODES, names
from envs.scene import distractors
from lorasp_jax.base import compilation_cache as cache
from lorasp_jax.base.arguments import seed
from lorasp_jax.base.errors import run_command

_DEFAULT = "(default: %(default)s)"


def main(arguments: Sequence[str], program: str = "python -m envs") -> int:
    """Run a command and return its exit code.

    The code is 0 on success, 2 after an error, and 130 if interrupted.
    `program` is the name shown in help and errors.
    """
    options = parser(program).parse_args(arguments)
    console = Console(stderr=True)
    # Preallocating GPU memory would add a second to commands that take half a minute (measured).
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    interrupted = "interrupted; temporary files were removed"

    def command() -> None:
        cache.enable()
        options.command(options, console)

    return run_command(command, console, interrupted)


def parser(program: str) -> argparse.ArgumentParser:
    """Define the commands and their options."""
    parser = argparse.ArgumentParser(prog=program, description="Collect or show expert episodes.")
    subparsers = parser.add_subparsers(required=True, metavar="command")
    tasks = ", ".join(names("task"))
    robots = f"{', '.join(names('robot'))}, or the path of an MJCF file"

    option = _add_command(subparsers, commands.collect, image_size=64)
    option("--task", required=True, nargs="+", help=f"{tasks}; or all")
    option("--robot", required=True, help=robots)
    text = "dataset folder; for several tasks, folder of the datasets"
    option("--out", required=True, type=Path, help=text)
    option("--num-episodes", type=int, default=64, help=f"episodes per task {_DEFAULT}")
    option("--num-envs", type=int, help="parallel worlds (default: depends on the device)")
    option("--control-dt", type=finite, default=0.1, help=f"time between actions [s] {_DEFAULT}")
    option("--actions", default="joint", help=f"mode: {', '.join(MODES)} {_DEFAULT}")
    text = f"standard deviation of noise on executed actions, in their units {_DEFAULT}"
    option("--action-noise", type=finite, default=0.0, help=text)
    text = f"unrelated objects on the table, up to {distractors.MAX_COUNT} {_DEFAULT}"
    option("--distractors", type=int, default=0, help=text)
    text = "randomize masses, cameras, light and more between worlds"
    option("--randomize", action="store_true", help=text)
    option("--antialias", type=int, default=1, help=f"cast n x n rays per pixel {_DEFAULT}")

    option = _add_command(subparsers, commands.gallery, image_size=128)
    option("--task", help=f"{tasks} (default: all)")
    option("--robot", help=f"{robots} (default: all)")
    option("--out", required=True, type=Path, help="output folder")

    option = _add_command(subparsers, commands.play, image_size=256, prefix="with --out: ")
    option("--task", required=True, help=tasks)
    option("--robot", required=True, help=robots)
    option("--out", type=Path, help="output .mp4 file (default: show a window)")
    return parser


def _add_command(
    subparsers: Any, command: Callable[..., None], image_size: int, prefix: str = ""
) -> Callable[..., Any]:
    """Add a command with the shared options; return its `add_argument`."""
    text = command.__doc__
    sub = subparsers.add_parser(command.__name__, help=text, description=text)
    sub.set_defaults(command=command)
    text = f"{prefix}height and width of images [px] {_DEFAULT}"
    sub.add_argument("--image-size", type=int, default=image_size, help=text)
    sub.add_argument("--seed", type=seed, default=0, help=f"random seed {_DEFAULT}")
    return sub.add_argument


def finite(text: str) -> float:
    """Parse a finite number."""
    if not math.isfinite(value := float(text)):
        raise argparse.ArgumentTypeError(f"must be a finite number, got {text}")
    return value


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
