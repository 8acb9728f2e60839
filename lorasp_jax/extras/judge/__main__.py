"""Judge a policy in a Gymnasium environment: `python -m lorasp_jax.extras.judge --help`."""

import argparse
import contextlib
import functools
import importlib
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from lorasp_jax.base.arguments import positive, seed
from lorasp_jax.base.errors import INTERRUPTED, REFUSED, describe
from lorasp_jax.base.writing import write_text
from lorasp_jax.extras.judge.actors import Actor, RunActor, ServerActor
from lorasp_jax.extras.judge.judge import judge
from lorasp_jax.extras.judge.parallel import judge_in_processes
from lorasp_jax.extras.judge.task import GymTask, load_tasks


def main(arguments: Sequence[str], program: str = "python -m lorasp_jax.extras.judge") -> int:
    """Judge a policy; return the exit code."""
    options = parser(program).parse_args(arguments)
    try:
        _run(options)
    except (ValueError, OSError, ModuleNotFoundError) as error:
        print(f"error: {describe(error) or error}", file=sys.stderr)
        return REFUSED
    except KeyboardInterrupt:
        print("interrupted; nothing was written but films", file=sys.stderr)
        return INTERRUPTED
    return 0


def _run(options: argparse.Namespace) -> None:
    _check(options)
    settings: dict[str, Any] = {"seed": options.seed, "films": options.films}
    if sys.stderr.isatty():
        settings["progress"] = _print_progress
    if options.processes > 1:
        where = options.env, options.tasks, _server(options), options.episodes, options.processes
        results = judge_in_processes(*where, **settings)
    else:
        tasks = load_tasks(options.env, options.tasks)
        with _actor(options, tasks) as actor:
            results = judge(tasks, actor, options.episodes, **settings)
    if sys.stderr.isatty():
        print(file=sys.stderr)
    print(table(results))
    if options.out:
        source = options.server or str(options.run)
        described = {"policy": source, "env": options.env, "seed": options.seed, **results}
        options.out.parent.mkdir(parents=True, exist_ok=True)
        write_text(options.out, json.dumps(described, indent=1))
        print(f"written: {options.out}")


def _check(options: argparse.Namespace) -> None:
    """Raise ValueError for options that cannot work, before anything is loaded."""
    if (options.run is None) == (not options.server):
        raise ValueError("give either the folder of a run or --server, and not both")
    if options.processes > 1 and not options.server:
        raise ValueError("--processes needs --server, whose policy all processes share")
    for name in ("out", "films"):
        if (path := getattr(options, name)) and path.exists():
            raise ValueError(f"{path} exists: choose another --{name}")
    if options.films:
        importlib.import_module("PIL")


@contextlib.contextmanager
def _actor(options: argparse.Namespace, tasks: Sequence[GymTask]) -> Iterator[Actor]:
    if not options.server:
        yield RunActor(options.run, [task.instruction for task in tasks])
        return
    with contextlib.closing(_server(options)()) as server:
        yield server


def _server(options: argparse.Namespace) -> Callable[[], ServerActor]:
    """Return what connects to the server; processes can import it, unlike this module."""
    return functools.partial(ServerActor, options.server, token=options.token, wait=options.wait)


def _print_progress(task: str, done: int, successes: int) -> None:
    print(f"\r\033[K{task}: {successes} of {done}", end="", file=sys.stderr, flush=True)


def table(results: dict[str, Any]) -> str:
    """Format success rates with their intervals, one line per task and group."""
    # A group may have the name of one of its tasks.
    rows = [*results["tasks"].items(), *results["groups"].items(), ("all", results)]
    width = max(len(name) for name, _ in rows)
    lines = []
    for name, row in rows:
        low, high = (100 * bound for bound in row["ci95"])
        wins = round(row["success"] * row["episodes"])
        lines.append(
            f"{name:{width}}  {100 * row['success']:5.1f} %  [{low:.1f}, {high:.1f}]  "
            f"{wins} of {row['episodes']}"
        )
    return "\n".join([*lines, f"{results['steps_per_second']:.0f} environment steps/s"])


def parser(program: str) -> argparse.ArgumentParser:
    """Define the options."""
    parser = argparse.ArgumentParser(
        prog=program,
        description="Judge a policy in a Gymnasium environment by the environment's own success. "
        "With --server, JAX is not needed. Execution under latency: "
        "python -m lorasp_jax.extras.latency.",
    )
    add = parser.add_argument
    add("run", type=Path, nargs="?", help="folder of a run, such as runs/NAME")
    add("--server", default="", metavar="URL", help="ask a policy server, such as ws://HOST:PORT")
    add("--token", default="", help="token of the server, if it requires one")
    text = "how long to wait for the server [s] (default: %(default)g)"
    add("--wait", type=float, default=0.0, metavar="S", help=text)
    text = "function without arguments that returns one or more lorasp_jax Tasks"
    add("--env", required=True, metavar="MODULE:FACTORY", help=text)
    add("--tasks", nargs="+", default=(), metavar="TASK", help="tasks (default: all)")
    text = "episodes per task (default: %(default)s)"
    add("--episodes", type=positive, default=10, metavar="N", help=text)
    text = "tasks judged at once, each in a process; needs --server (default: %(default)s)"
    add("--processes", type=positive, default=1, metavar="N", help=text)
    text = "seed of the first episode; the next has the next seed (default: %(default)s)"
    add("--seed", type=seed, default=0, help=text)
    add("--out", type=Path, metavar="FILE", help="JSON file to write")
    add("--films", type=Path, metavar="FOLDER", help="film the first episode of each task")
    return parser


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
