"""From the command line to a `Config`: an experiment file, a scale, a method, dotted overrides."""

import argparse
import contextlib
import dataclasses
import difflib
import importlib.util
import io
import itertools
import os
import typing
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import jax
import tyro

from envs.names import check
from lorasp_jax import peft
from lorasp_jax.config import SCALES, Config
from lorasp_jax.peft import LoRASP
from lorasp_jax.storage import shipped
from lorasp_jax.training.help_text import REGISTRY
from lorasp_jax.training.scales import differences

HELP = {"-h", "--help"}


@dataclasses.dataclass(frozen=True)
class Command:
    """What the command line asks for.

    Attributes:
        config: the experiment.
        resume: whether to go on with the run of this name; "auto": if there is one.
        dry_run: whether to stop before anything is collected, trained or written.
        wandb: project of Weights & Biases, or None.
    """

    config: Config
    resume: bool | Literal["auto"] = False
    dry_run: bool = False
    wandb: str | None = None


def parse(arguments: Sequence[str], program: str = "python train.py") -> Command:
    """What `arguments` ask for.

    Args:
        arguments: the command line.
        program: how it was started, for the help.

    Raises:
        ValueError: an unknown config, scale, method, field, task or robot, or a value that does
            not fit.
        SystemExit: help was asked for and printed.
    """
    parser = _parser(program)
    try:
        known, rest = parser.parse_known_args(arguments)
    except argparse.ArgumentError as error:
        raise ValueError(str(error)) from error
    if bare := [name for name, value in vars(known).items() if isinstance(value, list)]:
        raise ValueError(f"--{bare[0]} needs a value, not --")  # which argparse drops
    wants_help = bool(HELP & set(rest))
    if wants_help and known.scale == "auto":
        known.scale = "cpu"  # to look at the devices, JAX would have to start
    if known.config is not None:
        config = load(known.config, choose_scale(known.scale))
    elif wants_help:
        config = Config(name="NAME", scale=known.scale, peft=LoRASP())
    else:
        _check_names(rest, Config(name="NAME", scale=known.scale, peft=LoRASP()))
        parser.print_help()
        raise ValueError("no experiment was named: add --config, such as configs/multitask.py")
    if wants_help:
        _parser(program, config.peft.name).print_help()
        print(f"\n{_on_scales(known.config, known.scale)}")
        rest = ["--help"]  # it may stand where an option wants its value
    if known.method is not None:
        config = dataclasses.replace(config, peft=_switch(config.peft, known.method))
    if known.resume and known.dry_run:
        raise ValueError("a run is either resumed or tried dry: leave --resume or --dry-run out")
    config = override(config, rest, program)
    _check_simulated(config)
    return Command(config, known.resume, known.dry_run, known.wandb)


def parser(program: str) -> argparse.ArgumentParser:
    """All options with the default method's, for completion."""
    parser = argparse.ArgumentParser(
        prog=program, parents=[_parser(program)], add_help=False, conflict_handler="resolve"
    )
    for name, kind in _fields(Config(name="NAME", scale="cpu", peft=LoRASP())):
        choices = get_args(kind) if get_origin(kind) is Literal else None
        parser.add_argument(f"--{name}", choices=choices)
    parser.add_argument("--help", action="store_true")
    return parser


def _parser(program: str = "", method: str = "") -> argparse.ArgumentParser:
    """The options that are no fields of a config.

    Args:
        program: how it was started.
        method: the experiment's, for its help.
    """
    parser = argparse.ArgumentParser(
        prog=program,
        add_help=False,
        exit_on_error=False,
        allow_abbrev=False,
        usage=f"{program} --config FILE [options] [fields]",
    )
    parser.add_argument("--config", type=Path, help="experiment file, such as configs/multitask.py")
    auto = "auto (the default: cpu on a CPU, accelerator elsewhere)"
    parser.add_argument("--scale", default="auto", help=f"{auto}, {', '.join(SCALES)}")
    methods = ", ".join(peft.names())
    default = ", ".join(filter(None, ["the experiment's", method]))
    parser.add_argument("--method", help=f"adapter method: {methods} (default: {default})")
    parser.add_argument(
        "--resume",
        nargs="?",
        const=True,
        default=False,
        choices=["auto"],
        help="continue the run of this name; with auto, start it if there is none",
    )
    parser.add_argument(
        "--dry-run", action="store_true", help="print sizes and memory, compile, stop"
    )
    parser.add_argument(
        "--wandb", metavar="PROJECT", help="log to Weights & Biases, too; needs pip install wandb"
    )
    parser.add_argument(
        "--distributed",
        action="store_true",
        help="train together with the other processes of the launcher, see docs/launch.md",
    )
    return parser


def _on_scales(path: Path | None, scale: str) -> str:
    """Which scale the fields in a help are of, and what another one would change."""
    if path is None:
        return "the fields below have their own defaults; with --config FILE, the experiment's"
    changed = differences(lambda scale: load(path, scale))
    return f"{changed}the defaults below are those of --scale {scale}"


def choose_scale(scale: str) -> str:
    """The named scale; "auto" is cpu on a CPU backend and accelerator elsewhere."""
    if scale == "auto":
        return "cpu" if jax.default_backend() == "cpu" else "accelerator"
    if scale not in SCALES:
        raise ValueError(f"unknown scale {scale!r}: it is one of auto, {', '.join(SCALES)}")
    return scale


def load(path: Path, scale: str) -> Config:
    """What the experiment file's `get_config(scale)` returns.

    Shipped experiments, configs/multitask.py, are found from any folder.

    Raises:
        ValueError: there is no such file, its code fails, or it returns something else.
    """
    ours = shipped.ROOT / path
    if shipped.is_one(path, shipped.EXPERIMENTS) and not os.path.exists(path):
        path = ours if os.path.isfile(ours) else path
    if not os.path.isfile(path):  # Path.is_file raises where a name is too long
        folder = path.parent if os.path.isdir(path.parent) else shipped.ROOT / shipped.EXPERIMENTS
        found = ", ".join(str(file) for file in sorted(folder.glob("*.py")))
        raise ValueError(f"there is no config {path}" + (f": found {found}" if found else ""))
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
        if not hasattr(module, "get_config"):
            raise ValueError("it has no function get_config(scale)")
        config = module.get_config(scale)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # whatever a file's code raises
        reason = str(error).partition("\n")[0]
        raise ValueError(f"{path} gives no config ({type(error).__name__}: {reason})") from error
    if not isinstance(config, Config):
        raise ValueError(f"{path} gives {type(config).__name__} in place of a Config")
    return config


def override(config: Config, arguments: Sequence[str], program: str = "") -> Config:
    """Apply dotted overrides such as `--peft.rank 64 --optim.steps 100`."""
    wants_help = bool(HELP & set(arguments))
    config, arguments = _with_parts(config, arguments, every=wants_help)
    _check_names(arguments, config)
    printed = io.StringIO()
    quiet = contextlib.nullcontext() if wants_help else contextlib.redirect_stderr(printed)
    try:
        with quiet:
            chosen = tyro.cli(
                _concrete(config),
                default=config,
                args=list(arguments),
                prog=program,
                registry=REGISTRY,
                config=(tyro.conf.AvoidSubcommands,),
            )
    except SystemExit as error:
        if wants_help:
            raise
        raise ValueError(_sentence(printed.getvalue())) from error
    names = (field.name for field in dataclasses.fields(Config))
    return Config(**{name: getattr(chosen, name) for name in names})


def _with_parts(
    config: Config, arguments: Sequence[str], *, every: bool
) -> tuple[Config, list[str]]:
    """The config with the optional parts of its method that are named, and the other arguments.

    `--peft.schedule.start 0.5` adds a schedule, `--peft.schedule None` takes it away. `every`: as
    if all parts were named, to list their options.
    """
    method: Any = config.peft
    rest = [part for a in arguments for part in (a.split("=") if a.endswith("=None") else [a])]
    parts: dict[str, Any] = {}
    for name, kind in typing.get_type_hints(type(method)).items():
        part: Any
        for part in filter(dataclasses.is_dataclass, typing.get_args(kind)):
            option, held = f"--peft.{name}", getattr(method, name)
            if [option, "None"] in map(list, itertools.pairwise(rest)):
                at = rest.index(option)
                del rest[at : at + 2]
                parts[name] = None
            elif held is None and (every or any(a.startswith(f"{option}.") for a in rest)):
                parts[name] = part()
    return dataclasses.replace(config, peft=dataclasses.replace(method, **parts)), rest


def _check_names(arguments: Sequence[str], config: Config) -> None:
    """Raise ValueError for an option that is neither a field nor one of ours."""
    fields = ["--" + name for name, _ in _fields(config)]
    for argument in arguments:
        name = argument.split("=")[0].replace("_", "-")
        if name.startswith("--") and name not in (*fields, "--help"):
            others = ["--" + name.replace("_", "-") for name in vars(_parser().parse_args([]))]
            close = difflib.get_close_matches(name, fields + others, n=1, cutoff=0.5)
            hint = f": did you mean {close[0]}?" if close else f": fields are {' '.join(fields)}"
            raise ValueError(f"unknown option {name}{hint}")


def _check_simulated(config: Config) -> None:
    """Raise ValueError for an unknown task or robot, before what simulates them is imported.

    A dataset says its own.
    """
    if config.data.source:
        return
    for task in config.tasks:
        check("task", task)
    if not config.robot.endswith(".xml"):  # a user's own
        check("robot", config.robot)


def _sentence(message: str) -> str:
    """The first paragraph under the heading of tyro's framed error message, as one line."""
    lines = [line.strip(" │╭╮╰╯─-") for line in message.splitlines()]
    body = itertools.takewhile(bool, itertools.dropwhile(lambda line: not line, lines[1:]))
    return " ".join(body).removeprefix("Error parsing ").removeprefix("Config: ")


def _switch(current: peft.Method, name: str) -> peft.Method:
    """Another method with the rank of the current one, where it has a rank."""
    method = peft.create(name)
    if hasattr(method, "rank") and hasattr(current, "rank"):
        return dataclasses.replace(method, rank=current.rank)  # type: ignore[call-arg]
    return method


def _fields(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names of all fields, as options spell them, and their types."""
    for field in dataclasses.fields(config):
        value, name = getattr(config, field.name), prefix + field.name.replace("_", "-")
        if dataclasses.is_dataclass(value):
            yield from _fields(value, f"{name}.")
        else:
            yield name, field.type


def _concrete(config: Config) -> type[Config]:
    """`Config` with `peft` typed as the method that is chosen, so that its fields can be set.

    The scale is none of its options: it has chosen their defaults.
    """
    return dataclasses.make_dataclass(
        "Config",
        [
            ("peft", type(config.peft), dataclasses.field()),
            ("scale", tyro.conf.Suppress[str], dataclasses.field()),
        ],
        bases=(Config,),
        frozen=True,
        kw_only=True,
    )
