"""Where does adaptive rank pay? LoRA-SP and LoRA of every rank, and LoRA with ranks by layer.

    lorasp-jax study --config studies/where_it_pays/study.py \\
        --results studies/where_it_pays/results.json --jobs 8

Policies learn four tasks as in studies/few, from 120 demonstrations of each. Every method and rank
has the best of three learning rates, chosen with a seed that no table uses; LoRA with ranks by
layer takes that of LoRA with their mean, AdaLoRA that of one mean rank.
"""

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from flax import nnx

from lorasp_jax import models
from lorasp_jax.config import AugmentConfig, Config, EvaluationConfig
from lorasp_jax.extras.deployment import healing
from lorasp_jax.extras.study import Cell, Derived, Study
from lorasp_jax.extras.study.results import best_rate, rate_of
from lorasp_jax.extras.study.study import Results
from lorasp_jax.models import presets
from lorasp_jax.peft import AdaLoRA, LoRA, LoRASP, Method, plan
from lorasp_jax.training import rules
from studies.few import study as few
from studies.few.judge import judge as judge_scenes
from studies.where_it_pays import bases, cutting, forms, names, page, recipes, sequences
from studies.where_it_pays.judge import judge

MAKE: Mapping[str, Callable[[int], Method]] = {
    "lora": lambda rank: LoRA(rank=rank),
    "lora_sp": lambda rank: LoRASP(rank=rank),
    "ada_lora": lambda rank: AdaLoRA(rank=names.WIDE, target_rank=rank),
    page.HALF: lambda rank: LoRASP(rank=rank),
    "eva": lambda rank: LoRA(rank=rank, initialization="eva"),
}
"""Method by its (mean) rank."""
TUNED_AS = {"lora_sp": "lora_sp", page.HALF: "lora_sp", "ada_lora": "ada_lora"}
"""Method -> the one whose pilots decide its rate, if that is not LoRA."""


@dataclass(frozen=True)
class Scale:
    """What the policies of a scale share.

    Attributes:
        config: everything but method, rank, rate and seed.
        pool: demonstrations per task, of which each seed takes its own.
        ranks: R of LoRA and LoRA-SP.
        budgets: mean ranks of plans.
        heal: steps by which forms train on.
        seeds: seeds of the tables.
    """

    config: Config
    pool: int = 512
    ranks: tuple[int, ...] = page.RANKS
    budgets: tuple[int, ...] = page.BUDGETS
    heal: int = page.HEAL
    seeds: tuple[int, ...] = names.SEEDS


def _own(shared: Config, episodes: int) -> Config:
    """Return the config of studies/few with this study's demonstrations and flow steps."""
    data = replace(shared.data, episodes=episodes, augment=AugmentConfig("none"))
    evaluation = replace(shared.evaluation, denoise_steps=EvaluationConfig.denoise_steps)
    return replace(shared, name="where_it_pays", data=data, evaluation=evaluation)


_ACCELERATOR = Scale(_own(few.ACCELERATOR.config, 120))
_SMOKE = Scale(
    _own(few.SMOKE.config, 2), pool=3, ranks=(8, names.WIDE), budgets=(8,), heal=1, seeds=(0, 1)
)


def get_study(scale: str) -> Study:
    """Return the study; scale smoke only shows that all of it runs."""
    chosen = {"accelerator": _ACCELERATOR, "smoke": _SMOKE}[scale]
    pool, seeds, make = chosen.pool, chosen.seeds, functools.partial(_config, chosen)
    base = {"seeds": seeds, "pool": pool, "make": make, "scale": scale}
    parts = (
        functools.partial(_ranked, chosen),
        _by_seed(seeds, forms.cells, pool=pool, steps=chosen.heal),
        _by_seed(seeds, sequences.cells, pool=pool, ranks=chosen.ranks),
        _by_seed(seeds, functools.partial(_allocated, chosen)),
        _by_seed(page.RECIPE_SEEDS[: len(seeds)], recipes.cells, pool=pool, make=make),
        functools.partial(bases.cells, **base),
    )
    cells = [cell for part in parts for backbone in page.BACKBONES for cell in part(backbone)]
    return Study(names.STUDY, tuple(cells), page=page.blocks, partial=True)


def _ranked(scale: Scale, backbone: str) -> Iterator[Cell | Derived]:
    """Yield the pilots of a backbone, then LoRA and LoRA-SP of every rank, seed by seed."""
    pilot = functools.partial(judge_scenes, scenes=("recorded",))
    cases = [(method, rank) for rank in scale.ranks for method in names.METHODS]
    for method, rank in (*cases, ("ada_lora", _middle(scale))):
        for name in names.pilots(backbone, method, rank):
            config = _config(scale, backbone, MAKE[method](rank), names.PILOT_SEED, rate_of(name))
            group = f"{backbone}/{method}_r{rank}"
            yield Cell(name, config, (), group, evaluate=pilot, pool=scale.pool)
    for seed in scale.seeds:
        for method, rank in cases:
            yield _cell(scale, backbone, method, rank, seed)


def _by_seed(
    seeds: Sequence[int], cells: Callable[..., Iterator[Cell | Derived]], **settings: Any
) -> Callable[[str], Iterator[Cell | Derived]]:
    """Return what yields the cells of a backbone, seed by seed."""
    return lambda backbone: (x for seed in seeds for x in cells(backbone, seed, **settings))


def _allocated(scale: Scale, backbone: str, seed: int) -> Iterator[Cell | Derived]:
    """Yield the policies of a seed whose layers differ in rank, and their rivals."""
    own = names.cell(backbone, "lora_sp", names.WIDE, seed)
    following = scale.seeds[(scale.seeds.index(seed) + 1) % len(scale.seeds)]
    other = names.cell(backbone, "lora_sp", names.WIDE, following)
    yield (half := _cell(scale, backbone, page.HALF, names.WIDE, seed))
    (twin,) = (x for x in page.BACKBONES if x != backbone)
    twin = names.cell(twin, "lora_sp", names.WIDE, seed)
    for kind, source in (("other_backbone", twin), ("other_tasks", half.name)):
        yield _cell(scale, backbone, kind, scale.budgets[0], seed, source)
    yield _cell(scale, backbone, "other_seed", scale.budgets[0], seed, other)
    for kind in ("dropped", "dropped_random"):
        yield _cell(scale, backbone, kind, scale.budgets[0], seed, own)
    for rank in scale.budgets:
        for kind in ("planned", "shuffled"):
            yield _cell(scale, backbone, kind, rank, seed, own)
        for method in ("ada_lora", "eva"):
            yield _cell(scale, backbone, method, rank, seed)
        for kind, steps in (("cut", 0), ("cut_healed", scale.heal)):
            settings = {"rank": rank, "steps": steps, "pool": scale.pool}
            yield Derived(
                names.cell(backbone, kind, rank, seed),
                names.cell(backbone, "lora", names.WIDE, seed),
                settings=settings | {"rate": healing.RATE},
                evaluate=functools.partial(cutting.judge, **settings),
            )


def _cell(scale: Scale, backbone: str, method: str, rank: int, seed: int, source: str = "") -> Cell:
    """Return a policy; the active ranks of `source` decide the ranks of its layers, if given."""
    at = _middle(scale) if method == "ada_lora" else rank
    pilots = names.pilots(backbone, TUNED_AS.get(method, "lora"), at)

    def config(results: Results) -> Config:
        made = MAKE.get(method, MAKE["lora"])(rank)
        found = _config(scale, backbone, made, seed, best_rate(results, pilots))
        if method == page.HALF:
            return replace(found, tasks=found.tasks[: len(found.tasks) // 2])
        if method == "eva":  # which needs at most as many directions as a layer has inputs
            return replace(found, plan=_in_all(backbone, scale, rank))
        if not source:
            return found
        active = results[source]["layer_active_rank"]
        return replace(found, plan=make_plan(method, backbone, scale, active, rank, seed))

    after = (*pilots, source) if source else pilots
    group = f"{backbone}/{method}_r{rank}" if not source else ""  # a plan is a program of its own
    name = names.cell(backbone, method, rank, seed)
    evaluate = judge if method in names.METHODS else functools.partial(judge, scenes=("recorded",))
    return Cell(name, config, after, group, evaluate=evaluate, pool=scale.pool)


def _middle(scale: Scale) -> int:
    """Return the mean rank that decides AdaLoRA's rate."""
    return scale.budgets[len(scale.budgets) // 2]


def make_plan(
    kind: str,
    backbone: str,
    scale: Scale,
    active: Mapping[str, Mapping[str, list[float]]],
    rank: int,
    seed: int,
) -> plan.RankPlan:
    """Return ranks by layer, with as many parameters as `rank` in every layer.

    Args:
        kind: "planned" and "other_..." are in proportion to the active ranks, of which a layer has
            the mean over layers of its kind if they are those of another backbone; "shuffled"
            permutes them among layers of one size. "dropped" gives the kinds of layers with the
            lowest active rank no adapter, until half of the parameters are left, "dropped_random"
            others.
        backbone: name.
        scale: whose model has the layers.
        active: mean active ranks by tower and layer, as in results.json.
        rank: of the budget; with "dropped", that of the other layers.
        seed: of "shuffled" and "dropped_random".
    """
    shapes = _shapes(backbone, scale.config.model.size, scale.config.targets)
    if kind == "other_backbone":
        ranks = {
            path: (_of_kind(active, path),) * layers for path, (layers, _, _) in shapes.items()
        }
    else:
        ranks = {path: tuple(active[rules.tower(path)][rules.short_name(path)]) for path in shapes}
    if kind.startswith("dropped"):
        return plan.RankPlan(backbone, _without_half(kind, shapes, ranks, rank, seed), rule=kind)
    budget = rank * sum(layers * (d_in + d_out) for layers, d_in, d_out in shapes.values())
    found = plan.allocate(ranks, shapes, budget, most=names.WIDE)
    made = plan.RankPlan(backbone, found, rule=kind, budget=budget)
    return plan.shuffled(made, shapes, jax.random.key(seed)) if kind == "shuffled" else made


def _of_kind(active: Mapping[str, Mapping[str, list[float]]], path: str) -> float:
    """Return the mean active rank of another backbone's layers of the kind and tower of a layer."""
    kind = path.rpartition("/")[2]
    stacks = active[rules.tower(path)].items()
    return float(
        np.mean([x for name, ranks in stacks if name.rpartition("/")[2] == kind for x in ranks])
    )


def _without_half(
    kind: str,
    shapes: plan.Shapes,
    ranks: Mapping[str, tuple[float, ...]],
    rank: int,
    seed: int,
) -> dict[str, tuple[int, ...]]:
    """Drop whole stacks, in ascending order of active rank or in random order."""
    paths = sorted(shapes, key=lambda path: np.mean(ranks[path]))
    if kind == "dropped_random":
        paths = [paths[i] for i in np.random.default_rng(seed).permutation(len(paths))]
    sizes = {path: layers * (d_in + d_out) for path, (layers, d_in, d_out) in shapes.items()}
    kept, left = dict.fromkeys(shapes, rank), sum(sizes.values())
    for path in paths:
        if left - sizes[path] >= sum(sizes.values()) / 2:
            kept[path], left = 0, left - sizes[path]
    return {path: _at_most(each, shapes[path]) for path, each in kept.items()}


def _in_all(backbone: str, scale: Scale, rank: int) -> plan.RankPlan:
    """Return a plan of one rank in all layers that are not smaller."""
    shapes = _shapes(backbone, scale.config.model.size, scale.config.targets)
    ranks = {path: _at_most(rank, shape) for path, shape in shapes.items()}
    return plan.RankPlan(backbone, ranks, rule="uniform")


def _at_most(rank: int, shape: tuple[int, int, int]) -> tuple[int, ...]:
    layers, *sizes = shape
    return (min(rank, *sizes),) * layers


@functools.cache
def _shapes(backbone: str, size: str, targets: tuple[str, ...]) -> plan.Shapes:
    """Return the shapes of the adapted layers of a backbone, without its weights."""
    config = getattr(models.backbone.find(backbone), size)()
    model = nnx.eval_shape(lambda: config.create(nnx.Rngs(0)))
    return rules.shapes(model, presets.patterns(targets))


def _config(
    scale: Scale, backbone: str, method: Method, seed: int, rate: float, **changes: Any
) -> Config:
    """Return the config of a policy's run."""
    config = scale.config
    return replace(
        config,
        peft=method,
        model=replace(config.model, backbone=backbone),
        optim=replace(config.optim, learning_rate=rate),
        seed=seed,
        **changes,
    )
