"""Distill a finished run's policy to fewer flow steps.

    python train.py --config configs/multitask.py
    python train.py --config configs/distill_flow.py --from runs/multitask

Base, robot, tasks, data and adapters are the start run's. See docs/serving.md, "Flow steps".
"""

from lorasp_jax.config import EvaluationConfig, OptimConfig
from lorasp_jax.distill_flow.config import DistillFlowConfig
from lorasp_jax.peft import LoRASP


def get_config(scale: str) -> DistillFlowConfig:
    """Return the config at `scale`: smoke, cpu or accelerator."""
    episodes = {"smoke": 16, "cpu": 64, "accelerator": 256}[scale]
    return DistillFlowConfig(
        name="distill_flow",
        scale=scale,
        peft=LoRASP(),
        optim=OptimConfig(steps={"smoke": 4}.get(scale, 3000)),
        evaluation=EvaluationConfig(
            episodes=episodes, num_envs={"cpu": 32}.get(scale, episodes), denoise_steps=2
        ),
        log_every={"smoke": 2, "cpu": 50}.get(scale, 100),
        checkpoint_every={"smoke": 2}.get(scale, 500),
    )
