"""Shell completion: `lorasp-jax completion bash`."""

import argparse
import importlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from lorasp_jax.base.errors import parse_arguments
from lorasp_jax.cli import commands


def main(arguments: Sequence[str], program: str) -> int:
    """Print a completion script; return the exit code."""
    shell = parse_arguments(parser(program), arguments).shell
    import shtab

    tree = _tree()
    for action in _actions(tree):
        if action.type is Path or action.dest in ("path", "paths"):
            action.complete = shtab.FILE
    print(shtab.complete(tree, shell))
    return 0


def parser(program: str) -> argparse.ArgumentParser:
    """Return the argument parser of this command."""
    import shtab

    parser = argparse.ArgumentParser(
        prog=program,
        description="Print a script for Tab completion of commands, options and config fields.",
        epilog=f'In bash: eval "$({program} bash)". In zsh: {program} zsh > DIRECTORY/_lorasp-jax, '
        "where DIRECTORY is in fpath.",
    )
    parser.add_argument("shell", choices=shtab.SUPPORTED_SHELLS)
    return parser


def _tree() -> argparse.ArgumentParser:
    """Return a parser with all commands and their options."""
    tree = argparse.ArgumentParser(prog="lorasp-jax")
    subparsers = tree.add_subparsers(metavar="command")
    for name, (module, text) in commands.COMMANDS.items():
        options = importlib.import_module(module).parser(f"lorasp-jax {name}")
        subparsers.add_parser(name, help=text, parents=[options], add_help=False)
    return tree


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Yield every option and argument of a parser and of its subparsers."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for subparser in action.choices.values():
                yield from _actions(subparser)
