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
    learning, optim, episodes = {
        "smoke": (
            Learning(worlds=16, teacher_worlds=16, rounds=2, gradient_steps=4),
            OptimConfig(steps=2, batch_size=16, learning_rate=3e-4),
            16,
        ),
        "cpu": (
            Learning(worlds=64, teacher_worlds=128, rounds=15, std=0.2, gradient_steps=100),
            OptimConfig(steps=12, batch_size=64, learning_rate=3e-4),
            64,
        ),
        "accelerator": (
            Learning(worlds=512, teacher_worlds=1024, rounds=15, gradient_steps=1000),
            OptimConfig(steps=12, batch_size=128, learning_rate=3e-4),
            256,
        ),
    }[scale]
    return ReinforceConfig(
        name="reinforce",
        scale=scale,
        peft=LoRASP(),
        tasks=("press",),
        optim=optim,
        evaluation=EvaluationConfig(
            episodes=episodes, num_envs=episodes, every={"smoke": 2, "cpu": 2}.get(scale, 3)
        ),
        online=learning,
        checkpoint_every={"smoke": 1, "cpu": 1, "accelerator": 3}[scale],
    )
