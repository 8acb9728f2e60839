"""Read the config of a finished run."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lorasp_jax import peft
from lorasp_jax.config import (
    AugmentConfig,
    AuxiliaryConfig,
    Config,
    DataConfig,
    EvaluationConfig,
    ModelConfig,
    OptimConfig,
)
from lorasp_jax.config.recap import RecapConfig
from lorasp_jax.peft.plan import RankPlan
from lorasp_jax.training import records
from lorasp_jax.training.run_folder import CONFIG_FILE, RELATIVE, read_json, recorded_ranges

_GROUPS: dict[str, Any] = {
    "model": ModelConfig,
    "data": DataConfig,
    "optim": OptimConfig,
    "auxiliary": AuxiliaryConfig,
    "evaluation": EvaluationConfig,
}


def recorded_config(run: Path, *, simulated: bool = True) -> Config:
    """Return the config of a finished run, with the robot and the tasks of its policy.

    Raises:
        ValueError: the run is not finished, its config has settings that this version lacks, or,
            if they are to be `simulated`, its tasks cannot be.
    """
    from lorasp_jax.training import export  # heavy, and finished studies need no run

    finished = read_json(run / "results.json", records.RESULTS)
    recorded = finished and read_json(run / CONFIG_FILE, records.CONFIG)  # a base has one, too
    if not recorded:
        raise ValueError(f"{run} is not a finished run: it needs {CONFIG_FILE} and results.json")
    if simulated and not finished["tasks"]:
        raise ValueError(f"the tasks of {run} cannot be simulated")
    described = export.describe(run)  # config.json is older than a dataset, which decides these
    try:
        config = _from_json(recorded, tuple(finished["tasks"] or described["tasks"]))
    except TypeError as error:
        raise ValueError(f"{run / CONFIG_FILE} has settings of another version: {error}") from error
    return dataclasses.replace(config, robot=described["robot"])


def _from_json(recorded: Mapping[str, Any], tasks: tuple[str, ...]) -> Config:
    """Undo `run_folder.to_json`, but for what only a kind of run has that has a start run."""
    left_out = ("scene", "digest", "online", "distill")
    fields = {name: value for name, value in recorded.items() if name not in left_out}
    data = dict(fields["data"])
    augment, validation = ("none", "0") if data["source"] else ("auto", "auto")
    data["augment"] = AugmentConfig(**data.get("augment", {"preset": augment}))
    data["validation"] = tuple(data.get("validation", [validation]))
    data["source"] = (data["source"],) if isinstance(data["source"], str) else data["source"]
    for name in ("source", "weights", "cameras"):
        data[name] = tuple(data.get(name, ()))
    fields["data"] = data
    model = fields["model"]
    fields["model"] = {**model, "relative_actions": RELATIVE[model["relative_actions"]]}
    for name, group in _GROUPS.items():
        fields[name] = group(**fields[name])
    fields["peft"] = recorded_method(fields["peft"])
    fields["plan"] = recorded_plan(recorded)
    if scene := recorded_ranges(recorded):
        fields["scene"] = scene
    if "recap" in fields:
        fields["recap"] = RecapConfig(**fields["recap"])
    lists = {name: tuple(fields.get(name, ())) for name in ("targets", "adapt")}
    return Config(**fields | {"tasks": tasks, **lists})


def recorded_plan(recorded: Mapping[str, Any]) -> RankPlan | None:
    """Return the plan of a recorded config, if it has one."""
    return RankPlan.from_json(recorded["plan"]) if "plan" in recorded else None


def recorded_method(settings: Mapping[str, Any]) -> peft.Method:
    """Return the method of a recorded config, which names its class."""
    names = (name for name in peft.names() if peft.find(name).__name__ == settings["method"])
    return peft.from_settings({**settings, "method": next(names, "")})
