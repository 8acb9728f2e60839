"""The main contrast on other bases: a second one of the same size, and one seven times as large."""

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from configs.pretrain import get_config
from lorasp_jax.config import Config
from lorasp_jax.extras.study import Cell
from lorasp_jax.extras.study.results import best_rate, rate_of
from lorasp_jax.extras.study.study import Results
from lorasp_jax.peft import AdaLoRA, FullFineTuning, LoRA, LoRASP, Method
from studies.few.judge import judge
from studies.where_it_pays import names

BASES = {"second": ("small", 1, 12_000, 1e-3), "medium": ("medium", 0, 6_000, 5e-4)}
"""Kind -> size, seed, steps and rate of pretraining, else as in configs/pretrain.py."""
SECOND: Mapping[str, Method] = {"lora": LoRA(rank=names.WIDE), "lora_sp": LoRASP(rank=names.WIDE)}
"""Method -> its settings on the second base, at the rate on the first."""
MEDIUM: Mapping[str, tuple[Method, tuple[float, ...]]] = {
    "lora": (LoRA(rank=32), (3e-4, 1e-3)),
    "lora_sp": (LoRASP(rank=32), (3e-4, 1e-3)),
    "ada_lora": (AdaLoRA(rank=32, target_rank=8), (1e-3, 3e-3)),
    "full": (FullFineTuning(), (1e-4, 3e-4)),
}
"""Method -> its settings on the medium base, of which LoRA's are a tenth, and rates of its pilots;
the rows of the paper's Table I."""


def cells(
    backbone: str, seeds: Sequence[int], pool: int, make: Callable[..., Config], scale: str
) -> Iterator[Cell]:
    """Yield the bases of a backbone and their policies; arguments as in `recipes.cells`."""
    for kind, (size, seed, steps, rate) in BASES.items():
        base = get_config(scale)
        if scale == "accelerator":
            base = replace(base, optim=replace(base.optim, steps=steps, learning_rate=rate))
            # Several processes share the device, and none knows what their demonstrations take.
            base = replace(base, model=replace(base.model, size=size, remat="full"))
        base = replace(base, model=replace(base.model, backbone=backbone), seed=seed)
        yield Cell(names.base(backbone, kind), base, (), f"{backbone}/base_{kind}")
    policy = functools.partial(_policy, backbone=backbone, pool=pool, make=make)
    for method, settings in SECOND.items():
        pilots = names.pilots(backbone, method, names.WIDE)
        for seed in seeds:
            yield policy("second", method, settings, f"s{seed}", seed, pilots)
    for method, (settings, rates) in MEDIUM.items():
        tried = [names.on_base(backbone, "medium", method, f"pilot/{rate}") for rate in rates]
        for rate in rates:
            yield policy("medium", method, settings, f"pilot/{rate}", names.PILOT_SEED)
        for seed in seeds:
            yield policy("medium", method, settings, f"s{seed}", seed, tuple(tried))


def _policy(
    kind: str,
    method: str,
    settings: Method,
    name: str,
    seed: int,
    pilots: tuple[str, ...] = (),
    *,
    backbone: str,
    pool: int,
    make: Callable[..., Config],
) -> Cell:
    """Return a policy on a base, at the rate of the best pilot, or in its name."""
    source = names.base(backbone, kind)

    def config(results: Results) -> Config:
        rate = best_rate(results, pilots) if pilots else rate_of(name)
        found = make(backbone, settings, seed=seed, rate=rate)
        where = str(Path("runs") / names.STUDY / source / "base")
        size = BASES[kind][0] if found.scale == "accelerator" else found.model.size
        return replace(found, model=replace(found.model, checkpoint=where, size=size))

    own = names.on_base(backbone, kind, method, name)
    evaluate = judge if pilots else functools.partial(judge, scenes=("recorded",))
    options: dict[str, Any] = {"evaluate": evaluate, "source": source, "pool": pool}
    return Cell(own, config, pilots, f"{backbone}/{kind}/{method}", **options)
