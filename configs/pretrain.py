"""Pretrain the bundled base policies in assets/ from scratch on Panda demonstrations.

    python train.py --config configs/pretrain.py --name pi0_small
    python train.py --config configs/pretrain.py --name smolvla_small --model.backbone smolvla
    python train.py --config configs/pretrain.py --name pi0_nano --model.size nano \\
        --optim.steps 24000 --optim.learning-rate 2e-3

Trains all parameters (FullFineTuning on every layer) on the paper's four tasks and writes
runs/<name>/base, the contents of assets/<name>. The model cards in assets/ state hardware, training
time and success rates.
"""

import dataclasses

from lorasp_jax.config import Config, DataConfig, EvaluationConfig, ModelConfig, OptimConfig
from lorasp_jax.peft import FullFineTuning


def get_config(scale: str) -> Config:
    """Return the config at `scale`; the bundled bases were trained at scale accelerator."""
    config = Config(
        name="pretrain",
        scale=scale,
        peft=FullFineTuning(),
        model=ModelConfig(size="small", checkpoint="", dtype="bfloat16"),
        robot="panda",
        data=DataConfig(episodes=1024, num_envs=256),
        optim=OptimConfig(steps=12_000, batch_size=512, learning_rate=1e-3, warmup_steps=300),
        evaluation=EvaluationConfig(episodes=256, num_envs=256, denoise_steps=10),
        log_every=200,
        checkpoint_every=2000,
    )
    if scale == "accelerator":
        return config
    return dataclasses.replace(
        config,
        model=ModelConfig(checkpoint=""),
        data=DataConfig(episodes=4, num_envs=8),
        optim=OptimConfig(steps=4, batch_size=8, warmup_steps=1),
        evaluation=EvaluationConfig(episodes=8, num_envs=8, denoise_steps=10),
        log_every=2,
        checkpoint_every=2,
    )
