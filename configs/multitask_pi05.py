"""Adapt the published pi0.5 (3.4 B parameters) to the PiPER arm: four tasks, LoRA-SP, rank 128.

    python train.py --config configs/multitask_pi05.py
    python train.py --config configs/multitask_pi05.py --model.checkpoint FOLDER \\
        --model.tokenizer FILE

Downloads weights and tokenizer from public buckets unless you pass your own; weights may be in
openpi's or LeRobot's layout. A folder that is named after a training config of openpi, such as
pi05_libero, is adapted with its chunk and prompts; `--model.openpi-config NAME` names that of
others. Joint targets are learned relative to the state: for recorded displacements, as LIBERO's,
pass `--model.relative-actions False`. `--fit 24GB` fits the run to a GPU.
"""

import dataclasses
from pathlib import Path

from lorasp_jax.config import Config
from lorasp_jax.training.overrides import load


def get_config(scale: str) -> Config:
    """Return the config, based on configs/multitask_pi0.py; smoke runs a few steps."""
    config = load(Path(__file__).with_name("multitask_pi0.py"), scale)
    model = dataclasses.replace(
        config.model,
        size="base_pi05",
        checkpoint="gs://openpi-assets/checkpoints/pi05_base",
    )
    return dataclasses.replace(config, name="multitask_pi05", model=model)
