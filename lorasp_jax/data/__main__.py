"""Command line: `python -m lorasp_jax.data inspect | convert --help`."""

import argparse
import functools
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from envs.cli.bars import bars
from envs.cli.refusals import parsed, refused
from envs.datasets.files import check_local
from lorasp_jax.data.keys import Keys

if TYPE_CHECKING:
    from lorasp_jax.data.source import Progress as Report


def main(arguments: Sequence[str], program: str = "python -m lorasp_jax.data") -> int:
    """Runs one command; returns the exit code: 0 done, 2 bad input, 130 stopped."""
    options = parsed(parser(program), arguments)  # before slow imports, which help does not need
    import jax

    jax.config.update("jax_platforms", "cpu")  # nothing here is worth taking an accelerator
    errors = Console(stderr=True)
    try:
        options.command(options, Console())
    except Exception as error:
        return refused(error, errors)
    except KeyboardInterrupt:
        errors.print("stopped: no unfinished file is left")
        return 130
    return 0


def inspect(options: argparse.Namespace, console: Console) -> None:
    """Prints what is in a dataset and writes a picture of it."""
    from lorasp_jax.data import inspection
    from lorasp_jax.data.opening import open_source

    source = open_source(options.path, _keys(options))
    if options.out:
        check_local(options.out)
    if options.out and options.out.exists() and not options.overwrite:
        raise ValueError(f"{options.out} exists already: add --overwrite or choose another --out")
    path = options.out or inspection.place(options.path)
    inspection.report(source, console)
    inspection.write_contact_sheet(source, path)
    console.print(f"pictures: {path}", soft_wrap=True, highlight=False, markup=False)


def convert(options: argparse.Namespace, console: Console) -> None:
    """Writes datasets as a cache, which training reads, or one as an RLDS dataset."""
    from lorasp_jax.data import cache, rlds_export
    from lorasp_jax.data.opening import open_source

    keys = _keys(options)
    sources = [open_source(path, keys) for path in options.paths]
    if options.to == "rlds" and len(sources) > 1:
        raise ValueError(f"an RLDS dataset is made of one dataset, not of {len(sources)}")
    with _bar(f"writing {options.out.name}") as (progress, say):
        if options.to == "rlds":
            rlds_export.to_rlds(sources[0], options.out, progress)
        else:
            wait = f"another process is writing {options.out}: waiting for it"
            cache.write(sources, options.out, progress, waiting=lambda: say(wait))
    episodes = sum(len(source) for source in sources)
    console.print(f"{options.out}: {episodes} episodes", soft_wrap=True, highlight=False)


def parser(program: str) -> argparse.ArgumentParser:
    """The commands and their options."""
    parser = argparse.ArgumentParser(prog=program, description="Inspect or convert datasets.")
    subparsers = parser.add_subparsers(required=True, metavar="command")
    where = "a LeRobot dataset (folder or hf://owner/name), an RLDS one, a cache or an .npz file"

    text = inspect.__doc__
    sub = subparsers.add_parser("inspect", help=text, description=text)
    sub.set_defaults(command=inspect)
    sub.add_argument("path", help=where)
    sub.add_argument(
        "--out", type=Path, help=".png file (default: one for each dataset in ~/.cache/lorasp_jax)"
    )
    sub.add_argument("--overwrite", action="store_true", help="replace the .png file")
    _add_keys(sub)

    text = convert.__doc__
    sub = subparsers.add_parser("convert", help=text, description=text)
    sub.set_defaults(command=convert)
    sub.add_argument("paths", nargs="+", metavar="path", help=where)
    sub.add_argument("--out", type=Path, required=True, help="folder to make")
    sub.add_argument("--to", choices=("cache", "rlds"), default="cache", help="(%(default)s)")
    _add_keys(sub)
    return parser


def _add_keys(parser: argparse.ArgumentParser) -> None:
    """The options that say what is what in a LeRobot dataset, see `Keys`."""
    add = parser.add_argument_group("LeRobot datasets").add_argument
    add("--state", default=Keys.state, help="feature with joints and gripper (%(default)s)")
    add("--action", default=Keys.action, help="feature with their targets (%(default)s)")
    names = "names or indices of its numbers, joints first, gripper last (all)"
    add("--state-numbers", nargs="+", default=(), metavar="NAME", help=names)
    add("--action-numbers", nargs="+", default=(), metavar="NAME", help=names)
    text = "cameras wanted and what they are called here (all)"
    add("--cameras", nargs="+", default=(), metavar="NAME=FEATURE", type=_camera, help=text)
    add("--angles", choices=("radians", "degrees"), default=Keys.angles, help="(%(default)s)")
    add("--gripper", choices=("metres", "millimetres"), default=Keys.gripper, help="(%(default)s)")
    add("--every", type=int, default=1, help="take every so many-th frame (%(default)s)")
    text = "longest side of a picture [pixels]; larger ones are reduced, 0: none (%(default)s)"
    add("--image-size", type=int, default=224, help=text)


def _keys(options: argparse.Namespace) -> Keys:
    return Keys(
        state=options.state,
        action=options.action,
        state_numbers=tuple(options.state_numbers),
        action_numbers=tuple(options.action_numbers),
        cameras=dict(options.cameras),
        angles=options.angles,
        gripper=options.gripper,
        every=options.every,
        image_size=options.image_size,
    )


def _camera(text: str) -> tuple[str, str]:
    """NAME=FEATURE; argparse says what is not."""
    name, equals, feature = text.partition("=")
    if not (name and equals and feature):
        raise argparse.ArgumentTypeError(f"must be NAME=FEATURE, not {text}")
    return name, feature


@contextmanager
def _bar(title: str) -> Iterator[tuple["Report", Callable[[str], None]]]:
    """A progress bar: what moves it, from when on it shows, and what prints a sentence above it."""
    progress = bars(Console(stderr=True), "steps")
    bar = progress.add_task(title, total=None)
    say = functools.partial(progress.console.print, soft_wrap=True, highlight=False, markup=False)
    with ExitStack() as shown:

        def report(done: int, total: int) -> None:
            if not progress.live.is_started:
                shown.enter_context(progress)
            progress.update(bar, completed=done, total=total)

        yield report, say


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
