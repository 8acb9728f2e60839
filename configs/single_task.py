"""Adapt a pretrained miniature policy to one task of the PiPER arm, the one that is named.

    python train.py --config configs/single_task.py --tasks pour --name pour

Everything but the tasks is as in configs/multitask.py.
"""

import dataclasses
from pathlib import Path

from lorasp_jax.config import Config
from lorasp_jax.training.overrides import load


def get_config(scale: str) -> Config:
    """The experiment at `scale`: smoke, cpu or accelerator."""
    config = load(Path(__file__).with_name("multitask.py"), scale)
    return dataclasses.replace(config, name="single_task", tasks=("press",))
