"""Improve a finished run from success alone by the initial noise of its flow.

    python train.py --config configs/noise_space.py --from runs/few

The policy stays as it is. Other settings are those of configs/reinforce.py. See docs/reinforce.md.
"""

import dataclasses
from pathlib import Path

from lorasp_jax.reinforce.config import ReinforceConfig
from lorasp_jax.training.overrides import load


def get_config(scale: str) -> ReinforceConfig:
    """Return the config at `scale`: smoke, cpu or accelerator."""
    config = load(Path(__file__).with_name("reinforce.py"), scale)
    assert isinstance(config, ReinforceConfig)
    optim = dataclasses.replace(
        config.optim,
        steps={"smoke": 2, "cpu": 30, "accelerator": 60}[scale],
        batch_size={"smoke": 64, "cpu": 512, "accelerator": 2048}[scale],
    )
    settings = {"method": "noise", "std": 0.5, "epochs": 8, "max_kl": 0.04}
    worlds = {"smoke": 16, "cpu": 128, "accelerator": 512}[scale]
    learning = dataclasses.replace(config.online, worlds=worlds, **settings)
    return dataclasses.replace(config, name="noise_space", optim=optim, online=learning)
