"""How many demonstrations, which method? Success as recorded and in a shifted scene.

    lorasp-jax study --config studies/few/study.py \\
        --results studies/few/results.json --jobs 8

Every policy learns four tasks from N demonstrations of each, which each seed draws from the same
512. All train for as many steps, whatever N; one method also trains for other numbers. Backbones
and methods have the better of two learning rates, chosen at N = 50 with a seed that no table uses.
"""

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from lorasp_jax.config import (
    AugmentConfig,
    Config,
    DataConfig,
    EvaluationConfig,
    ModelConfig,
    OptimConfig,
)
from lorasp_jax.extras.study import Cell, Study
from lorasp_jax.extras.study.results import best_rate, rate_of
from lorasp_jax.extras.study.study import Results
from lorasp_jax.peft import FullFineTuning, LoRA, LoRASP, Method
from studies.few import page
from studies.few.judge import judge, measure

METHODS: dict[str, tuple[Method, tuple[str, ...]]] = {
    "lora_r16": (LoRA(rank=16), ()),
    "lora_r64": (LoRA(rank=64), ()),
    "lora_sp": (LoRASP(rank=64), ()),
    "vlm_lora": (LoRA(rank=64), ("vlm-lora+expert-full",)),
    "full": (FullFineTuning(), ()),
}
"""Method -> its settings and, if layers differ in their methods, the rules."""
TUNED_AS = {"lora_r16": "lora_r64"}
"""Method -> the method whose rate it takes."""
_MOVES = AugmentConfig("openpi", brightness=0.0, contrast=0.0, hue=0.0)
_CROP = replace(_MOVES, rotation=0.0)
_PRESETS = {"none": AugmentConfig("none"), "openpi": AugmentConfig("openpi")}
PARTS = {
    "openpi_cropped": _PRESETS["openpi"],
    "crop": _CROP,
    "crop_cropped": _CROP,
    "rotate": replace(_MOVES, crop=1.0),
    "color": AugmentConfig("openpi", crop=1.0, rotation=0.0),
    "no_crop": AugmentConfig("openpi", crop=1.0),
    "lerobot": AugmentConfig("lerobot"),
}
"""Augmentation of the cells that only the table of `page.PARTS` has."""
RATES = (3e-4, 1e-3)
"""Learning rates, of which pilots choose one per backbone and method."""
PILOT_SEED = 1000


@dataclass(frozen=True)
class Scale:
    """What the policies of a scale share.

    Attributes:
        config: everything but method, rate, seed and number of demonstrations.
        counts: N, in ascending order; the last is the size of the pool.
        pilot_count: N of the pilots.
        stepped: N of the policies that train for `page.OTHER_STEPS`.
        seeds: seeds of the tables.
    """

    config: Config
    counts: tuple[int, ...] = page.COUNTS
    pilot_count: int = 50
    stepped: tuple[int, ...] = page.STEPPED_COUNTS
    seeds: tuple[int, ...] = page.SEEDS


ACCELERATOR = Scale(
    Config(
        name="few",
        scale="accelerator",
        peft=LoRASP(),
        model=ModelConfig(size="small", dtype="bfloat16"),
        data=DataConfig(num_envs=256),
        optim=OptimConfig(steps=page.STEPS, batch_size=64, warmup_steps=100),
        evaluation=EvaluationConfig(episodes=256, num_envs=256, denoise_steps=10, before=False),
        log_every=250,
        checkpoint_every=10_000,
    )
)
SMOKE = Scale(
    replace(
        ACCELERATOR.config,
        scale="smoke",
        model=ModelConfig(),
        tasks=("press", "pick_place"),
        data=DataConfig(num_envs=4),
        optim=OptimConfig(steps=2, batch_size=4, warmup_steps=1),
        evaluation=replace(ACCELERATOR.config.evaluation, episodes=4, num_envs=4),
        log_every=2,
    ),
    counts=(2, 3),
    pilot_count=2,
    stepped=(),
    seeds=(0,),
)


_pilot = functools.partial(judge, scenes=("recorded",))
_cropped = functools.partial(judge, cropped=True)


def get_study(scale: str) -> Study:
    """Return the study; scale smoke only shows that all of it runs."""
    chosen = {"accelerator": ACCELERATOR, "smoke": SMOKE}[scale]
    cells = [cell for backbone in page.BACKBONES for cell in _cells(chosen, backbone)]
    return Study("few", tuple(cells), measure=measure, page=page.blocks, partial=True)


def _cells(scale: Scale, backbone: str) -> Iterator[Cell]:
    """Yield all policies of a backbone: the pilots, then seed by seed."""
    pool = scale.counts[-1]
    for method in METHODS:
        if method not in TUNED_AS:
            for name in _pilots(backbone, method):
                count, rate = scale.pilot_count, rate_of(name)
                config = _config(scale, backbone, method, count, PILOT_SEED, rate=rate)
                yield Cell(name, config, (), f"{backbone}/{method}", evaluate=_pilot, pool=pool)
    kinds = [(m, a, scale.counts, {"augment": _PRESETS[a]}) for m in METHODS for a in page.AUGMENT]
    kinds += [
        (page.STEPPED, page.kind(a, n), scale.stepped, {"augment": _PRESETS[a], "steps": n})
        for a in page.AUGMENT
        for n in page.OTHER_STEPS
    ]
    for seed in scale.seeds:
        for method, kind, counts, changes in kinds:
            for count in counts:
                name = page.cell(backbone, method, kind, count, seed)
                config = _tuned(scale, backbone, method, count, seed, **changes)
                after, group = _pilots(backbone, method), f"{backbone}/{method}/{kind}"
                yield Cell(name, config, after, group, evaluate=judge, pool=pool)
    for part, augment in PARTS.items() if scale.stepped else ():
        method, seed = page.STEPPED, scale.seeds[0]
        name = page.cell(backbone, method, part, pool, seed)
        config = _tuned(scale, backbone, method, pool, seed, augment=augment)
        after, shown = _pilots(backbone, method), _cropped if part.endswith("cropped") else judge
        yield Cell(name, config, after, f"{backbone}/{part}", evaluate=shown, pool=pool)


def _pilots(backbone: str, method: str) -> tuple[str, ...]:
    return tuple(f"{backbone}/{TUNED_AS.get(method, method)}/pilot/{rate}" for rate in RATES)


def _tuned(
    scale: Scale, backbone: str, method: str, count: int, seed: int, **changes: Any
) -> Callable[[Results], Config]:
    """Return what makes a config with the rate of the best pilot; arguments as for `_config`."""
    pilots = _pilots(backbone, method)

    def config(results: Results) -> Config:
        rate = best_rate(results, pilots)
        return _config(scale, backbone, method, count, seed, rate=rate, **changes)

    return config


def _config(
    scale: Scale,
    backbone: str,
    method: str,
    count: int,
    seed: int,
    *,
    rate: float,
    augment: AugmentConfig = _PRESETS["none"],
    steps: int = 0,
) -> Config:
    """Return the config of a policy's run; 0 steps: those of the scale."""
    config, (peft, rules) = scale.config, METHODS[method]
    return replace(
        config,
        peft=peft,
        adapt=rules,
        model=replace(config.model, backbone=backbone),
        data=replace(config.data, episodes=count, augment=augment),
        optim=replace(config.optim, learning_rate=rate, steps=steps or config.optim.steps),
        seed=seed,
    )
