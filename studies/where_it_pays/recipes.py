"""LoRA-SP with one change each: pilots that decide whether a change is worth a table."""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from flax import nnx

from lorasp_jax.adapters import paths
from lorasp_jax.adapters.compress import calibration
from lorasp_jax.config import AuxiliaryConfig, Config
from lorasp_jax.dense import AdaptedLayer, AdapterParam
from lorasp_jax.extras.study import Cell, Derived
from lorasp_jax.extras.study.held_out import shared_demonstrations
from lorasp_jax.extras.study.study import Results
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.peft import LoRA, LoRASP, Method
from lorasp_jax.training import activations, loop, setup
from lorasp_jax.training.run import Run
from studies.few.judge import judge as judge_scenes
from studies.where_it_pays import names
from studies.where_it_pays.judge import best_rate

_BANK = LoRASP(rank=names.WIDE)
RECIPES: Mapping[str, tuple[Method, dict[str, Any]]] = {
    "lora": (LoRA(rank=names.WIDE), {}),
    "lora_sp": (_BANK, {}),
    "eta_0.8": (replace(_BANK, energy_target=0.8), {}),
    "eta_0.99": (replace(_BANK, energy_target=0.99), {}),
    "relu": (replace(_BANK, router="gelu_relu"), {}),
    "softmax": (replace(_BANK, router="gelu_softmax"), {}),
    "spectral_0": (_BANK, {"auxiliary": AuxiliaryConfig(spectral=0.0)}),
    "spectral_0.1": (_BANK, {"auxiliary": AuxiliaryConfig(spectral=0.1)}),
    "balance_0": (_BANK, {"auxiliary": AuxiliaryConfig(balance=0.0)}),
    "scale_1": (replace(_BANK, alpha=1.0 * names.WIDE), {}),
    "scale_4": (replace(_BANK, alpha=4.0 * names.WIDE), {}),
    "expert": (_BANK, {"adapt": ("expert-only=lora_sp:64", "all-linear=lora:64")}),
    "vlm": (_BANK, {"adapt": ("expert-only=lora:64", "all-linear=lora_sp:64")}),
}
"""Method and changed settings by recipe; see `page.RECIPES`."""


def cells(
    backbone: str,
    seed: int,
    pool: int,
    make: Callable[..., Config],
    pilots: Mapping[str, Sequence[str]],
) -> Iterator[Cell | Derived]:
    """Yield the policies of a seed.

    Args:
        make: returns a config, given method, seed, rate and other settings.
        pilots: names of the policies that decide the rate, by method.
    """
    for name, (method, changes) in RECIPES.items():

        def config(results: Results, method: Method = method, changes: Any = changes) -> Config:
            rate = best_rate(results, pilots[method.name])
            return make(method, seed=seed, rate=rate, **changes)

        own, group = names.recipe(backbone, name, seed), f"{backbone}/{name}"
        after = tuple(pilots[method.name])
        yield Cell(own, config, after, group, evaluate=judge_scenes, pool=pool)
    evaluate, source = (
        functools.partial(judge_eva, pool=pool),
        names.recipe(backbone, "lora_sp", seed),
    )
    settings = {"initialization": "eva", "pool": pool}
    own = names.recipe(backbone, "eva", seed)
    yield Derived(own, source, settings=settings, evaluate=evaluate)


def judge_eva(run: Run, pool: int) -> dict[str, Any]:
    """Train the run's policy anew from a bank whose V are the leading inputs of each layer."""
    episodes = shared_demonstrations(run.folder.parents[2], pool, run.config, run.folder, _silent)
    learner = dataclasses.replace(run, episodes=episodes)
    model = setup.build(run.config, run.folder).model
    batches = activations.sampled(learner, run.policy.processor, model.config.chunk)
    moments = calibration.input_moments(model, batches, ".*", activations.loss)
    learner.policy = replace(run.policy, model=_with_leading_inputs(model, moments))
    learner.policy = loop.trained(learner)
    return judge_scenes(learner)


def _silent(*_: Any) -> None:
    """Report no progress."""


def _with_leading_inputs(model: Backbone, moments: Mapping[str, Any]) -> Backbone:
    """Return a model whose V begin with the eigenvectors of Σ x xᵀ (EVA, arXiv 2410.07170).

    They have the length that V have otherwise; a bank wider than the input keeps its other V.
    """
    root = nnx.List([nnx.clone(model)])
    for location in paths.locate(root, AdaptedLayer):
        layer = location.child
        if layer.adapter is None:
            continue
        params = layer.adapter.get_value()
        v = params["bank"]["v"]
        leading = jnp.linalg.eigh(moments[location.path])[1][..., ::-1][..., : v.shape[-1]]
        leading *= jnp.linalg.norm(v[..., : leading.shape[-1]], axis=-2, keepdims=True)
        v = v.at[..., : leading.shape[-1]].set(leading)
        layer.adapter = AdapterParam({**params, "bank": {**params["bank"], "v": v}})
    return root[0]
