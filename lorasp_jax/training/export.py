"""What a finished run hands on: adapters, or with full fine-tuning a new base."""

import json
from typing import Any

from lorasp_jax import adaptation, adapter_io, models
from lorasp_jax.training.base import TRAINING
from lorasp_jax.training.run import Callback, Run
from lorasp_jax.training.run_folder import write_json


class Export(Callback):
    """`write` after the last step."""

    def on_end(self, run: Run) -> None:
        """Write the trained policy."""
        write(run)


def write(run: Run) -> None:
    """Write adapter.safetensors and adapter.json, or `base` if the base itself was trained."""
    config = run.config
    if config.peft.trains_base:
        folder = run.folder / "base"
        models.save(folder, adaptation.merge(run.policy.model))
        statistics = run.policy.processor.statistics.to_json()
        (folder / "statistics.json").write_text(statistics + "\n")
        write_json(folder / TRAINING, _facts(run))
        return
    processor = run.policy.processor
    adapter_io.save_adapters(
        run.folder,
        run.policy.model,
        base=run.base_hash,
        metadata={
            "base": config.model.source,
            **_facts(run),
            "instructions": list(processor.prompts.instructions),
            "cameras": {place: name for place, name in processor.cameras if name},
            "relative": list(processor.inputs.delta),
            "statistics": json.loads(processor.statistics.to_json()),
        },
    )


def _facts(run: Run) -> dict[str, Any]:
    """What the weights were trained on."""
    config, first = run.config, next(iter(run.episodes.values()))
    return {
        "robot": config.robot,
        "tasks": list(config.tasks),
        "control_dt": first.control_dt,
        "physics_dt": first.physics_dt,
    }
