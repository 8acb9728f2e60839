"""Adapt a pretrained miniature policy from the Panda arm to the PiPER arm: four tasks, LoRA-SP.

    python train.py --config configs/multitask.py
    python train.py --config configs/multitask.py --model.backbone smolvla --name smolvla
    python train.py --config configs/multitask.py --method lora --peft.rank 16 --name lora

Collects PiPER demonstrations with the scripted expert, evaluates the base that was pretrained on a
simulated Franka Panda (assets/), trains adapters jointly on the paper's four tasks, evaluates again
and writes runs/multitask/report.html. Expected results and times are in docs/train.md. Scale cpu
trains only two tasks; pass `--tasks open_pot pour press pick_place` for all four.
"""

from lorasp_jax.config import Config, DataConfig, EvaluationConfig, ModelConfig, OptimConfig
from lorasp_jax.peft import LoRASP


def get_config(scale: str) -> Config:
    """Return the config at `scale`: smoke (two minutes for press), cpu or accelerator."""
    return {"smoke": _smoke, "cpu": _cpu, "accelerator": _accelerator}[scale]()


def _smoke() -> Config:
    # Compilation dominates, so only the layers that the task press needs are adapted.
    return Config(
        name="multitask",
        scale="smoke",
        peft=LoRASP(rank=8),
        targets=("^action/.*(q|v|o|down)_proj", "^(state|action_in|action_out)_proj"),
        data=DataConfig(episodes=32, num_envs=32),
        optim=OptimConfig(steps=300, batch_size=32, learning_rate=3e-3, warmup_steps=15),
        evaluation=EvaluationConfig(episodes=16, num_envs=16),
        log_every=10,
        checkpoint_every=300,
    )


def _cpu() -> Config:
    return Config(
        name="multitask",
        scale="cpu",
        tasks=("press", "pick_place"),
        peft=LoRASP(rank=16, hidden_width=16),
        data=DataConfig(episodes=128, num_envs=32),
        optim=OptimConfig(steps=2000, batch_size=64, learning_rate=3e-3, warmup_steps=100),
        evaluation=EvaluationConfig(episodes=64, num_envs=32),
        log_every=50,
        checkpoint_every=500,
    )


def _accelerator() -> Config:
    return Config(
        name="multitask",
        scale="accelerator",
        peft=LoRASP(rank=64),
        model=ModelConfig(size="small", dtype="bfloat16"),
        data=DataConfig(episodes=512, num_envs=256),
        optim=OptimConfig(steps=5000, batch_size=256, learning_rate=1e-3, warmup_steps=100),
        evaluation=EvaluationConfig(episodes=256, num_envs=256),
        log_every=100,
        checkpoint_every=1000,
    )
