"""Adapt a pretrained miniature policy to a single task on the PiPER arm.

    python train.py --config configs/single_task.py --tasks pour --name pour

All settings except name and tasks come from configs/multitask.py; the default task is press.
"""

import dataclasses
from pathlib import Path

from lorasp_jax.config import Config
from lorasp_jax.training.overrides import load


def get_config(scale: str) -> Config:
    """Return the config at `scale`: smoke, cpu or accelerator."""
    config = load(Path(__file__).with_name("multitask.py"), scale)
    return dataclasses.replace(config, name="single_task", tasks=("press",))
