"""Measure a finished run on recorded episodes, or record its own: `lorasp-jax evaluate --help`."""

import argparse
import dataclasses
import functools
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from lorasp_jax.base.arguments import positive, seed
from lorasp_jax.base.errors import run_command
from lorasp_jax.base.files import join_inside
from lorasp_jax.data.__main__ import add_keys, keys_of

if TYPE_CHECKING:
    from lorasp_jax.data.source import Source
    from lorasp_jax.evaluation.held_out import HeldOut
    from lorasp_jax.evaluation.held_out_run import Subject


def main(arguments: Sequence[str], program: str = "lorasp-jax evaluate") -> int:
    """Run the command and return its exit code: 0, or one of `lorasp_jax.base.errors`."""
    own = parser(program)
    options = own.parse_args(arguments)
    _refuse_unused(own, options)
    command = record if options.record else evaluate
    return run_command(lambda: command(options, Console()))


def parser(program: str) -> argparse.ArgumentParser:
    """Define the command's options."""
    parser = argparse.ArgumentParser(
        prog=program,
        description="Compare the actions of a run's policy with recorded ones: errors by joint, "
        "beside those of holding still and of repeating the previous action, and a picture per "
        "task. Or record the policy's own episodes in simulation.",
    )
    parser.add_argument("run", type=Path, help="folder of the run, such as runs/multitask")
    text = "LeRobot dataset (folder or hf://owner/name), RLDS dataset, cache, or its TOML file"
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--data", metavar="DATASET", help=text)
    text = "the episodes of the run's own datasets that training held out"
    what.add_argument("--held-out", action="store_true", help=text)
    text = "simulate instead, and write the policy's episodes with their outcomes to FOLDER/TASK"
    what.add_argument("--record", type=Path, metavar="FOLDER", help=text)
    text = "with --record: episodes per task (default: %(default)s)"
    parser.add_argument("--rollouts", type=positive, default=64, metavar="N", help=text)
    text = "with --record: other layouts for another number (default: %(default)s)"
    parser.add_argument("--seed", type=seed, default=0, help=text)
    text = "for which of the run's datasets the policy acts, if they differ (default: the first; "
    text += "with --held-out: each)"
    parser.add_argument("--dataset", default="", metavar="NAME", help=text)
    text = "numbers of the episodes (default: all, or those of --dataset in a cache of several)"
    parser.add_argument("--episodes", nargs="+", type=int, metavar="N", help=text)
    text = "flow-matching steps per chunk (default: as in the run's evaluation)"
    parser.add_argument("--denoise-steps", type=positive, metavar="N", help=text)
    text = "folder for the pictures (default: a folder of the run, named after the dataset)"
    parser.add_argument("--out", type=Path, help=text)
    add_keys(parser)
    return parser


def _refuse_unused(own: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Exit, with a sentence, if an option is of the other command."""
    given = {name for name, value in vars(options).items() if value != own.get_default(name)}
    recording = {"rollouts", "seed"}
    others = {
        "record": given - {"run", "record", "dataset", "denoise_steps", *recording},
        "held_out": given - {"run", "held_out", "dataset", "denoise_steps", "out"},
        "data": given & recording,
    }
    chosen = next(name for name in others if name in given)
    for name in sorted(others[chosen]):
        option, other = (f"--{each.replace('_', '-')}" for each in (name, chosen))
        own.error(f"argument {option}: not allowed with argument {other}")


def evaluate(options: argparse.Namespace, console: Console) -> None:
    """Print the errors of a run on recordings, and draw an episode of each task.

    Raises:
        ValueError: there is no such run, dataset or episode, or they do not fit together.
    """
    from lorasp_jax.base import compilation_cache as cache
    from lorasp_jax.evaluation import held_out, held_out_figure, held_out_run
    from lorasp_jax.training import export

    cache.enable()
    if options.held_out:
        name, found = "held_out", held_out_run.subjects(options.run, options.dataset)
    else:
        name = Path(options.data).name.removesuffix(".toml")
        found = {name: _subject(options)}
    steps = {"num_steps": options.denoise_steps or export.denoise_steps(options.run)}
    folder, errors = options.out or options.run / f"evaluate_{name}", []
    for name, (policy, source, numbers) in found.items():
        of = name * bool(len(found) > 1)
        measured = held_out.measure(policy, held_out.windows(source, numbers, policy), **steps)
        errors.append(_report(measured, console, of))
        to = join_inside(folder, of.replace("/", "_")) if of else folder
        to.mkdir(parents=True, exist_ok=True)
        for path in held_out_figure.write(to, policy, source, numbers, **steps):
            console.print(f"picture: {path}", soft_wrap=True, highlight=False, markup=False)
    if (count := len(errors)) > 1:
        means = [sum(values) / count for values in zip(*errors, strict=True)]
        _say_errors(means, console, f"mean of {count} datasets")


def _subject(options: argparse.Namespace) -> "Subject":
    """Return the policy of a run and the episodes of --data on which to measure it."""
    from lorasp_jax.data.opening import open_source
    from lorasp_jax.evaluation import held_out
    from lorasp_jax.evaluation.held_out_run import Subject
    from lorasp_jax.training import export

    source = open_source(options.data, keys_of(options, options.data))
    described = export.describe(options.run)
    _check_period(options, source, described["control_dt"])
    acts_for = options.dataset or described.get("policy", {}).get("dataset", "")
    numbers = options.episodes or held_out.episodes_of(source, acts_for)
    if wrong := [number for number in numbers if not 0 <= number < len(source)]:
        raise ValueError(f"--episodes must be 0 to {len(source) - 1}, got {wrong[0]}")
    return Subject(export.load_policy(options.run, dataset=options.dataset), source, numbers)


def _report(found: "HeldOut", console: Console, dataset: str) -> list[float]:
    """Print the measurements, under the dataset's name if there are several; return the errors."""
    from lorasp_jax.evaluation import held_out

    title = "mean error" + f" on {dataset}" * bool(dataset)
    console.print(_table(title, held_out.COLUMNS, held_out.table(found), 2))
    if len(found.instructions) > 1:
        title += " by instruction [standard deviations]"
        console.print(_table(title, held_out.DONE, found.instructions, 3))
    errors = [found.policy.mean, found.hold.mean, found.repeat.mean]
    _say_errors(errors, console, dataset)
    return errors


def _say_errors(errors: Sequence[float], console: Console, of: str) -> None:
    text = f"{of}: " * bool(of) + (
        "action error {:.3f}, holding still {:.3f}, repeating the previous action {:.3f} (standard "
        "deviations of the recorded actions)".format(*errors)
    )
    console.print(text, soft_wrap=True, highlight=False, markup=False)


def record(options: argparse.Namespace, console: Console) -> None:
    """Write episodes of a run's policy in simulation, one dataset for each of its tasks.

    Raises:
        ValueError: there is no such run, its tasks cannot be simulated, or a dataset exists.
    """
    from lorasp_jax.base import compilation_cache as cache
    from lorasp_jax.base.bars import bars
    from lorasp_jax.evaluation import recording
    from lorasp_jax.training import export, finished_run

    cache.enable()
    config = finished_run.recorded_config(options.run)
    folders = {task: options.record / task for task in config.tasks}
    if exists := next(filter(Path.exists, folders.values()), None):  # before hours of simulation
        raise ValueError(f"{exists} already exists: choose another path")
    if steps := options.denoise_steps:
        evaluation = dataclasses.replace(config.evaluation, denoise_steps=steps)
        config = dataclasses.replace(config, evaluation=evaluation)
    policy = export.load_policy(options.run, dataset=options.dataset)
    settings = {"seed": options.seed}
    for task, folder in folders.items():
        with bars(console, "episodes") as progress:
            bar = progress.add_task(f"recording {task}", total=options.rollouts)
            settings |= {"progress": functools.partial(progress.advance, bar)}
            wins = recording.write(policy, config, task, folder, options.rollouts, **settings)
        text = f"{folder}: {wins} of {options.rollouts} episodes succeeded"
        console.print(text, soft_wrap=True, highlight=False, markup=False)


def _check_period(options: argparse.Namespace, source: "Source", trained: float) -> None:
    """Raise ValueError unless the dataset has the period [s] of the run."""
    from lorasp_jax.data import dataset_file
    from lorasp_jax.data.lerobot import LeRobot
    from lorasp_jax.data.source import same_period

    recorded = source.control_dt
    if same_period(recorded, trained):
        return
    remedy = "pass --every N to keep every N-th frame"
    if recorded > trained:
        remedy = "record more often"
    elif not isinstance(source, LeRobot):
        remedy = "only LeRobot datasets can be read at a longer one; convert yours with --every N"
    elif dataset_file.is_file(options.data):
        remedy = f"write every = N into {options.data} to keep every N-th frame"
    raise ValueError(
        f"{options.data} has a control period of {recorded:.4g} s, but {options.run} was "
        f"trained with {trained:.4g} s: {remedy}"
    )


def _table(
    title: str, columns: Sequence[str], rows: Mapping[str, Sequence[float]], digits: int
) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0))
    table.add_column(escape(title))
    for column in columns:
        table.add_column(column, justify="right")
    for name, values in rows.items():
        table.add_row(escape(name), *(f"{value:.{digits}f}" for value in values))
    return table


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
