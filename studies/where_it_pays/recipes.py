"""LoRA-SP with one change each: pilots that decide whether a change is worth a table."""

import functools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.adapters import paths
from lorasp_jax.adapters.compress import calibration
from lorasp_jax.config import AuxiliaryConfig, Config
from lorasp_jax.dense import AdaptedLayer, AdapterParam
from lorasp_jax.extras.study import Cell, Derived
from lorasp_jax.extras.study.held_out import shared_demonstrations
from lorasp_jax.extras.study.results import best_rate
from lorasp_jax.extras.study.study import Results
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.peft import LoRASP, Method
from lorasp_jax.peft.auxiliary import Aux
from lorasp_jax.peft.method import Params
from lorasp_jax.training import activations, fixed_batches, loop, rules, setup
from lorasp_jax.training.run import Run
from studies.few.judge import judge as judge_scenes
from studies.where_it_pays import names

_BANK = LoRASP(rank=names.WIDE)
RECIPES: Mapping[str, tuple[Method, dict[str, Any]]] = {
    "lora_sp": (_BANK, {}),
    "eta_0.8": (replace(_BANK, energy_target=0.8), {}),
    "eta_0.99": (replace(_BANK, energy_target=0.99), {}),
    "relu": (replace(_BANK, router="gelu_relu"), {}),
    "softmax": (replace(_BANK, router="gelu_softmax"), {}),
    "spectral_0": (_BANK, {"auxiliary": AuxiliaryConfig(spectral=0.0)}),
    "spectral_0.1": (_BANK, {"auxiliary": AuxiliaryConfig(spectral=0.1)}),
    "balance_0": (_BANK, {"auxiliary": AuxiliaryConfig(balance=0.0)}),
    "z_0.01": (_BANK, {"auxiliary": AuxiliaryConfig(z=0.01)}),
    "scale_1": (replace(_BANK, alpha=1.0 * names.WIDE), {}),
    "scale_4": (replace(_BANK, alpha=4.0 * names.WIDE), {}),
    "expert": (_BANK, {"adapt": ("expert-only=lora_sp:64", "all-linear=lora:64")}),
    "vlm": (_BANK, {"adapt": ("expert-only=lora:64", "all-linear=lora_sp:64")}),
}
"""Method and changed settings by recipe; see `page.RECIPES`."""


def cells(
    backbone: str, seed: int, pool: int, make: Callable[..., Config]
) -> Iterator[Cell | Derived]:
    """Yield the policies of a seed.

    Args:
        make: returns a config, given backbone, method, seed, rate and other settings.
    """
    for name, (method, changes) in RECIPES.items():
        methods = ("lora_sp", "lora") if "adapt" in changes else ("lora_sp",)
        tried = [names.pilots(backbone, x, names.WIDE) for x in methods]

        def config(
            results: Results, method: Method = method, changes: Any = changes, tried: Any = tried
        ) -> Config:
            rate = min(best_rate(results, each) for each in tried)
            return make(backbone, method, seed=seed, rate=rate, **changes)

        own, group = names.recipe(backbone, name, seed), f"{backbone}/{name}"
        after = tuple(pilot for each in tried for pilot in each)
        yield Cell(own, config, after, group, evaluate=judge_scenes, pool=pool)
    source = names.recipe(backbone, "lora_sp", seed)
    for name in CHANGES:
        evaluate = functools.partial(judge_changed, name=name, pool=pool)
        settings = {"change": name, "pool": pool}
        own = names.recipe(backbone, name, seed)
        yield Derived(own, source, settings=settings, evaluate=evaluate)


def judge_changed(run: Run, name: str, pool: int) -> dict[str, Any]:
    """Train the run's policy anew, with one of `CHANGES` of its new adapters."""
    episodes = shared_demonstrations(run.folder.parents[2], pool, run.config)
    learner = run.with_policy(run.policy, episodes=episodes)
    model = CHANGES[name](learner, setup.build(run.config, run.folder).model)
    learner.policy = replace(run.policy, model=model)
    learner.policy = loop.trained(learner)
    return judge_scenes(learner)


def _eva(run: Run, model: Backbone) -> Backbone:
    """Begin with the leading directions of each layer's inputs x (EVA, arXiv 2410.07170)."""
    batches = activations.sampled(run, run.policy.processor, model.config.chunk)
    moments = calibration.input_moments(model, batches, ".*", fixed_batches.forward)
    return _changed(model, lambda path, layer: _with_leading(layer, moments[path]))


def _pissa(run: Run, model: Backbone) -> Backbone:
    """Begin with the leading directions of each kernel (as PiSSA, arXiv 2404.02948), but U = 0."""
    del run

    def change(path: str, layer: AdaptedLayer) -> None:
        del path
        kernel = layer.kernel_matrices().astype(jnp.float32)
        _with_leading(layer, kernel @ kernel.mT)

    return _changed(model, change)


def _with_leading(layer: AdaptedLayer, moments: jax.Array) -> None:
    """Let V of a layer begin with the leading eigenvectors of `moments` `[..., I, I]`.

    They have the length that V have otherwise; a bank wider than the input keeps its other V.
    """
    _, params = layer.method_and_params()
    v = params["bank"]["v"]
    leading = jnp.linalg.eigh(moments)[1][..., ::-1][..., : v.shape[-1]]
    leading *= jnp.linalg.norm(v[..., : leading.shape[-1]], axis=-2, keepdims=True)
    v = v.at[..., : leading.shape[-1]].set(leading)
    layer.adapter = AdapterParam({**params, "bank": {**params["bank"], "v": v}})


class _SharedInChunk(LoRASP):
    """LoRA-SP whose tokens all have the mean of their scores."""

    def bottleneck(
        self, params: Params, rows: jax.Array, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """Average what the router sees over tokens `[..., T]`, all valid, if there are some."""
        if rows.ndim > 2:
            hidden = rows[..., self.rank :]
            hidden = jnp.broadcast_to(hidden.mean(-2, keepdims=True), hidden.shape)
            rows = jnp.concatenate([rows[..., : self.rank], hidden], axis=-1)
        return super().bottleneck(params, rows, token_mask)

    def implementation(self, params: Params) -> LoRASP:
        """These functions, not the fused kernel."""
        del params
        return self


def _with_methods(run: Run, model: Backbone, action: Method, others: Method) -> Backbone:
    """Give the layers of the action expert a method, and the others another, of the same size."""
    del run

    def change(path: str, layer: AdaptedLayer) -> None:
        layer.method = action if rules.tower(path) == "action" else others

    return _changed(model, change)


def _changed(model: Backbone, change: Callable[[str, AdaptedLayer], None]) -> Backbone:
    """Return a copy of a model, after a change of each of its adapted layers, given their paths."""
    root = nnx.List([nnx.clone(model)])
    for location in paths.locate(root, AdaptedLayer):
        if location.child.adapter is not None:
            change(location.path, location.child)
    return root[0]


_LOW, _HIGH = (replace(_BANK, energy_target=target) for target in (0.8, 0.99))
CHANGES: Mapping[str, Callable[[Run, Backbone], Backbone]] = {
    "eva": _eva,
    "pissa": _pissa,
    "eta_vlm": functools.partial(_with_methods, action=_LOW, others=_HIGH),
    "eta_expert": functools.partial(_with_methods, action=_HIGH, others=_LOW),
    "chunk": functools.partial(_with_methods, action=_SharedInChunk(names.WIDE), others=_BANK),
}
"""Changes of a model with new adapters by recipe; see `page.RECIPES`."""
