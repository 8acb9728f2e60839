"""A study of two methods, two tasks and two seeds with real, tiny cells."""

import dataclasses

from lorasp_jax.config import Config, DataConfig, EvaluationConfig, OptimConfig
from lorasp_jax.extras.study import Cell, Derived, Study
from lorasp_jax.peft import LoRA, LoRASP

CONFIG = Config(
    name="cell",
    scale="smoke",
    robot="panda",  # the base was trained on it, so that outcomes differ between episodes
    peft=LoRASP(rank=8),
    tasks=("press", "pick_place"),
    targets=("^action/.*(q|v)_proj",),
    data=DataConfig(episodes=4, num_envs=8),
    optim=OptimConfig(steps=4, batch_size=8, warmup_steps=1),
    evaluation=EvaluationConfig(episodes=4, num_envs=4, before=False),
    log_every=2,
    checkpoint_every=2,
)


LORA = dataclasses.replace(CONFIG, peft=LoRA(rank=4))


def lora(results):
    """LoRA of rank 4, or of LoRA-SP's mean active rank if that is lower."""
    rank = round(results["lora_sp/s1"]["active_rank"]["mean"])
    return dataclasses.replace(LORA, peft=LoRA(rank=min(rank, 4)), seed=1)


def get_study(scale: str) -> Study:
    assert scale == "smoke"
    cells = [
        Cell("lora_sp/s0", CONFIG, group="lora_sp"),
        Cell("lora_sp/s1", dataclasses.replace(CONFIG, seed=1), group="lora_sp"),
        Cell("lora/s0", LORA, group="lora"),
        Cell("lora/s1", lora, ("lora_sp/s1",), "lora"),
        Derived("same/s0", "lora_sp/s0", lambda policy, results, episodes: policy),
    ]
    return Study("tiny", tuple(cells))
