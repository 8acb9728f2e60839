"""What a finished run hands on: adapters, or with full fine-tuning a new base."""

import json

from lorasp_jax import adaptation, adapter_io, models
from lorasp_jax.training.loop import Run


def write(run: Run) -> None:
    """Write adapter.safetensors and adapter.json, or `base` if the base itself was trained."""
    config = run.config
    if config.peft.trains_base:
        folder = run.folder / "base"
        models.save(folder, adaptation.merge(run.policy.model))
        statistics = run.policy.processor.statistics.to_json()
        (folder / "statistics.json").write_text(statistics + "\n")
        return
    adapter_io.save_adapters(
        run.folder,
        run.policy.model,
        base=run.base_hash,
        metadata={
            "base": config.base,
            "robot": config.robot,
            "tasks": list(config.tasks),
            "statistics": json.loads(run.policy.processor.statistics.to_json()),
        },
    )
