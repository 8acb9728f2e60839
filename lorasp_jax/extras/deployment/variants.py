"""Make and save the deployment variants of a policy: forms of its adapters times bases."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters import adaptation
from lorasp_jax.base import compilation_cache as cache
from lorasp_jax.base.files import check_local
from lorasp_jax.config import Config
from lorasp_jax.extras.deployment import healing
from lorasp_jax.extras.study.held_out import held_out_demonstrations
from lorasp_jax.training import activations, dataset, export, records, rules, start
from lorasp_jax.training.base import in_bf16, quantized
from lorasp_jax.training.demonstrations import Demonstrations, demonstrations
from lorasp_jax.training.finished_run import recorded_config
from lorasp_jax.training.fixed_batches import Keyed, forward, keyed_batches
from lorasp_jax.training.run import Run
from lorasp_jax.training.run_folder import read_json

BATCH_SIZE, BATCHES = 64, 8
"""Windows per batch, and batches per task, for calibration and for the loss."""

Batches = Sequence[Keyed]
"""Batches with the keys of their losses."""


def _pruned(model: nnx.Module, batches: Batches) -> nnx.Module:
    return lorasp_jax.prune(model, batches, for_kernel=True, forward=forward)[0]


def _half(model: nnx.Module, batches: Batches) -> nnx.Module:
    return lorasp_jax.prune(model, batches, rank=0.5, forward=forward)[0]


def _distilled(model: nnx.Module, batches: Batches) -> nnx.Module:
    return lorasp_jax.distill(model, batches, forward=forward)[0]


FORMS: dict[str, Callable[[nnx.Module, Batches], nnx.Module]] = {
    "whole": lambda model, _: model,
    "pruned": _pruned,
    "half": _half,
    "lora": _distilled,
    "merged": _distilled,
}
"""Forms by name: as trained; pruned to the directions in use on calibration data, and those more
that a kernel needs; pruned to the most used half of the bank; distilled to LoRA; and merged."""
BASES: dict[str, Literal["int8", "nf4"] | None] = {"bf16": None, "int8": "int8", "nf4": "nf4"}
"""How the base is stored."""


WHOLE = "whole-bf16"
"""The variant that others are compared with."""
VARIANTS = (WHOLE, *(f"{f}-{b}" for f in FORMS for b in BASES if f"{f}-{b}" != WHOLE))
"""All of LoRA-SP's."""


def transform(
    name: str, policy: lorasp_jax.policies.Policy, episodes: Demonstrations
) -> lorasp_jax.policies.Policy:
    """Return a variant of a policy, calibrated on episodes by task; all count alike."""
    form, base = name.split("-")
    return on_base(in_form(policy, form, episodes), base)


def check(name: str, run: Path) -> str:
    """Return the name of a variant of a run.

    Raises:
        ValueError: the run has no such variant.
    """
    if name not in (known := of_run(run)):
        raise ValueError(f"unknown variant {name!r}: choose one of {', '.join(known)}")
    return name


def of_run(run: Path) -> tuple[str, ...]:
    """Return the variants of a finished run.

    Without LoRA-SP's bank, there is nothing to prune or to distill: adapters stay whole or are
    merged, those of LoRA-MoE and a base that was trained itself only stay whole.
    """
    methods = rules.methods(recorded_config(run, simulated=False))
    if any(map(_is_bank, methods)):
        return VARIANTS
    fixed = any(method.trains_base or isinstance(method, lorasp_jax.LoRAMoE) for method in methods)
    forms = ("whole",) if fixed else ("whole", "merged")
    return tuple(f"{form}-{base}" for form in forms for base in BASES)


def _is_bank(method: Any) -> bool:
    return isinstance(method, lorasp_jax.LoRASP | lorasp_jax.LoRASPRelease)


def in_form(
    policy: lorasp_jax.policies.Policy,
    form: str,
    data: Demonstrations | Run,
    heal: Callable[[lorasp_jax.policies.Policy], lorasp_jax.policies.Policy] | None = None,
) -> lorasp_jax.policies.Policy:
    """Return a policy whose adapters have another form, and whose frozen weights are in bf16.

    Args:
        policy: not modified.
        form: one of `FORMS`; without a bank, "whole" or "merged".
        data: calibrates; episodes by task, of which all tasks count alike, or a run whose data do.
        heal: trains the adapters before they are merged, such as `healing.heal`; None: do not.
    """
    model = in_bf16(policy.model)
    policy = dataclasses.replace(policy, model=model)
    if _needs_data(policy, form):
        policy = dataclasses.replace(policy, model=FORMS[form](model, batches(policy, data)))
    if heal:
        policy = heal(policy)
    if form == "merged":
        policy = dataclasses.replace(policy, model=in_bf16(lorasp_jax.merge(policy.model)))
    return policy


def _needs_data(policy: lorasp_jax.policies.Policy, form: str) -> bool:
    """Return whether data calibrate a form of a policy."""
    return form != "whole" and any(map(_is_bank, adaptation.methods(policy.model).values()))


def batches(policy: lorasp_jax.policies.Policy, data: Demonstrations | Run) -> Batches:
    """Return what calibrates a form of a policy; see `in_form`."""
    if isinstance(data, Run):
        return [*activations.sampled(data, policy.processor, policy.model.config.chunk)]
    by_task = keyed_batches(policy, data, BATCH_SIZE, BATCHES)
    return [pair for pairs in by_task.values() for pair in pairs]


def on_base(policy: lorasp_jax.policies.Policy, base: str) -> lorasp_jax.policies.Policy:
    """Return the policy with its base stored as one of `BASES`."""
    return dataclasses.replace(policy, model=quantized(policy.model, BASES[base]))


def check_run(run: Path, task: str = "", *, simulated: bool = False) -> None:
    """Raise ValueError unless a run is finished.

    Variants are only compared if its tasks can be `simulated`. A run that has learned its noise is
    refused, too: other weights need other noise; and so is a `task`, if given, that is none of its
    own.
    """
    config = recorded_config(run, simulated=False)
    if simulated and not _is_simulated(run):
        raise ValueError(
            f"the tasks of {run} cannot be simulated: make a variant with --save, and compare it "
            "with the run by lorasp-jax evaluate"
        )
    start.refuse_actor(run, "make variants of the run that it started from")
    spoken = () if _is_simulated(run) else export.describe(run)["policy"]["instructions"]
    if task and task not in (*config.tasks, *spoken):
        more = ", or one of its instructions" * bool(spoken)
        known = f"{', '.join(config.tasks)}{more}"
        raise ValueError(f"{run} has no task {task!r}: choose one of {known}")


def save(run: Path, name: str, out: Path, heal: int = 0, task: str = "") -> dict[str, Any]:
    """Make one variant of a run, write it to a new folder, and return what calibrated it.

    That is the `data`, its `episodes` and `frames`, and the number of `windows` drawn from them; {}
    if nothing did.

    The folder has the adapters and refers to the run's base, or has the merged weights. A base in
    int8 or nf4 is quantized whenever the folder is loaded. `heal` is the number of steps by which
    the adapters of the form train on, see `healing.heal`. With a `task` of the run, that task's
    demonstrations alone calibrate and heal the form, which then has its instructions alone. If the
    tasks cannot be simulated, the run's recordings calibrate, and `task` may be an instruction.

    Raises:
        ValueError: the variant is unknown, the folder exists, the run cannot be healed, its data
            are gone, or they are not all that a calibrated form must keep, since the run protects
            another's; see also `dataset.limit` and `healing.check_datasets`.
    """
    form, base = check(name, run).split("-")
    check_local(out)
    if out.exists():
        raise ValueError(f"{out} exists already: choose another --out")
    if heal:
        healing.check(run, task)
    config = recorded_config(run, simulated=False)
    if config.protect and form != "whole" and not task:
        raise ValueError(
            f"{run} also knows what {config.protect} learned, but its own data alone would "
            f"calibrate a {form} form: save a whole one, or one for a --task of its own"
        )
    cache.enable()
    policy = export.load_policy(run)
    tasks, data, phrases = (task,) if task else (), {}, ()
    if not (simulated := _is_simulated(run)):
        healing.check_datasets(run)
    if task or _needs_data(policy, form):
        if simulated:  # on what `measurement` calibrates
            config = dataclasses.replace(config, tasks=tasks or config.tasks)
            data = held_out_demonstrations(run / "deployment", config)
            phrases = data[task].instructions if task else ()
        else:
            data = start.with_data(config, run, policy.model.config, demonstrations)
            phrases = dataset.limit(data, task) if task else ()
    calibration = _described(config, data) if _needs_data(policy, form) else {}
    train = functools.partial(healing.heal, run=run, steps=heal, task=task) if heal else None
    deployed = in_form(policy, form, data, train)
    if task:
        deployed = _with_instructions(deployed, phrases)
    made = {key: x for key, x in (("calibration", calibration), ("healed", heal)) if x}
    export.write_variant(out, deployed, run, tasks=tasks, quantized=BASES[base], record=made)
    return calibration


def _described(config: Config, data: Demonstrations | Run) -> dict[str, Any]:
    """Describe what calibrates a form, as `save` returns it."""
    if isinstance(data, Run):
        cache, starts = data.recordings, data.steps.start(np.arange(data.steps.num_starts))
        assert cache is not None
        source = " + ".join(config.data.source)
        count, frames = len(np.unique(cache.episodes[starts])), len(starts)
        windows = activations.BATCHES * config.optim.batch_size
    else:
        groups, source = data.values(), f"simulated demonstrations of {', '.join(data)}"
        count, frames = (sum(getattr(g, n) for g in groups) for n in ("num_episodes", "num_steps"))
        windows = BATCHES * BATCH_SIZE * len(data)
    return {"data": source, "episodes": count, "frames": frames, "windows": windows}


def _is_simulated(run: Path) -> bool:
    """Return whether the tasks of a finished run were evaluated in simulation."""
    return bool(read_json(run / "results.json", records.RESULTS)["tasks"])


def _with_instructions(
    policy: lorasp_jax.policies.Policy, instructions: Sequence[str]
) -> lorasp_jax.policies.Policy:
    """Return the policy with only some of its instructions."""
    prompts = policy.processor.prompts.only(instructions)
    processor = dataclasses.replace(policy.processor, prompts=prompts)
    return dataclasses.replace(policy, processor=processor)
