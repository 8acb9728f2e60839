"""A study of two methods, two tasks and two seeds with real, tiny cells."""

import dataclasses

from lorasp_jax.config import Config, DataConfig, EvaluationConfig, OptimConfig
from lorasp_jax.peft import LoRA, LoRASP
from lorasp_jax.study import Cell, Derived, Study

CONFIG = Config(
    name="cell",
    scale="smoke",
    peft=LoRASP(rank=8),
    tasks=("press", "pick_place"),
    targets=("^action/.*(q|v|o|down)_proj", "^(state|action_in|action_out)_proj"),
    data=DataConfig(episodes=4, num_envs=4),
    optim=OptimConfig(steps=4, batch_size=8, warmup_steps=1),
    evaluation=EvaluationConfig(episodes=4, num_envs=4, before=False),
    log_every=2,
    checkpoint_every=2,
)


def lora(seed):
    """LoRA with the mean active rank of LoRA-SP."""

    def config(results):
        rank = round(results[f"lora_sp/s{seed}"]["active_rank"]["mean"])
        return dataclasses.replace(CONFIG, peft=LoRA(rank=max(rank, 1)), seed=seed)

    return config


def get_study(scale: str) -> Study:
    assert scale == "smoke"
    sp = [
        Cell(f"lora_sp/s{seed}", dataclasses.replace(CONFIG, seed=seed), group="lora_sp")
        for seed in range(2)
    ]
    other = [Cell(f"lora/s{seed}", lora(seed), (f"lora_sp/s{seed}",), "lora") for seed in range(2)]
    same = Derived("same/s0", "lora_sp/s0", lambda policy, results, episodes: policy)
    return Study("tiny", (*sp, *other, same))
