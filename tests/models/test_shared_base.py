"""Test that an adapter on a shared base acts like one with weights of its own."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from flax import nnx

from lorasp_jax import adapt
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io import native
from lorasp_jax.adapters.paths import by_path
from lorasp_jax.dense import AdapterParam
from lorasp_jax.models import presets
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.shared_base import SharedBase
from lorasp_jax.models.smolvla import SmolVLAConfig
from lorasp_jax.peft import DoRA, FullFineTuning, LoRA, LoRASP
from lorasp_jax.training.base import quantized
from tests.cases import mostly_slow
from tests.models.random_models import observation, random_backbone, with_noise

METHODS = {
    "LoRA, norms in full": [("norm$", FullFineTuning()), *presets.rules("openpi", LoRA(rank=4))],
    "LoRA-SP": presets.rules("expert-only", LoRASP(rank=8)),
    "DoRA": presets.rules("language", DoRA(rank=4)),
    "none": [],
}
CASES = [
    (config, kind, method)
    for config in ("pi0", "smolvla")
    for kind in (None, "nf4")
    for method in METHODS
]
QUICK = [("pi0", None, "LoRA, norms in full"), ("smolvla", "nf4", "LoRA-SP")]


@pytest.mark.parametrize("case", mostly_slow(CASES, QUICK), ids=str)
def test_actions_are_those_of_weights_of_its_own(case, tmp_path):
    name, kind, method = case
    config = {"pi0": Pi0Config, "smolvla": SmolVLAConfig}[name].dummy()
    bare = model = random_backbone(config)
    base = SharedBase(bare, functools.partial(quantized, kind=kind))
    shared = base.attach_model(bare, bare)
    if METHODS[method]:
        graphdef, adapters, frozen = adaptation.split(
            adapt(bare, METHODS[method], rngs=nnx.Rngs(0))
        )
        model = nnx.merge(graphdef, with_noise(adapters, 0.1), frozen)
        native.save_adapters(tmp_path, model)
        shared = base.read(tmp_path)
        assert base.attach_model(model, bare).structure is shared.structure
    noise = np.random.default_rng(0).normal(size=(2, config.chunk, config.action_dim))
    sample = jax.jit(
        lambda s: s.sample_actions(None, observation(config, 2), noise=noise, num_steps=1)
    )
    expected = sample(quantized(model, kind).sampler())
    np.testing.assert_allclose(sample(shared), expected, atol=1e-5)
    assert np.abs(expected).max() > 0.1


def test_loras_of_almost_equal_ranks_have_one_structure():
    model = random_backbone(Pi0Config.dummy())
    base = SharedBase(model)
    first, same, wider = (
        base.attach_model(adapt(model, presets.rules("openpi", method), rngs=nnx.Rngs(0)), model)
        for method in (LoRA(rank=4), LoRA(rank=2, alpha=1, dropout=0.1), LoRA(rank=20))
    )
    shapes = [[array.shape for array in each.own] for each in (first, same, wider)]
    assert first.structure is same.structure is not wider.structure
    assert shapes[0] == shapes[1] != shapes[2]


def test_an_adapter_that_splits_kernels_or_is_of_another_base_is_refused(tmp_path):
    config = Pi0Config.dummy()
    model = random_backbone(config)
    base = SharedBase(model)
    rules = presets.rules("expert-only", LoRA(rank=2, initialization="pissa"))
    native.save_adapters(tmp_path / "split", adapt(model, rules, rngs=nnx.Rngs(0)))
    with pytest.raises(ValueError, match="splits the kernel"):
        base.read(tmp_path / "split")
    other = adapt(
        random_backbone(config, seed=1), presets.rules("openpi", LoRA(rank=2)), rngs=nnx.Rngs(0)
    )
    native.save_adapters(tmp_path / "other", other)
    with pytest.raises(ValueError, match="trained on another base"):
        base.read(tmp_path / "other")


def test_factors_are_stored_in_the_dtype_that_they_are_multiplied_in():
    """Samplers round them in any case; routers and projections outside the towers stay fp32."""
    config = dataclasses.replace(Pi0Config.dummy(), dtype="bfloat16", param_dtype="bfloat16")
    model = random_backbone(config)
    graphdef, adapters, frozen = adaptation.split(
        adapt(model, presets.rules("expert-only", LoRASP(rank=8)), rngs=nnx.Rngs(0))
    )
    adapted = nnx.merge(graphdef, with_noise(adapters, 0.1), frozen)
    shared = SharedBase(model).attach_model(adapted, model)
    arrays = by_path(nnx.state(adapted, AdapterParam))
    factors = sum(a.nbytes for n, a in arrays.items() if "/bank/" in n and "blocks" in n)
    whole = sum(array.nbytes for array in arrays.values())
    assert sum(array.nbytes for array in shared.own) == whole - factors // 2
    noise = np.random.default_rng(0).normal(size=(2, config.chunk, config.action_dim))
    sample = jax.jit(
        lambda s: s.sample_actions(None, observation(config, 2), noise=noise, num_steps=1)
    )
    np.testing.assert_allclose(sample(shared), sample(adapted.sampler()), atol=0.05)
