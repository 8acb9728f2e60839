"""One task from few own episodes of a policy, as the owner of a robot would learn it."""

import dataclasses
import functools
import time
from collections.abc import Iterator, Mapping
from typing import Any, Literal

from envs.datasets import rlds
from lorasp_jax.config import AugmentConfig, OptimConfig
from lorasp_jax.evaluation import recording
from lorasp_jax.evaluation.callback import Evaluation
from lorasp_jax.extras.study import Derived
from lorasp_jax.extras.study.held_out import shared_demonstrations
from lorasp_jax.extras.study.run_cell import simulated
from lorasp_jax.reinforce.config import Learning
from lorasp_jax.training import loop, setup
from lorasp_jax.training.export import Export
from lorasp_jax.training.run import Run
from studies.reinforce import page
from studies.reinforce.judge import Trial, derived, learned

Learn = Literal["imitation", "filtered", "recap"]
EPISODES = {50: (10, 5), 200: (25, 8), 1000: (50, 20)}
"""Number of episodes -> worlds and iterations of learning in noise space."""
_NOISE = Learning(method="noise", std=0.5, epochs=8, max_kl=0.04)
_OPTIM = OptimConfig(batch_size=512, learning_rate=1e-3)


def cells(
    backbone: str, count: int, seed: int, pool: int, numbers: Mapping[int, tuple[int, int]]
) -> Iterator[Derived]:
    """Yield the policies of a start; `pool` as in its cell, `numbers` as `EPISODES`."""
    yield _offline(backbone, count, seed, pool, "imitation", 0)
    for episodes, (worlds, iterations) in numbers.items():
        yield _offline(backbone, count, seed, pool, "filtered", episodes)
        yield _offline(backbone, count, seed, pool, "recap", episodes)
        learning = dataclasses.replace(_NOISE, worlds=worlds)
        optim = dataclasses.replace(_OPTIM, steps=iterations)
        trial = Trial(learning, optim, every=iterations, tasks=(page.OWNED,))
        yield learned(trial, backbone, count, f"noise_{episodes}", seed)


def _offline(
    backbone: str, count: int, seed: int, pool: int, learn: Learn, episodes: int
) -> Derived:
    settings = {"task": page.OWNED, "learn": learn, "episodes": episodes, "pool": pool}
    evaluate = functools.partial(judge, **settings)
    name = f"{learn}_{episodes}"
    return derived(backbone, count, name, seed, {"offline": settings}, evaluate)


def judge(run: Run, task: str, learn: Learn, episodes: int, pool: int) -> dict[str, Any]:
    """Record episodes of a task, train on them and the start's demonstrations, and evaluate.

    The adapters are new, as `train.py --data.source` makes them; without episodes, they learn the
    demonstrations alone.
    """
    folder = run.folder
    single = dataclasses.replace(run.config, tasks=(task,))
    sources = [folder / "demonstrations", *([folder / "tries"] if episodes else [])]
    if not sources[0].exists():
        shared = shared_demonstrations(folder.parents[3], pool, single)
        rlds.write(shared[task], sources[0])
    if episodes and not sources[1].exists():
        seed = run.config.seed
        recording.write(
            run.policy, single, task, sources[1], episodes, seed=seed, progress=lambda _: None
        )
    data = dataclasses.replace(
        single.data,
        source=tuple(map(str, sources)),
        episodes=type(single.data).episodes,
        augment=AugmentConfig("none"),
        validation=("0",),
    )
    config = dataclasses.replace(single, data=data, learn=learn)
    made_folder = folder / "learned"
    made_folder.mkdir(exist_ok=True)
    made = setup.prepare(config, made_folder, run.console, time.perf_counter())
    loop.train(made, [Export(), Evaluation(media=False)], resume=True)
    return simulated(made)
