"""The console command, `lorasp-jax COMMAND`; see `COMMANDS`."""

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
    "evaluate": (
        "lorasp_jax.evaluation.__main__",
        "measure a run on recorded episodes, or record its own in simulation",
    ),
    "study": ("lorasp_jax.extras.study.__main__", "run many experiments"),
    "judge": ("lorasp_jax.extras.judge.__main__", "judge a policy in a Gymnasium environment"),
    "latency": (
        "lorasp_jax.extras.latency.__main__",
        "evaluate policies whose actions arrive late",
    ),
    "envs": ("envs.__main__", "collect, render or play episodes of the scripted experts"),
    "data": ("lorasp_jax.data.__main__", "inspect or convert datasets"),
    "report": (
        "lorasp_jax.report.__main__",
        "rebuild the report of a run, or film its active ranks",
    ),
    "allocate": (
        "lorasp_jax.cli.allocate",
        "plan ranks by layer from a finished run, for train --plan",
    ),
    "deploy": (
        "lorasp_jax.extras.deployment.__main__",
        "compare forms in which a run can be deployed, or save one",
    ),
    "serve": ("lorasp_jax.extras.serving.__main__", "serve a policy to robots over websockets"),
    "piper": ("lorasp_jax.extras.piper.__main__", "run a policy on a PiPER, or record episodes"),
    "fake-piper": ("lorasp_jax.extras.piper.fake.__main__", "the same on a simulated PiPER"),
    "export": ("lorasp_jax.extras.serving.export", "export a policy, to run without this package"),
}
"""Module and help text of each command. A module has `main(arguments, program)`, which returns the
exit code."""
INTERRUPTED = 130
"""Exit code after SIGINT (128 + 2, as in shells) or SIGTERM. Repeats the constant of
`lorasp_jax.base.errors`, whose import takes a second."""


def main() -> NoReturn:
    """Run the command named on the command line."""
    exit_on_signals()

    first, rest = sys.argv[1:2], sys.argv[2:]
    command = _parser().parse_args(first).command
    run(command, rest, f"lorasp-jax {command}")


def exit_on_signals() -> None:
    """Exit silently on Ctrl-C or SIGTERM: until a command starts, there is nothing to save.

    Call this before the imports that load JAX, which take about a second.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(INTERRUPTED))


def run(command: str, arguments: Sequence[str], program: str) -> NoReturn:
    """Run one of `COMMANDS` and exit with its exit code."""
    from rich.console import Console

    from lorasp_jax.base.errors import report_error

    try:
        module = importlib.import_module(COMMANDS[command][0])
    except ModuleNotFoundError as error:
        sys.exit(report_error(error, Console(stderr=True)))
    if code := module.main(arguments, program):
        from lorasp_jax.training.distributed import processes

        processes.exit_all(code)  # without waiting for compilation threads, which cannot be stopped
    sys.exit()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="lorasp-jax",
        description="Adapt vision-language-action models to new robots with LoRA-SP.",
        epilog="Run lorasp-jax COMMAND --help for the options of a command.",
    )
    version = f"lorasp-jax {lorasp_jax.__version__}"
    parser.add_argument("--version", action="version", version=version)
    commands = parser.add_subparsers(dest="command", metavar="command", required=True)
    for name, (_, text) in COMMANDS.items():
        commands.add_parser(name, help=text)
    return parser
