"""The policies that studies/metaworld compares: which method adapts best to Meta-World's tasks?

    lorasp-jax study --config studies/metaworld/study.py --results studies/metaworld/results.json

Needs the demonstrations of `python -m studies.metaworld.collect` in data/SET for every set of
tasks, and another Python environment for the judge; see the README. Four questions; the cells of
the second are '*/first*' '*/single-*', those of the third '*/mt50/*' '*/pilot/*', those of the last
'*/together/*' '*/o?/*':

- Which method adapts best to fifty tasks, or to five new ones?
- Does LoRA-SP's lead over LoRA grow with the number of tasks?
- Does LoRA-SP depend less on R?
- What does a policy forget that learns ten tasks one after another?
"""

import dataclasses
import functools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from configs.metaworld import get_config
from lorasp_jax.config import AugmentConfig, Config
from lorasp_jax.extras.study import Cell, Derived, Study
from lorasp_jax.extras.study.results import best_rate, rate_of
from lorasp_jax.extras.study.study import Results
from lorasp_jax.peft import AdaLoRA, FullFineTuning, LoRA, LoRASP, Method
from studies.metaworld import page, sequences
from studies.metaworld.judge import judge
from studies.metaworld.tasks import FIRST, SETS

PILOT_SEED = 1000
METHODS: Mapping[str, Method] = {
    "lora_sp": LoRASP(rank=64),
    "lora_r64": LoRA(rank=64),
    "lora_r16": LoRA(rank=16),
    "ada_lora": AdaLoRA(rank=64, target_rank=16),
    "full": FullFineTuning(),
    **{f"lora_sp_r{rank}": LoRASP(rank=rank) for rank in (4, 8, 16, 32, 128)},
    **{f"lora_r{rank}": LoRA(rank=rank) for rank in (4, 8, 32, 128)},
}
RATES = (3e-4, 1e-3, 3e-3)
"""Learning rates, of which short pilots choose one per backbone and method."""
FEWER_RATES = dict.fromkeys((4, 8, 32), RATES[1:]) | {128: RATES[:2]}
"""Rank -> its two rates, if not all three."""
TUNED_AS = {"lora_r16": "lora_r64", "lora_sp_r16": "lora_sp"}
"""Method -> the method whose rate it takes."""
STEPS_PER_TASK = 120
"""Training steps per task of policies for fifty tasks and for fewer."""
STEPS_ALONE = 5 * STEPS_PER_TASK
"""Steps of policies for one task, as many as for the five: after 120, hardly any succeeds."""
NAME = "metaworld"


@dataclass(frozen=True)
class Stage:
    """How the policies of one kind are trained and judged.

    Attributes:
        tasks: what they learn and are judged on, a key of `tasks.SETS`.
        steps: training steps.
        episodes: judged episodes per task; 0: the policy is only a base.
        first_seed: seed of the first episode.
    """

    tasks: str
    steps: int
    episodes: int
    first_seed: int = 0


STAGES = {
    "pilot": Stage("mt50", 2_000, 5, 10_000),
    "mt50": Stage("mt50", 6_000, 10),
    "ml45": Stage("ml45", 10_000, 0),
    "ml5": Stage("ml5", 2_000, 10),
    **{f"first{n}": Stage(f"first{n}", n * STEPS_PER_TASK, 500 // n) for n in FIRST},
    **{f"single-{task}": Stage(task, STEPS_ALONE, 50) for task in SETS["first5"]},
    "together": Stage("first10", 10 * STEPS_ALONE, sequences.EPISODES),
}


def get_study(scale: str) -> Study:
    """Return the study, which has one scale: accelerator."""
    if scale != "accelerator":
        raise ValueError(f"the study has the scale accelerator, got {scale!r}")
    cells = [cell for backbone in page.BACKBONES for cell in _cells(backbone)]
    return Study(NAME, tuple(cells), page=lambda _, results, __: page.blocks(results), partial=True)


def _cells(backbone: str) -> Iterator[Cell | Derived]:
    """Yield all policies of a backbone, each after those that it needs."""
    for method in METHODS:
        if method not in TUNED_AS:
            for name in _pilots(f"{backbone}/mt50/{method}/s0"):
                yield _cell(name, _config(name, PILOT_SEED, rate_of(name)))
    for name in (f"{backbone}/ml45/full/s0", *_compared(backbone)):
        pilots = _pilots(name)
        base = f"{backbone}/ml45/full/s0" if "/ml5/" in name else ""
        seed = int(name.rpartition("/s")[2])

        def config(results: Results, name: str = name, seed: int = seed) -> Config:
            return _config(name, seed, best_rate(results, _pilots(name)))

        yield _cell(name, config, pilots, base)
    for seed in page.SEEDS:
        yield from sequences.cells(backbone, seed)


def _compared(backbone: str) -> Iterator[str]:
    """Yield the policies of the tables, question by question."""
    other_ranks = [method for method in METHODS if method not in page.LABELS]
    sets, alone = ([s for s in STAGES if s.startswith(kind)] for kind in ("first", "single-"))
    methods: Iterable[tuple[str, Iterable[str]]] = (
        *((stage, page.LABELS) for stage in ("mt50", "ml5")),
        *((stage, page.GROWING) for stage in sets),
        *((stage, page.SHARED) for stage in alone),
        ("mt50", other_ranks),
        ("together", page.TOGETHER.values()),
    )
    for stage, compared in methods:
        for method in compared:
            for seed in page.SEEDS:
                yield f"{backbone}/{stage}/{method}/s{seed}"


def _cell(name: str, config: Any, after: tuple[str, ...] = (), base: str = "") -> Cell:
    backbone, kind, method, _ = name.split("/")
    stage, group = STAGES[kind], f"{backbone}/{kind.partition('-')[0]}/{method}"
    evaluate = functools.partial(judge, stage.tasks, stage.episodes, stage.first_seed)
    return Cell(name, config, after, group, evaluate=evaluate, source=base)


def _pilots(name: str) -> tuple[str, ...]:
    """Return the policies whose success decides a policy's learning rate."""
    backbone, _, method, _ = name.split("/")
    method = TUNED_AS.get(method, method)
    rates = FEWER_RATES.get(getattr(METHODS[method], "rank", 0), RATES)
    return tuple(f"{backbone}/pilot/{method}/{rate}" for rate in rates)


def _config(name: str, seed: int, rate: float) -> Config:
    """Return the config of a policy's run."""
    backbone, kind, method, _ = name.split("/")
    stage, config = STAGES[kind], get_config("accelerator")
    model = dataclasses.replace(config.model, backbone=backbone)
    if kind == "ml5":  # it starts from a fully fine-tuned policy
        base = Path("runs") / NAME / backbone / "ml45/full/s0/base"
        model = dataclasses.replace(model, checkpoint=str(base))
    optim = dataclasses.replace(config.optim, steps=stage.steps, learning_rate=rate)
    warmup = min(optim.warmup_steps, stage.steps // 20)
    whole = stage.steps % config.log_every == 0  # a shorter last call would be compiled, too
    return dataclasses.replace(
        config,
        peft=METHODS[method],
        model=model,
        data=dataclasses.replace(
            config.data,
            source=(f"data/{stage.tasks}",),
            augment=AugmentConfig("none"),
            validation=("0",),
        ),
        optim=dataclasses.replace(optim, warmup_steps=warmup),
        log_every=config.log_every if whole else STEPS_PER_TASK,
        evaluation=dataclasses.replace(config.evaluation, denoise_steps=10),
        seed=seed,
    )
