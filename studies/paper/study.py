"""Every table and figure of the LoRA-SP paper (arXiv 2603.07404) in simulation, and its claims.

    python -m lorasp_jax.extras.study --config studies/paper/study.py

The bank has R = 64 directions, where the paper has 128, because the backbones are small. All cells
have the same demonstrations, batches and steps; a policy for one of four tasks takes a quarter of
the steps, and so as many samples of its task. The learning rate of each method is the best of
three, chosen for each backbone with a seed that no table uses, hence on other layouts. LoRA of any
rank takes the rate of LoRA with r = R, and every kind of LoRA-SP that of LoRA-SP.

For Figure 4, full fine-tuning also adapts to the Panda, the robot of pretraining, in a new scene.
It is one other scene, not a range of scenes: like PiPER's, it is the same in all episodes but for
the positions of the objects, so that the two differ in whether the base has seen the robot and not
in how much the scene varies. It trains like full fine-tuning on PiPER, at the same rate.
"""

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from envs import Randomization
from lorasp_jax.config import Config, DataConfig, EvaluationConfig, ModelConfig, OptimConfig
from lorasp_jax.extras.study import Cell, Derived, Study
from lorasp_jax.extras.study.page import BACKBONES
from lorasp_jax.extras.study.results import best_pilot, best_rate
from lorasp_jax.extras.study.study import Results
from lorasp_jax.peft import AdaLoRA, DoRA, FullFineTuning, LoRA, LoRAMoE, LoRASP, Method
from lorasp_jax.policies.policy import Policy
from studies.paper import page
from studies.paper.claims import make_claims
from studies.paper.measures import measure
from studies.paper.tables import RANK
from studies.paper.transforms import cut, pruned

MakeMethod = Callable[[Results], Method]
PILOT_SEED = 1000
"""Seed of the cells that choose learning rates."""
ETAS = (0.5, 0.7, 0.8, 0.99)
"""Energy targets of Table IV besides the default, 0.9."""

NEW_SCENE = Randomization(
    camera_position=(0.03, 0.03),
    camera_turn=(0.03, 0.03),
    table_height=(0.04, 0.04),
    position=(0.02, 0.02),
    turn=(0.3, 0.3),
)
"""The Panda's new scene, relative to that of pretraining (configs/pretrain.py, no randomization):
cameras moved and rotated, a higher table, and all objects moved and rotated on it. The side camera
still sees every object at every start."""


CONFIG = Config(
    name="paper",
    scale="accelerator",
    peft=LoRASP(),
    model=ModelConfig(size="small", dtype="bfloat16"),
    data=DataConfig(episodes=512, num_envs=256),
    optim=OptimConfig(steps=5000, batch_size=128, warmup_steps=100),
    evaluation=EvaluationConfig(episodes=256, num_envs=256, denoise_steps=10, before=False),
    log_every=125,
    checkpoint_every=1250,
)
"""What all cells share; method, rate and seed are replaced."""
ABLATED = "smolvla"
"""The backbone of Tables III and IV."""
SEEDS = (0, 1, 2)
RANKS = (2, 4, 8, 16, 32)
"""LoRA's ranks besides R."""
METHODS = (
    *("lora_sp", "lora_r64", "lora_moe_top1", "lora_moe_weighted", "ada_lora", "full"),
    *("dora", "lora_same_rank", "lora_cut"),
)
"""Methods of Table I."""
RATES = (3e-4, 1e-3, 3e-3)
"""Learning rates to choose among."""


def get_study(scale: str) -> Study:
    """Return the study, which has one scale: accelerator."""
    if scale != "accelerator":
        raise ValueError(f"the study has the scale accelerator, got {scale!r}")
    cells = tuple(cell for backbone in BACKBONES for cell in _cells(backbone))
    cells += tuple(cell for backbone in BACKBONES for cell in _new_scene(backbone))
    claims = make_claims([cell.name for cell in cells], RANK, [*BACKBONES])
    return Study("paper", cells, measure=measure, page=functools.partial(page.blocks, claims))


# Cells


def _cells(backbone: str) -> Iterator[Cell | Derived]:
    """Yield all cells of a backbone, each after those that it needs."""
    families = dict.fromkeys(_family(m) for m in METHODS)
    for family in families:
        yield from _pilots(backbone, family)
    ablations = ["lora_sp_no_spectral", *(f"lora_sp_eta_{eta}" for eta in ETAS)]
    ablations = ablations if backbone == ABLATED else []
    small = [f"lora_r{rank}" for rank in RANKS]
    for method in (*METHODS, *small, *ablations):
        yield from _multi(backbone, method)
    for method in ("lora_sp", *ablations) if ablations else ():
        for seed in SEEDS:
            source = f"{backbone}/multi/{method}/s{seed}"
            name = f"{backbone}/multi/{method}_pruned/s{seed}"
            yield Derived(name, source, lambda policy, _, episodes: pruned(policy, episodes))
    for method in (*small, f"lora_r{RANK}", "full", "lora_sp"):
        yield from _single(backbone, method)


def _family(method: str) -> str:
    """Return the method whose pilot cells choose the learning rate."""
    if method.startswith("lora_sp"):
        return "lora_sp"
    is_lora = method.startswith("lora_r") or method in ("lora_same_rank", "lora_cut")
    return f"lora_r{RANK}" if is_lora else method


def _pilot_names(backbone: str, family: str) -> tuple[str, ...]:
    return tuple(f"{backbone}/pilot/{family}/{rate}" for rate in RATES)


def _pilots(backbone: str, family: str) -> Iterator[Cell]:
    """Yield a cell for each learning rate. AdaLoRA's budget comes from LoRA-SP's best pilot."""
    needs = _pilot_names(backbone, "lora_sp") if family == "ada_lora" else ()

    def config(rate: float, results: Results) -> Config:
        rank = _mean_rank(results, [best_pilot(results, needs)]) if needs else 0.0
        method = _method(family, rank)
        return _config(backbone, method, rate, PILOT_SEED)

    for rate, name in zip(RATES, _pilot_names(backbone, family), strict=True):
        make = functools.partial(config, rate)
        made = make if needs else make({})
        yield Cell(name, made, needs, f"{backbone}/pilot/{family}", measured=False)


def _multi(backbone: str, method: str) -> Iterator[Cell | Derived]:
    """Yield the cells of a method that learns all tasks, one for each seed."""
    group = f"{backbone}/multi/{method}"
    ranked = tuple(f"{backbone}/multi/lora_sp/s{seed}" for seed in SEEDS)
    for seed in SEEDS:
        name = f"{group}/s{seed}"
        if method == "lora_cut":
            source = f"{backbone}/multi/lora_r{RANK}/s{seed}"
            yield Derived(name, source, functools.partial(_cut, ranked), ranked)
            continue
        needs = ranked if method in ("ada_lora", "lora_same_rank") else ()
        # The base is the same for all methods and seeds.
        before = method == "lora_sp" and seed == SEEDS[0]
        yield _trained(backbone, method, name, group, seed, needs=needs, before=before)


def _single(backbone: str, method: str) -> Iterator[Cell]:
    """Yield the cells of a method that learns single tasks, one for each seed and task."""
    group = f"{backbone}/single/{method}"
    for task in CONFIG.tasks:
        for seed in SEEDS:
            name = f"{group}/{task}/s{seed}"
            yield _trained(backbone, method, name, group, seed, tasks=(task,))


def _new_scene(backbone: str) -> Iterator[Cell]:
    """Yield the cells of full fine-tuning on the Panda, one for each seed."""
    group, pilots = f"{backbone}/panda/full", _pilot_names(backbone, "full")

    def config(seed: int, results: Results) -> Config:
        rate, before = best_rate(results, pilots), seed == SEEDS[0]
        made = _config(backbone, FullFineTuning(), rate, seed, before=before)
        return replace(made, robot="panda", scene=NEW_SCENE)

    for seed in SEEDS:
        yield Cell(f"{group}/s{seed}", functools.partial(config, seed), pilots, group)


def _trained(
    backbone: str,
    method: str,
    name: str,
    group: str,
    seed: int,
    *,
    tasks: tuple[str, ...] = (),
    needs: tuple[str, ...] = (),
    before: bool = False,
) -> Cell:
    """Return a cell with the best learning rate, and LoRA-SP's mean rank if it needs that."""
    pilots = _pilot_names(backbone, _family(method))

    def config(results: Results) -> Config:
        rate = best_rate(results, pilots)
        peft = _method(method, _mean_rank(results, needs) if needs else 0.0)
        made = _config(backbone, peft, rate, seed, tasks or CONFIG.tasks, before=before)
        if method != "lora_sp_no_spectral":
            return made
        return replace(made, auxiliary=replace(made.auxiliary, spectral=0.0))

    # The page has costs and measures of multi-task training alone.
    return Cell(name, config, (*pilots, *needs), group, measured=not tasks)


def _config(
    backbone: str,
    method: Method,
    rate: float,
    seed: int,
    tasks: tuple[str, ...] = (),
    *,
    before: bool = False,
) -> Config:
    """Return the config of a cell; steps are in proportion to the number of tasks."""
    tasks = tasks or CONFIG.tasks
    share = len(tasks) / len(CONFIG.tasks)
    optim = CONFIG.optim
    steps, warmup = round(optim.steps * share), round(optim.warmup_steps * share)
    return replace(
        CONFIG,
        peft=method,
        model=replace(CONFIG.model, backbone=backbone),
        tasks=tasks,
        optim=replace(optim, learning_rate=rate, steps=steps, warmup_steps=warmup),
        evaluation=replace(CONFIG.evaluation, before=before),
        seed=seed,
    )


def _method(name: str, mean_rank: float) -> Method:
    """Return a method by name; `mean_rank` is LoRA-SP's, for those that have the same."""
    rank, whole = RANK, max(round(mean_rank), 1)
    if name.startswith("lora_sp_eta_"):
        return LoRASP(rank=rank, energy_target=float(name.removeprefix("lora_sp_eta_")))
    if name.startswith("lora_r"):
        return LoRA(rank=int(name.removeprefix("lora_r")))
    made: dict[str, Callable[[], Method]] = {
        "lora_sp": lambda: LoRASP(rank=rank),
        "lora_sp_no_spectral": lambda: LoRASP(rank=rank),
        "lora_same_rank": lambda: LoRA(rank=whole),
        "lora_moe_top1": lambda: LoRAMoE(experts=4, rank=rank // 4, routing="top1"),
        "lora_moe_weighted": lambda: LoRAMoE(experts=4, rank=rank // 4),
        "ada_lora": lambda: AdaLoRA(rank=rank).match_budget(whole),
        "full": FullFineTuning,
        "dora": lambda: DoRA(rank=rank),
    }
    return made[name]()


def _mean_rank(results: Results, cells: Sequence[str]) -> float:
    return float(np.mean([results[name]["active_rank"]["mean"] for name in cells]))


def _cut(ranked: Sequence[str], policy: Policy, results: Results, _: Mapping) -> Policy:
    """Cut a LoRA policy to LoRA-SP's mean rank by one threshold (PARA, arXiv 2604.27796)."""
    return cut(policy, _mean_rank(results, ranked))
