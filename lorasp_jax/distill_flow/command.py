"""`train.py` for a `DistillFlowConfig`."""

import dataclasses
import functools
from collections.abc import Collection
from pathlib import Path

from rich.console import Console

from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io import native
from lorasp_jax.config import Config
from lorasp_jax.distill_flow import objectives
from lorasp_jax.distill_flow.config import DistillFlowConfig
from lorasp_jax.evaluation.callback import Evaluation, NoEvaluation
from lorasp_jax.evaluation.validation import Validation
from lorasp_jax.models.sampling import NUM_STEPS
from lorasp_jax.peft import AdaLoRA
from lorasp_jax.report.callback import Report
from lorasp_jax.training import loop, setup
from lorasp_jax.training import start as starts
from lorasp_jax.training.demonstrations import Demonstrations, Progress, demonstrations
from lorasp_jax.training.export import load_policy
from lorasp_jax.training.finished_run import recorded_config
from lorasp_jax.training.run import Callback, Run
from lorasp_jax.training.run_folder import CONFIG_FILE, read_json

KIND = "flow distillation"
_KEPT = (*starts.KEPT, *starts.ADAPTERS, "tasks", "learn", "recap", "auxiliary", "seed")
"""Fields of the config that a start run decides; the seed is that of its demonstrations."""
_RATE = 0.3
"""Learning rate relative to the start run's; our choice."""


def resolve(config: DistillFlowConfig, given: Collection[str]) -> DistillFlowConfig:
    """Return the config with what the start run decides; `given` are the fields that the user set.

    Raises:
        ValueError: there is no start run, it is not finished, or has itself few flow steps by
            distillation; see also `start.with_kept`.
    """
    if not config.distill.start:
        raise ValueError("flow distillation needs a finished run: name it with --from")
    start = Path(config.distill.start)
    recorded = recorded_config(start, simulated=False)
    if "distill" in read_json(start / CONFIG_FILE):
        raise ValueError(f"{start} is distilled already: start from the run that it started from")
    kept = starts.with_kept(config, start, recorded, _KEPT, given)
    optim = recorded.optim
    values = {
        "learning_rate": _RATE * optim.learning_rate,
        "batch_size": optim.batch_size,
        "accumulate": optim.accumulate,
    }
    chosen = {name: x for name, x in values.items() if f"optim.{name}" not in given}
    return dataclasses.replace(kept, optim=dataclasses.replace(config.optim, **chosen))


def student(run: Run) -> Run:
    """Let a run train its policy as its config says, with the policy as the teacher; return it.

    Raises:
        ValueError: the policy has no adapters in the layers of the flow steps, or AdaLoRA's.
    """
    config, policy = run.config, run.policy
    assert isinstance(config, DistillFlowConfig)
    if any(isinstance(method, AdaLoRA) for method in adaptation.methods(policy.model).values()):
        raise ValueError("ada_lora's rank budget spans all layers: distill another method's run")
    run.objective, run.trained = objectives.of(config), policy.model.flow_layers
    if not run.parameters[0]:
        raise ValueError(f"{config.distill.start} has no adapters in the action expert")
    run.console.print(
        f"{NUM_STEPS} flow steps to {config.evaluation.denoise_steps}, {config.distill.loss}: "
        f"{run.parameters[0]:,} trainable parameters, all of the action expert"
    )
    return run


def prepare(config: DistillFlowConfig, folder: Path, console: Console, started: float) -> Run:
    """Return a run on the start run's data, with its policy.

    Raises:
        ValueError: see `setup.prepare`, `load_policy` and `student`; or the data have other
            instructions than those that the start run learned.
    """
    start = Path(config.distill.start)
    run = setup.prepare(config, folder, console, started, collect=functools.partial(_found, start))
    instructions = run.policy.processor.prompts.instructions
    del run.policy  # the device may not hold two
    run.policy = load_policy(start)
    run.base_hash = native.read_description(start)["base"]
    if instructions != run.policy.processor.prompts.instructions:
        raise ValueError(f"the instructions of the data are not those that {start} has learned")
    return student(run)


def _found(start: Path, config: Config, folder: Path, progress: Progress) -> Demonstrations:
    """Load the start run's demonstrations, or collect equal ones if its folder has none."""
    return demonstrations(config, start if (start / "cache").is_dir() else folder, progress)


class DistilledExport(Callback):
    """Exports the policy, as `train.py` does: `load_policy` loads it."""

    def on_end(self, run: Run) -> None:
        """Write adapter.safetensors and adapter.json."""
        assert isinstance(run.config, DistillFlowConfig)
        starts.write(run, Path(run.config.distill.start))


def run(
    config: DistillFlowConfig, folder: Path, console: Console, started: float, *, resume: bool
) -> None:
    """Distill a start run, evaluate before and after, export the policy, write the report."""
    distilled = prepare(config, folder, console, started)
    judge = Evaluation(learned=True) if distilled.simulated else NoEvaluation()
    callbacks = [Validation(), DistilledExport(), judge, Report()]
    loop.train(distilled, callbacks, resume=resume)
    report = folder / "report.html"
    console.print(f"finished in {distilled.seconds['total']:.0f} s: {report}", markup=False)
