"""Improve a finished run from success alone by policy gradients on its adapters.

    python train.py --config configs/ppo.py --from runs/few

Slower than configs/reinforce.py, whose other settings it has. See docs/reinforce.md.
"""

import dataclasses
from pathlib import Path

from lorasp_jax.reinforce.config import ReinforceConfig
from lorasp_jax.training.overrides import load


def get_config(scale: str) -> ReinforceConfig:
    """Return the config at `scale`: smoke, cpu or accelerator."""
    config = load(Path(__file__).with_name("reinforce.py"), scale)
    assert isinstance(config, ReinforceConfig)
    worlds = {"smoke": 16, "cpu": 128, "accelerator": 512}[scale]
    optim = dataclasses.replace(
        config.optim,
        steps={"smoke": 2, "cpu": 40, "accelerator": 100}[scale],
        batch_size={"smoke": 64, "cpu": 512, "accelerator": 2048}[scale],
        accumulate={"smoke": 1, "cpu": 2, "accelerator": 8}[scale],
        learning_rate=1e-5 if scale == "accelerator" else 5e-5,
    )
    learning = dataclasses.replace(
        config.online, method="ppo", worlds=worlds, std=0.05, max_kl=0.06
    )
    return dataclasses.replace(config, name="ppo", optim=optim, online=learning)
