"""Distillation finds the best LoRA of a rank on the calibration set, and reports its error."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters import adaptation
from lorasp_jax.dense import AdapterParam, Dense
from lorasp_jax.peft import LoRA
from tests.adapters.compress.lora_sp_models import (
    VARIANTS,
    call,
    forward,
    lora_sp_model,
    perturbed,
)
from tests.cases import mostly_slow

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("rank", mostly_slow([None, 2], [None]))
def test_distill_is_the_best_update_of_its_rank(rank, batches):
    """Its error is the least-squares residual; the mean update is worse."""
    layer = Dense(5, 4, use_bias=False, method=VARIANTS[0], rngs=nnx.Rngs(0))
    model = perturbed(nnx.List([layer]))
    one = lambda model, x: model[0](x)  # noqa: E731
    lora, report = lorasp_jax.distill(model, batches, rank, forward=one)
    x = np.concatenate(batches).astype(np.float64)
    y = np.float64(np.concatenate([one(model, b) for b in batches]))
    kernel = np.float64(layer.kernel.get_value())
    best = np.linalg.lstsq(x, y - x @ kernel, rcond=None)[0]
    if rank is not None:
        root = np.linalg.svd(x @ best, full_matrices=False)[2][:rank].T
        best = best @ root @ root.T

    def error(update):
        return np.linalg.norm(x @ (kernel + update) - y) / np.linalg.norm(y)

    params = lora[0].adapter.get_value()
    update = np.float64(params["lora_a"] @ params["lora_b"])
    assert isinstance(lora[0].method, LoRA)
    assert report.output_error == pytest.approx(error(best), rel=1e-4)
    assert error(update) == pytest.approx(error(best), rel=1e-4)
    assert 0.01 < error(update) < 0.9
    mean = np.mean([_update_at(layer, token) for token in jnp.asarray(x[:80], jnp.float32)], axis=0)
    assert error(mean) > 1.01 * error(update)
    merged = adaptation.merge(lora)
    np.testing.assert_allclose(one(merged, batches[0]), one(lora, batches[0]), atol=1e-4)


def _update_at(layer, token):
    """ΔW(x) of one token, as a matrix."""
    params, method = layer.adapter.get_value(), layer.method
    z, _ = method.bottleneck(params, token @ method.down(params), None)
    u = method.up(params)
    s = z / (token @ params["bank"]["v"])
    return np.float64(params["bank"]["v"] * s @ u)


def test_distill_stacks_and_merges(batches):
    model = lora_sp_model(VARIANTS[0])
    lora, report = lorasp_jax.distill(model, batches, forward=forward)
    assert lora.blocks.adapter.get_value()["lora_a"].shape == (3, 4, 4)
    merged = lorasp_jax.merge(lora)
    np.testing.assert_allclose(call(merged, batches[0]), call(lora, batches[0]), atol=1e-4)
    x = np.concatenate([call(model, x) for x in batches])
    y = np.concatenate([call(lora, x) for x in batches])
    assert report.output_error == pytest.approx(np.linalg.norm(y - x) / np.linalg.norm(x), rel=1e-3)


def test_constant_scores_distill_exactly(batches):
    method = dataclasses.replace(VARIANTS[0], energy_target=0.8)
    model = nnx.List([Dense(5, 4, method=method, rngs=nnx.Rngs(0))])
    model = perturbed(model)
    params = model[0].adapter.get_value()
    constant = params["router"] | {"w1": jnp.zeros_like(params["router"]["w1"])}
    model[0].adapter = AdapterParam(params | {"router": constant})
    _, report = lorasp_jax.distill(model, batches, forward=lambda model, x: model[0](x))
    assert report.output_error < 1e-5


def test_bad_rank(batches):
    with pytest.raises(ValueError, match="rank"):
        lorasp_jax.distill(lora_sp_model(VARIANTS[0]), batches, rank=0)
