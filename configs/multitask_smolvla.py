"""Adapt the published SmolVLA (0.45 B parameters) to the PiPER arm: four tasks, LoRA-SP, rank 128.

    python train.py --config configs/multitask_smolvla.py
    python train.py --config configs/multitask_smolvla.py --model.checkpoint FOLDER \\
        --model.tokenizer FILE

Downloads weights and tokenizer from the Hugging Face Hub unless you pass your own.
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
        backbone="smolvla",
        checkpoint="hf://lerobot/smolvla_base",
        relative_actions=None,
        tokenizer="hf://HuggingFaceTB/SmolVLM2-500M-Video-Instruct",
    )
    return dataclasses.replace(config, name="multitask_smolvla", model=model, image_size=256)
