"""Inspect or convert datasets: `python -m lorasp_jax.data --help`."""

import argparse
import dataclasses
import functools
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from lorasp_jax.base.bars import bars
from lorasp_jax.base.errors import run_command
from lorasp_jax.base.files import check_local
from lorasp_jax.data import dataset_file
from lorasp_jax.data.keys import Keys

if TYPE_CHECKING:
    from lorasp_jax.data.source import Progress as Report


def main(arguments: Sequence[str], program: str = "python -m lorasp_jax.data") -> int:
    """Run a command and return its exit code: 0 for success, or one of `lorasp_jax.base.errors`."""
    options = parser(program).parse_args(arguments)
    import jax  # imported here to keep --help fast

    jax.config.update("jax_platforms", "cpu")  # leave accelerators to other processes
    interrupted = "interrupted; temporary files were removed"
    command = functools.partial(options.command, options, Console())
    return run_command(command, interrupted=interrupted)


def inspect(options: argparse.Namespace, console: Console) -> None:
    """Print a summary of a dataset, write a contact sheet of its images, and save the options."""
    from lorasp_jax.data import inspection
    from lorasp_jax.data.opening import open_source

    keys = keys_of(options, options.path)
    source = open_source(options.path, keys)
    for name, file in (("out", options.out), ("save", options.save)):
        if file:
            check_local(file)
        if file and file.exists() and not options.overwrite:
            raise ValueError(f"{file} already exists: add --overwrite or choose another --{name}")
    if options.save and (dataset_file.is_file(options.path) or options.save.suffix != ".toml"):
        raise ValueError(f"--save needs a dataset and a new .toml file, got {options.save}")
    path = options.out or inspection.default_path(options.path)
    inspection.report(source, console)
    inspection.write_contact_sheet(source, path, options.augment)
    console.print(f"contact sheet: {path}", soft_wrap=True, highlight=False, markup=False)
    if options.save:
        dataset_file.write(options.save, options.path, keys)
        console.print(f"for --data.source: {options.save}", soft_wrap=True, highlight=False)


def convert(options: argparse.Namespace, console: Console) -> None:
    """Convert datasets to a cache for training, or one dataset to RLDS or LeRobot v3.0."""
    from lorasp_jax.data import cache, lerobot_export, rlds_export
    from lorasp_jax.data.opening import open_source, open_sources
    from lorasp_jax.data.source import describe_left_out, grippers

    count = len(options.paths)
    if options.to != "cache" and count > 1:
        raise ValueError(f"--to {options.to} converts exactly one dataset, got {count}")
    source = open_sources(options.paths, keys_of(options, *options.paths))
    if unused := describe_left_out(source):
        console.print(unused, soft_wrap=True, highlight=False, markup=False)
    if options.to != "cache":
        cache.verify_images(source)
    with _progress_bar(f"writing {options.out.name}") as progress:
        if options.to == "rlds":
            rlds_export.to_rlds(source, options.out, progress)
        elif options.to == "lerobot":
            lerobot_export.to_lerobot(source, options.out, progress)
        else:
            cache.write([source], options.out, progress)
    console.print(f"{options.out}: {len(source)} episodes", soft_wrap=True, highlight=False)
    known, read = grippers(source), grippers(open_source(options.out))
    if read != known:
        text = (
            f"{options.out} does not say that the grippers are dimensions {known}, as a cache does"
        )
        console.print(f"{text}: it is read with {read}", soft_wrap=True, highlight=False)


def parser(program: str) -> argparse.ArgumentParser:
    """Define the commands and their options."""
    parser = argparse.ArgumentParser(prog=program, description="Inspect or convert datasets.")
    subparsers = parser.add_subparsers(required=True, metavar="command")
    where = "LeRobot dataset (folder or hf://owner/name), RLDS dataset, cache, or its TOML file"

    text = inspect.__doc__
    sub = subparsers.add_parser("inspect", help=text, description=text)
    sub.set_defaults(command=inspect)
    sub.add_argument("path", help=where)
    sub.add_argument(
        "--out",
        type=Path,
        help="output .png file (default: one per dataset in ~/.cache/lorasp_jax)",
    )
    text = "write the dataset and these options to a .toml file, which stands for it everywhere"
    sub.add_argument("--save", type=Path, metavar="FILE", help=text)
    sub.add_argument("--overwrite", action="store_true", help="replace existing files")
    text = "show what training makes of a frame, by this recipe (default: %(const)s)"
    recipes = {"nargs": "?", "const": "auto", "choices": ("auto", "openpi", "lerobot")}
    sub.add_argument("--augment", default="none", help=text, **recipes)
    add_keys(sub)

    text = convert.__doc__
    sub = subparsers.add_parser("convert", help=text, description=text)
    sub.set_defaults(command=convert)
    sub.add_argument("paths", nargs="+", metavar="path", help=where)
    sub.add_argument("--out", type=Path, required=True, help="folder to create")
    text = "output format (default: %(default)s)"
    sub.add_argument("--to", choices=("cache", "rlds", "lerobot"), default="cache", help=text)
    add_keys(sub)
    return parser


def add_keys(parser: argparse.ArgumentParser) -> None:
    """Add one option per field of `Keys`; those that are not given are missing in the result."""
    group = parser.add_argument_group("LeRobot datasets")
    add = functools.partial(group.add_argument, default=argparse.SUPPRESS)
    text = f"feature with measured joints and gripper (default: {Keys.state})"
    add("--state", help=text)
    text = f"feature with commanded joints and gripper (default: {Keys.action})"
    add("--action", help=text)
    text = "dimensions to use, by name or index: joints first, gripper last (default: all)"
    add("--state-numbers", nargs="+", metavar="NAME", help=text)
    add("--action-numbers", nargs="+", metavar="NAME", help=text)
    text = "gripper openings among the dimensions in use (default: those so named, or the last)"
    add("--grippers", nargs="+", metavar="NAME", help=text)
    text = "cameras to use, also by the last part of their names, and names of your choice for "
    text += "them, in datasets of any format (default: all)"
    add("--cameras", nargs="+", metavar="[NAME=]FEATURE", type=_camera, help=text)
    text = f"unit of the joints (default: {Keys.angles})"
    add("--angles", choices=("radians", "degrees"), help=text)
    text = f"unit of the gripper opening (default: {Keys.gripper})"
    add("--gripper", choices=("metres", "millimetres"), help=text)
    add("--every", type=int, help=f"keep every N-th frame (default: {Keys.every})")
    text = "downscale images whose longer side exceeds this length [px]; 0: never "
    group.add_argument("--image-size", type=int, default=224, help=f"{text}(default: %(default)s)")


def keys_of(options: argparse.Namespace, *paths: str) -> Keys:
    """Return the values of the options of `add_keys` for these datasets.

    Raises:
        ValueError: an option is given beside a dataset file, or two cameras have one name.
    """
    names = (field.name for field in dataclasses.fields(Keys))
    given = {name: getattr(options, name) for name in names if hasattr(options, name)}
    file = next(filter(dataset_file.is_file, paths), None)
    if file and (option := next((name for name in given if name != "image_size"), None)):
        raise ValueError(
            f"--{option.replace('_', '-')} is one of the dataset's options, which {file} has: "
            "change it there"
        )
    cameras = given.get("cameras", ())
    if len(dict(cameras)) < len(cameras):
        raise ValueError(f"--cameras must have unique names, got {cameras}")
    lists = {name: tuple(value) for name, value in given.items() if isinstance(value, list)}
    return Keys(**{**given, **lists, "cameras": dict(cameras)})


def _camera(text: str) -> tuple[str, str]:
    """Parse NAME=FEATURE, or FEATURE, whose name is its last part."""
    name, equals, feature = text.partition("=")
    if not name or (equals and not feature):
        raise argparse.ArgumentTypeError(f"must be FEATURE or NAME=FEATURE, got {text}")
    return (name, feature) if equals else (text.rpartition(".")[2], text)


@contextmanager
def _progress_bar(title: str) -> Iterator["Report"]:
    """Yield a progress callback, whose first call shows the bar."""
    progress = bars(Console(stderr=True), "steps")
    bar = progress.add_task(title, total=None)
    with ExitStack() as stack:

        def report(done: int, total: int) -> None:
            if not progress.live.is_started:
                stack.enter_context(progress)
            progress.update(bar, completed=done, total=total)

        yield report


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
