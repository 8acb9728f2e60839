"""Where a run starts: the policy of a finished run, or a base with new adapters."""

import dataclasses
from collections.abc import Collection
from pathlib import Path
from typing import Any

from flax import nnx
from rich.console import Console

from lorasp_jax import models
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io import native
from lorasp_jax.base import hub
from lorasp_jax.config import Config
from lorasp_jax.models.noise_actor import PATH
from lorasp_jax.peft import LoRAMoE, LoRASP, LoRASPRelease
from lorasp_jax.policies.policy import Policy
from lorasp_jax.reinforce.config import ReinforceConfig
from lorasp_jax.training import export, rules, setup
from lorasp_jax.training import start as starts
from lorasp_jax.training.export import describe, load_policy
from lorasp_jax.training.finished_run import recorded_config
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run import Callback, Run
from lorasp_jax.training.run_folder import CONFIG_FILE, MERGED, read_json
from lorasp_jax.training.start import ADAPTERS, KEPT, with_kept

_ACTING = ("execute_steps", "denoise_steps")
"""Fields of its evaluation that it decides unless they are given: how the policy acts."""
_TEACHERS = tuple(
    f"online.{name}"
    for name in ("teacher_worlds", "teacher_learning_rate", "rounds", "gradient_steps")
)
_ADAPTERS = (
    *("online.adapters", "online.correlation", "auxiliary"),
    *("optim.weight_decay", "optim.b2", "optim.clip_norm", "optim.accumulate"),
)
_OTHERS = {
    "teacher": ("online.epochs",),
    "ppo": _TEACHERS,
    "noise": (*_TEACHERS, *_ADAPTERS),
    "actions": ("online.noise_level",),
    "sde": ("online.std", "online.correlation"),
}
"""Method or exploration -> settings, or groups of them, of another one."""


def resolve(config: ReinforceConfig, given: Collection[str]) -> ReinforceConfig:
    """Return the config with what the start run decides.

    Args:
        config: as parsed.
        given: names of the fields that the user set.

    Raises:
        ValueError: the start run is not finished, its tasks cannot be simulated, or a field that
            it decides was given; it trained its base; several datasets have statistics or
            cameras of their own; or its adapters cannot be merged into its base.
    """
    method, groups = config.online.method, {name.partition(".")[0] for name in given}
    for kind in (method, config.online.exploration):
        if wrong := [name for name in _OTHERS[kind] if name in {*given, *groups}]:
            raise ValueError(f"{wrong[0]} is not for {kind}: drop it")
    if not config.online.start:
        if method == "noise":
            raise ValueError("online.method noise needs a finished run: name it with --from")
        return config
    start = Path(config.online.start)
    recorded = recorded_config(start)
    if "distill" in read_json(start / CONFIG_FILE):
        raise ValueError(f"{start} is distilled, which learning would undo: learn, then distill")
    kept = (*KEPT, *(ADAPTERS if config.online.adapters == "continue" else ()))
    drawn = [name.partition(".")[2] for name in given if name.startswith("scene.")]
    ranges = {name: getattr(config.scene, name) for name in drawn}
    scene = dataclasses.replace(recorded.scene, **ranges)  # another scene may be learned
    completed = with_kept(config, start, recorded, [x for x in kept if x != "scene"], given)
    completed = dataclasses.replace(completed, scene=scene)
    tasks = config.tasks if "tasks" in given else recorded.tasks
    if config.online.adapters == "merge":
        _check_mergeable(start, recorded)
    known = describe(start)["tasks"]
    if unknown := [task for task in tasks if task not in known]:
        raise ValueError(f"{start} has learned {', '.join(known)}, not {unknown[0]}")
    acting = {name: getattr(recorded.evaluation, name) for name in _ACTING}
    acting = {name: x for name, x in acting.items() if f"evaluation.{name}" not in given}
    evaluation = dataclasses.replace(config.evaluation, **acting)
    return dataclasses.replace(completed, tasks=tasks, evaluation=evaluation)


def _check_mergeable(start: Path, recorded: Config) -> None:
    by_input = (LoRASP, LoRASPRelease, LoRAMoE)
    for method in rules.methods(recorded):
        if isinstance(method, by_input):
            raise ValueError(
                f"the adapters of {start} ({method.name}) cannot be merged: drop --online.adapters"
            )
    if recorded.model.base_dtype:
        raise ValueError(f"the base of {start} is quantized: drop --online.adapters")


def load(config: ReinforceConfig, folder: Path, console: Console, started: float) -> Run:
    """Return a run with the policy that it starts with.

    Raises:
        ValueError: see `load_policy`, `setup.build` and `setup.check_sizes`.
    """
    if not config.online.start:
        return setup.prepare(config, folder, console, started)
    start = Path(config.online.start)
    policy = load_policy(start)
    base_hash = native.read_description(start)["base"]
    if config.online.adapters == "merge":
        models.save(folder / MERGED, adaptation.merge(policy.model))
        merged = models.load(folder / MERGED, policy.model.config)  # rounded, as it is saved
        base_hash = models.weights_hash(merged)
        rngs = nnx.Rngs(RandomStream.ADAPTERS.key(config.seed))
        policy = Policy(adaptation.adapt(merged, rules.rules(config), rngs=rngs), policy.processor)
    setup.check_sizes(config, policy.model.config.chunk)
    run = Run(config, folder, console, base_hash, started)
    run.policy = policy
    frozen = f"scale {config.scale}: the initial noise of a frozen {config.model.backbone}"
    steers = config.online.method == "noise"
    console.print(frozen if steers else setup.headline(config, policy.model))
    return run


class PolicyExport(Callback):
    """Exports the policy, as `train.py` does: `load_policy` loads it."""

    def on_end(self, run: Run) -> None:
        """Write adapter.safetensors and adapter.json."""
        config = run.config
        assert isinstance(config, ReinforceConfig)
        if not config.online.start:
            export.write(run)
            return
        merged = config.online.adapters == "merge"
        changes: dict[str, Any] = {}
        if merged:
            changes["base"] = hub.portable_path(str(run.folder / MERGED))
        if (actor := run.policy.model.noise_actor) is not None:
            changes[PATH] = actor.get_value().settings
        starts.write(run, Path(config.online.start), **changes)
