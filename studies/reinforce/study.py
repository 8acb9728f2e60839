"""How far does trial in simulation take a policy of few demonstrations, and with which rank?

    lorasp-jax study --config studies/reinforce/study.py \\
        --results studies/reinforce/results.json --jobs 5

A policy learns four tasks from N demonstrations of each, then from success alone. `imitation`
trains on many demonstrations instead, `randomized` learns in scenes that change, `some` learn two
tasks alone. The policies of `page.RANKS` merge the adapters of a start into its base and learn new
ones.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lorasp_jax.config import Config, DataConfig, EvaluationConfig, ModelConfig, OptimConfig
from lorasp_jax.extras.study import Cell, Derived, Study
from lorasp_jax.extras.study.page import BACKBONES
from lorasp_jax.peft import FullFineTuning, LoRA, LoRASP, Method
from lorasp_jax.reinforce.config import Learning
from lorasp_jax.training import experiment_file
from studies.few.judge import SHIFT
from studies.reinforce import owner, page
from studies.reinforce.judge import Trial, learned

METHODS: dict[str, Method] = {
    **{f"r{rank}": LoRA(rank=rank) for rank in (1, 4, 16, 64)},
    "lora_sp": LoRASP(rank=64),
    "full": FullFineTuning(),
}
"""Adapters that learn from success after those of the start are merged."""


@dataclass(frozen=True)
class Scale:
    """What the policies of a scale share.

    Attributes:
        start: config of the starts, but for backbone, seed and number of demonstrations.
        trial: how they learn from success.
        imitation: demonstrations and gradient steps of `imitation`.
        episodes: as `owner.EPISODES`.
        counts: numbers of demonstrations.
        seeds: those of the tables.
    """

    start: Config
    trial: Trial
    imitation: tuple[int, int]
    episodes: Mapping[int, tuple[int, int]]
    counts: tuple[int, ...] = page.COUNTS
    seeds: tuple[int, ...] = page.SEEDS

    @property
    def pool(self) -> int:
        """Demonstrations per task, of which each seed takes its own."""
        return self.imitation[0]


_OPTIM = OptimConfig(steps=2000, batch_size=64, learning_rate=1e-3, warmup_steps=100)
_ACCELERATOR = Scale(
    Config(
        name="reinforce",
        scale="accelerator",
        peft=LoRA(rank=64),
        model=ModelConfig(size="small", dtype="bfloat16"),
        data=DataConfig(num_envs=256),
        optim=_OPTIM,
        evaluation=EvaluationConfig(episodes=256, num_envs=256, before=False),
        log_every=250,
        checkpoint_every=10_000,
    ),
    Trial(
        Learning(worlds=512, teacher_worlds=1024, rounds=15, gradient_steps=1000),
        OptimConfig(steps=12, batch_size=128, learning_rate=3e-4),
        every=3,
    ),
    imitation=(512, 20_000),
    episodes=owner.EPISODES,
)


def _pilot(
    learning: Learning = _ACCELERATOR.trial.learning,
    optim: OptimConfig = _ACCELERATOR.trial.optim,
    **changes: Any,
) -> Trial:
    """Return learning for at most 20 minutes; unless given, the settings are the tables'."""
    learning = replace(learning, minutes=20, **changes)
    return replace(_ACCELERATOR.trial, learning=learning, optim=optim)


_SHORT = replace(_ACCELERATOR.trial.optim, steps=30)
_CONFIG = Path(__file__).parents[2] / "configs" / "ppo.py"
_PPO = experiment_file.call(_CONFIG, "get_config", "accelerator")
PILOTS = {
    "short": _pilot(optim=_SHORT, rounds=5, gradient_steps=300, worlds=256),
    "long": _pilot(worlds=256),
    "wide": _pilot(),
    "ppo": _pilot(_PPO.online, _PPO.optim),
    "ppo_sde": _pilot(_PPO.online, _PPO.optim, exploration="sde"),
}
"""How the pilots learn."""
_SMOKE = Scale(
    replace(
        _ACCELERATOR.start,
        scale="smoke",
        model=ModelConfig(),
        data=DataConfig(num_envs=4),
        optim=replace(_OPTIM, steps=2, batch_size=4, warmup_steps=1),
        evaluation=replace(_ACCELERATOR.start.evaluation, episodes=4, num_envs=4),
        log_every=2,
    ),
    Trial(
        Learning(worlds=8, teacher_worlds=8, rounds=1, gradient_steps=1),
        OptimConfig(steps=1, batch_size=8, learning_rate=3e-4),
        every=1,
    ),
    imitation=(4, 2),
    episodes={4: (4, 2)},
    counts=(2,),
    seeds=(0,),
)


def get_study(scale: str) -> Study:
    """Return the study; scale smoke only shows that all of it runs."""
    chosen = {"accelerator": _ACCELERATOR, "smoke": _SMOKE}[scale]
    cells = [
        cell
        for seed in chosen.seeds
        for backbone in BACKBONES
        for cell in _cells(chosen, backbone, seed)
    ]
    cells += [
        learned(replace(chosen.trial, method=method), backbone, chosen.counts[0], name, seed)
        for seed in chosen.seeds
        for name, method in METHODS.items()
        for backbone in BACKBONES
    ]
    if scale == "accelerator":
        cells = [*_pilots(chosen), *cells]
    return Study("reinforce", tuple(cells), page=page.blocks, partial=True)


def _cells(scale: Scale, backbone: str, seed: int) -> Iterator[Cell | Derived]:
    """Yield the policies of a backbone and seed but for those of `page.RANKS`."""
    for count in scale.counts:
        config = _config(scale.start, backbone, count, seed)
        name = page.cell(backbone, count, "start", seed)
        yield Cell(name, config, (), backbone, pool=scale.pool)
        yield learned(scale.trial, backbone, count, "teacher", seed)
    shifted = replace(scale.trial, scene=SHIFT)
    yield learned(shifted, backbone, scale.counts[0], "randomized", seed)
    some = replace(scale.trial, tasks=page.HARD)
    yield learned(some, backbone, scale.counts[0], "some", seed)
    yield from owner.cells(backbone, scale.counts[0], seed, scale.pool, scale.episodes)
    count, steps = scale.imitation
    config = _config(scale.start, backbone, count, seed)
    optim = replace(config.optim, steps=steps, batch_size=scale.trial.optim.batch_size)
    name = page.cell(backbone, count, "imitation", seed)
    config = replace(config, optim=optim)
    yield Cell(name, config, (), f"{backbone}/imitation", pool=scale.pool)


def _pilots(scale: Scale) -> Iterator[Cell | Derived]:
    """Yield policies of a seed that no table uses, which decided how the others learn."""
    count = scale.counts[0]
    for backbone in BACKBONES:
        config = _config(scale.start, backbone, count, page.PILOT_SEED)
        yield Cell(page.cell(backbone, count, "start", page.PILOT_SEED), config, (), backbone)
        for name, trial in PILOTS.items():
            yield learned(trial, backbone, count, name, page.PILOT_SEED)


def _config(start: Config, backbone: str, count: int, seed: int) -> Config:
    return replace(
        start,
        model=replace(start.model, backbone=backbone),
        data=replace(start.data, episodes=count),
        seed=seed,
    )
