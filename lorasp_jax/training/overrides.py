"""Parse the command line into a `Config`: experiment file, scale, method and dotted overrides."""

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import tyro

from envs.names import check
from lorasp_jax import peft
from lorasp_jax.config import SCALES, Config
from lorasp_jax.peft import LoRASP, plan
from lorasp_jax.training import experiment_file

HELP = {"-h", "--help"}


@dataclasses.dataclass(frozen=True)
class Command:
    """A parsed command line.

    Attributes:
        resume: resume the run of this name; "auto": only if it exists.
        dry_run: stop before anything is collected, trained or written.
        wandb: Weights & Biases project.
        fit: memory of the GPU that the run is to fit into, such as 16GB.
        given: names of the fields that the command line sets, such as "optim.accumulate".
    """

    config: Config
    resume: bool | Literal["auto"] = False
    dry_run: bool = False
    wandb: str | None = None
    fit: str | None = None
    given: frozenset[str] = frozenset()


def parse(arguments: Sequence[str], program: str = "python train.py") -> Command:
    """Parse command-line arguments; `program` is the program name in the help text.

    Raises:
        ValueError: an unknown config, scale, method, task or robot, or an invalid value.
        SystemExit: after printing the help text, or what is wrong with a field.
    """
    parser = _option_parser(program)
    try:
        known, rest = parser.parse_known_args(arguments)
    except argparse.ArgumentError as error:
        raise ValueError(str(error)) from error
    # For the value "--", argparse returns an empty list.
    if missing := [name for name, value in vars(known).items() if isinstance(value, list)]:
        raise ValueError(f"--{missing[0]} needs a value")
    wants_help = bool(HELP & set(rest))
    if wants_help and known.scale == "auto":
        known.scale = "cpu"  # avoids initializing JAX
    if known.config is not None:
        config = load(known.config, choose_scale(known.scale))
    elif wants_help:
        config = Config(name="NAME", scale=known.scale, peft=LoRASP())
    else:
        parser.print_help()
        raise ValueError("--config is required, for example --config configs/multitask.py")
    if wants_help:
        _option_parser(program, config.peft.name).print_help()
        defaults = f"for --scale {known.scale}" if known.config else "built-in"
        print(f"\nthe defaults below are {defaults}")
        rest = ["--help"]  # the rest may be incomplete, as in --seed --help
    if known.method is not None:
        config = dataclasses.replace(config, peft=_with_rank_of(config.peft, known.method))
    if known.resume and known.dry_run:
        raise ValueError("--resume and --dry-run cannot be combined")
    config = override(config, rest, program)
    if known.plan is not None:
        config = dataclasses.replace(config, plan=plan.read(known.plan))
    _check_simulated(config)
    _check_rules(config, ["--method"] * bool(known.method) + rest)
    given = _given(known, rest)
    if "tasks" in given and config.data.source:
        raise ValueError("--tasks names simulated tasks, but --data.source decides them: drop it")
    if known.plan and "peft.rank" in given:
        raise ValueError(
            "--peft.rank and --plan, which has the ranks, cannot be combined: drop one"
        )
    return Command(config, known.resume, known.dry_run, known.wandb, known.fit, given)


def _given(known: argparse.Namespace, rest: Sequence[str]) -> frozenset[str]:
    """Return the names of the fields that the command line sets."""
    options = (text.partition("=")[0] for text in rest if text.startswith("--"))
    given = frozenset(option.lstrip("-").replace("-", "_") for option in options)
    return given | ({"peft"} if known.method else set()) | ({"plan"} if known.plan else set())


def _option_parser(program: str = "", method: str = "") -> argparse.ArgumentParser:
    """Return a parser for the options that are not config fields.

    `program` and `method`, the experiment's method, appear in the help text.
    """
    parser = argparse.ArgumentParser(
        prog=program,
        add_help=False,
        exit_on_error=False,
        allow_abbrev=False,
        usage=f"{program} --config FILE [options] [--FIELD VALUE ...]",
    )
    parser.add_argument("--config", type=Path, help="experiment file, such as configs/multitask.py")
    auto = "auto (default: cpu on a CPU, accelerator elsewhere)"
    parser.add_argument(
        "--scale", default="auto", help=f"size preset: {', '.join(SCALES)} or {auto}"
    )
    methods = ", ".join(peft.names())
    default = ", ".join(filter(None, ["the experiment's", method]))
    parser.add_argument("--method", help=f"adapter method: {methods} (default: {default})")
    text = "ranks by layer for lora or dora, as written by lorasp-jax allocate"
    parser.add_argument("--plan", type=Path, metavar="FILE", help=text)
    text = "resume the run of this name; with auto, start it if it does not exist"
    resume: Any = {"nargs": "?", "const": True, "default": False, "choices": ["auto"]}
    parser.add_argument("--resume", help=text, **resume)
    parser.add_argument(
        "--dry-run",
        action="store_true",
        help="compile (minutes on a CPU), print sizes and memory, then exit",
    )
    text = "choose remat, accumulate and dtypes so that the run fits into a GPU of this memory"
    parser.add_argument("--fit", metavar="SIZE", help=f"{text}, such as 16GB or 14.5GiB")
    parser.add_argument(
        "--wandb", metavar="PROJECT", help="also log to Weights & Biases; needs pip install wandb"
    )
    parser.add_argument(
        "--distributed",
        action="store_true",
        help="train in several processes started by a launcher, see docs/launch.md",
    )
    return parser


def choose_scale(scale: str) -> str:
    """Return the named scale; "auto" is cpu on a CPU backend and accelerator elsewhere."""
    if scale == "auto":
        return "cpu" if jax.default_backend() == "cpu" else "accelerator"
    if scale not in SCALES:
        raise ValueError(f"unknown scale {scale!r}: choose one of auto, {', '.join(SCALES)}")
    return scale


def load(path: Path, scale: str) -> Config:
    """Load an experiment file and call its `get_config(scale)` (see `experiment_file.call`).

    Raises:
        ValueError: the file is missing, its code fails, or `get_config` does not return a `Config`.
    """
    config = experiment_file.call(path, "get_config", scale)
    if not isinstance(config, Config):
        raise ValueError(f"get_config in {path} must return a Config, got {type(config).__name__}")
    return config


def override(config: Config, arguments: Sequence[str], program: str = "") -> Config:
    """Apply dotted overrides such as `--peft.rank 64 --optim.steps 100`.

    Raises:
        SystemExit: after printing the help text, or what is wrong with a field.
    """
    shown = dataclasses.replace(config, peft=_without_ranks(config.peft))
    parsed = tyro.cli(
        _concrete(shown),
        default=shown,
        args=[*arguments],
        prog=program,
        config=(tyro.conf.AvoidSubcommands,),
    )
    values = _fields(parsed, config)
    values["peft"] = type(config.peft)(**_fields(parsed.peft, config.peft))
    return type(config)(**values)


def _fields(value: Any, like: Any) -> dict[str, Any]:
    """Return the values of the fields that a dataclass has."""
    return {field.name: getattr(value, field.name) for field in dataclasses.fields(like)}


def _without_ranks(method: peft.Method) -> peft.Method:
    """Return a method that hides its `ranks`, which a plan sets, from the command line."""
    kind = type(method)
    if not hasattr(method, "ranks"):
        return method
    hidden = ("ranks", tyro.conf.Suppress[tuple[int, ...]], dataclasses.field(default=()))
    same = {"__module__": kind.__module__, "__doc__": kind.__doc__}
    options: Any = {"bases": (kind,), "frozen": True, "namespace": same}
    return dataclasses.make_dataclass(kind.__name__, [hidden], **options)(**_fields(method, kind))


def _check_rules(config: Config, arguments: Sequence[str]) -> None:
    """Raise ValueError for invalid rules or targets, and for options that `adapt` would ignore."""
    from lorasp_jax.training import rules  # imports models, which is slow

    rules.named_rules(config)
    if not config.adapt:
        return
    if any(text.startswith("--targets") for text in arguments):
        raise ValueError("--targets cannot be combined with --adapt, whose rules name layers")
    used = {text.rpartition("=")[2].partition(":")[0] for text in config.adapt}
    given = [text for text in arguments if text.startswith(("--method", "--peft."))]
    if given and config.peft.name not in used:
        raise ValueError(
            f"{given[0]} sets {config.peft.name}, but no rule TARGET={config.peft.name} of --adapt "
            "takes its settings: drop it"
        )


def _check_simulated(config: Config) -> None:
    """Raise ValueError for an unknown task or robot, before the simulator is imported.

    With a dataset, which defines its own tasks and robot, nothing is checked.
    """
    if config.data.source:
        return
    for task in config.tasks:
        check("task", task)
    if not config.robot.endswith(".xml"):  # .xml: the user's own MJCF file
        check("robot", config.robot)


def _with_rank_of(current: peft.Method, name: str) -> peft.Method:
    """Create the method `name` with the rank of the current method, if both have one."""
    method = peft.create(name)
    if hasattr(method, "rank") and hasattr(current, "rank"):
        return dataclasses.replace(method, rank=current.rank)  # type: ignore[call-arg]
    return method


def _concrete(config: Config) -> type[Config]:
    """Return a config class whose `peft` has the chosen method's type, to expose its fields.

    `scale`, which only selects defaults, and `plan`, which is a file's content, are hidden.
    """
    return dataclasses.make_dataclass(
        "Config",
        [
            ("peft", type(config.peft), dataclasses.field()),
            ("scale", tyro.conf.Suppress[str], dataclasses.field()),
            ("plan", tyro.conf.Suppress[plan.RankPlan | None], dataclasses.field()),
        ],
        bases=(type(config),),
        frozen=True,
        kw_only=True,
    )
