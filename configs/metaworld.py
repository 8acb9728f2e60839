"""Adapt a pretrained miniature policy to Meta-World's fifty tasks; see studies/metaworld.

    python train.py --config configs/metaworld.py
    python train.py --config configs/metaworld.py --method lora --peft.rank 64 --name lora

Needs the demonstrations in data/mt50, which its README says how to collect. The judge runs in
another Python environment, because Meta-World pins an older MuJoCo.
"""

import dataclasses

from lorasp_jax.config import Config, DataConfig, ModelConfig, OptimConfig
from lorasp_jax.peft import LoRASP

_MAX_TOKENS = 32
"""Fits the longest of the fifty instructions."""


def get_config(scale: str) -> Config:
    """Return the config at `scale`; smoke and cpu suit two or three easy tasks."""
    config = Config(
        name="metaworld",
        scale=scale,
        peft=LoRASP(rank=64),
        model=ModelConfig(size="small", dtype="bfloat16", max_tokens=_MAX_TOKENS),
        data=DataConfig(source=("data/mt50",)),
        optim=OptimConfig(steps=10_000, batch_size=128, learning_rate=1e-3, warmup_steps=100),
        log_every=125,
        checkpoint_every=2500,
    )
    if scale == "accelerator":
        return config
    return dataclasses.replace(
        config,
        peft=LoRASP(rank=16),
        model=ModelConfig(max_tokens=_MAX_TOKENS),
        optim=OptimConfig(steps=800, batch_size=32, learning_rate=3e-3, warmup_steps=15),
        log_every=10,
        checkpoint_every=400,
    )
