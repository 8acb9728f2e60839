"""The console command: `lorasp-jax train | envs | data | report | completion`."""

import argparse
import importlib
import os
import signal
import sys
from collections.abc import Sequence
from typing import NoReturn

import lorasp_jax

COMMANDS = {
    "train": ("lorasp_jax.cli.train", "adapt a policy to a robot"),
    "envs": ("envs.__main__", "collect, film or play episodes of the scripted experts"),
    "data": ("lorasp_jax.data.__main__", "inspect or convert datasets"),
    "report": ("lorasp_jax.cli.report", "write the report of a run again"),
    "completion": ("lorasp_jax.cli.completion", "print what completes these commands in a shell"),
}
"""Commands: the module and what it does. A module has `main(arguments, program)`, which returns the
exit code, and `parser(program)`, the options that completion knows."""
STOPPED = 130
"""Exit code after a signal, as shells have it."""


def main() -> NoReturn:
    """Run the command that the command line names."""
    stop_at_once()
    from envs.cli.refusals import parsed

    first, rest = sys.argv[1:2], sys.argv[2:]
    command = parsed(_parser(), first).command
    run(command, rest, f"lorasp-jax {command}")


def stop_at_once() -> None:
    """Exit silently on Ctrl-C or SIGTERM: until a command starts there is nothing to save.

    Call it before the imports that start JAX, which take a second.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(STOPPED))


def run(command: str, arguments: Sequence[str], program: str) -> NoReturn:
    """Run one command and leave with its exit code.

    Args:
        command: one of `COMMANDS`.
        arguments: what follows it on the command line.
        program: how it was started, for its help.
    """
    from envs.compilation import alarms

    alarms.silence()
    if code := importlib.import_module(COMMANDS[command][0]).main(arguments, program):
        from lorasp_jax.training.distributed import processes

        processes.leave(code)  # not waiting for threads that still compile, which cannot be stopped
    sys.exit()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="lorasp-jax",
        description="Adapt vision-language-action models to new robots with LoRA-SP.",
        epilog="lorasp-jax COMMAND --help lists the options of a command.",
    )
    version = f"lorasp-jax {lorasp_jax.__version__}"
    parser.add_argument("--version", action="version", version=version)
    commands = parser.add_subparsers(dest="command", metavar="command", required=True)
    for name, (_, text) in COMMANDS.items():
        commands.add_parser(name, help=text)
    return parser
