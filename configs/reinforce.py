"""Improve a finished run by trial in simulation, from success alone.

    python train.py --config configs/single_task.py --data.episodes 8 --name few
    python train.py --config configs/reinforce.py --from runs/few

Base, robot, tasks and adapters are the start run's. See docs/reinforce.md.
"""

from lorasp_jax.config import EvaluationConfig, OptimConfig
from lorasp_jax.peft import LoRASP
from lorasp_jax.reinforce.config import Learning, ReinforceConfig


def get_config(scale: str) -> ReinforceConfig:
    """Return the config at `scale`: smoke, cpu or accelerator."""
    worlds = {"smoke": 16, "cpu": 128, "accelerator": 512}[scale]
    episodes = {"smoke": 16, "cpu": 64, "accelerator": 256}[scale]
    return ReinforceConfig(
        name="reinforce",
        scale=scale,
        peft=LoRASP(),
        tasks=("press",),
        optim=OptimConfig(
            steps={"smoke": 2, "cpu": 40, "accelerator": 100}[scale],
            batch_size={"smoke": 64, "cpu": 512, "accelerator": 2048}[scale],
            accumulate={"smoke": 1, "cpu": 2, "accelerator": 8}[scale],
            learning_rate=1e-5 if scale == "accelerator" else 5e-5,
        ),
        evaluation=EvaluationConfig(
            episodes=episodes, num_envs=episodes, denoise_steps=2, every={"smoke": 2}.get(scale, 5)
        ),
        online=Learning(worlds=worlds),
        checkpoint_every={"smoke": 1, "cpu": 1, "accelerator": 10}[scale],
    )
