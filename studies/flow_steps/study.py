"""How many flow steps does a policy need? Success, jerk and spread with 1 to 10 Euler steps.

    lorasp-jax study --config studies/flow_steps/study.py \\
        --results studies/flow_steps/results.json --jobs 8

Every policy learns the paper's four tasks, whose demonstrations have one way to act, and one task
with two. It is then judged with each number of steps on the same layouts, from the same noise.
Policies of LoRA-SP are also distilled to one or two steps, and judged with as many.
"""

import functools
from dataclasses import replace
from typing import Any

from lorasp_jax.config import Config, DataConfig, EvaluationConfig, ModelConfig, OptimConfig
from lorasp_jax.extras.study import Cell, Study
from lorasp_jax.peft import LoRA, LoRASP, Method
from studies.flow_steps import page
from studies.flow_steps.judge import judge, judge_distilled, measure

POLICIES: dict[str, tuple[Method, dict[str, Any]]] = {
    "lora": (LoRA(rank=64), {}),
    "lora_sp": (LoRASP(rank=64), {}),
    "noisy": (LoRASP(rank=64), {"time_shape": 4.0}),
    "rtc": (LoRASP(rank=64), {"rtc_max_delay": page.DELAY}),
}
"""Name -> method, and settings of the training that differ."""
_ACCELERATOR = Config(
    name="flow_steps",
    scale="accelerator",
    peft=LoRASP(),
    model=ModelConfig(size="small", dtype="bfloat16"),
    tasks=page.TASKS,
    data=DataConfig(episodes=256, num_envs=256),
    optim=OptimConfig(steps=4000, batch_size=128, learning_rate=1e-3, warmup_steps=100),
    evaluation=EvaluationConfig(episodes=256, num_envs=256, denoise_steps=10, before=False),
    log_every=250,
    checkpoint_every=10_000,
)
_SMOKE = replace(
    _ACCELERATOR,
    scale="smoke",
    model=ModelConfig(),
    data=DataConfig(episodes=2, num_envs=4),
    optim=OptimConfig(steps=2, batch_size=4, warmup_steps=1),
    evaluation=replace(_ACCELERATOR.evaluation, episodes=4, num_envs=4),
    log_every=2,
)


def get_study(scale: str) -> Study:
    """Return the study; scale smoke only shows that all of it runs."""
    config = {"accelerator": _ACCELERATOR, "smoke": _SMOKE}[scale]
    seeds = page.SEEDS if scale == "accelerator" else page.SEEDS[:1]
    cells = []
    for seed in seeds:
        for backbone in page.BACKBONES:
            for name, (method, changes, evaluate) in _policies().items():
                made = replace(
                    config,
                    peft=method,
                    model=replace(config.model, backbone=backbone),
                    optim=replace(config.optim, **changes),
                    seed=seed,
                )
                group = f"{backbone}/{name}"
                cells.append(Cell(f"{group}/s{seed}", made, (), group, evaluate=evaluate))
    made = {"measure": measure, "page": page.blocks, "partial": True}
    return Study("flow_steps", tuple(cells), **made)


def _policies() -> dict[str, tuple[Method, dict[str, Any], Any]]:
    """Return method, changed settings and judge by policy; all distilled ones begin as LoRA-SP."""
    found = {
        name: (*made, functools.partial(judge, delay=made[1].get("rtc_max_delay", 0)))
        for name, made in POLICIES.items()
    }
    for name, (_, steps) in page.DISTILLED.items():
        loss = "snapflow" if name == "snapflow" else "endpoint"
        evaluate = functools.partial(judge_distilled, loss=loss, steps=steps)
        found[name] = (*POLICIES["lora_sp"], evaluate)
    return found
