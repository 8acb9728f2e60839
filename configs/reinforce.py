"""Improve a finished run by trial in simulation: PPO of its adapters, from sparse success.

    python train.py --config configs/single_task.py --data.episodes 8 --name few
    python train.py --config configs/reinforce.py --from runs/few

Base, robot, tasks and adapters are the start run's. See docs/reinforce.md.
"""

from lorasp_jax.config import EvaluationConfig, OptimConfig
from lorasp_jax.peft import LoRASP
from lorasp_jax.reinforce.config import Learning, ReinforceConfig


def get_config(scale: str) -> ReinforceConfig:
    """Return the config at `scale`: smoke, cpu (ten minutes for press) or accelerator."""
    worlds = {"smoke": 16, "cpu": 64, "accelerator": 256}[scale]
    rate = 5e-5
    return ReinforceConfig(
        name="reinforce",
        scale=scale,
        peft=LoRASP(),
        tasks=("press",),
        optim=OptimConfig(
            steps={"smoke": 2, "cpu": 40, "accelerator": 300}[scale],
            batch_size={"smoke": 64, "cpu": 256, "accelerator": 2048}[scale],
            learning_rate=rate,
            final_learning_rate=rate,
            warmup_steps=10,
            weight_decay=0.0,
        ),
        evaluation=EvaluationConfig(episodes=worlds, num_envs=worlds, denoise_steps=2, every=10),
        learn=Learning(worlds=worlds, std=0.1, epochs=4),
        log_every=1,
        checkpoint_every=10,
    )
