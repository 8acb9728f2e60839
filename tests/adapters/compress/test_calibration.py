"""Activation statistics over a calibration set, and EVA initialization from them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.compress import calibration
from lorasp_jax.adapters.io import native
from lorasp_jax.dense import Dense
from lorasp_jax.peft import LoRA
from tests.adapters.test_adaptation import Net


@pytest.fixture(scope="module")
def net():
    return Net(nnx.Rngs(0))


@pytest.fixture(scope="module")
def moments(net, batches):
    return calibration.input_moments(net, batches)


def inputs(net, x):
    """Inputs of each layer, computed manually."""
    h = net.norm(net.inp(x))
    block_inputs = []
    for kernel, bias in zip(net.blocks.kernel[...], net.blocks.bias[...], strict=True):
        block_inputs.append(h)
        h = h + jnp.tanh(h @ kernel + bias)
    return {"inp": x, "blocks": np.stack(block_inputs), "heads/0": h, "heads/1": h}


def test_moments_match_a_manual_computation(net, batches, moments):
    layer_inputs = [inputs(net, x) for x in batches]
    assert set(moments) == {"inp", "blocks", "heads/0", "heads/1"}
    for path, moment in moments.items():
        rows = np.concatenate([np.asarray(s[path], np.float64) for s in layer_inputs], axis=-2)
        np.testing.assert_allclose(moment, np.swapaxes(rows, -1, -2) @ rows, rtol=1e-4, atol=1e-4)


def test_the_model_is_not_modified(net, batches, moments):
    del moments
    assert not adaptation.methods(net)
    assert isinstance(net.inp, nnx.Linear)
    some = calibration.input_moments(net, batches, "heads/1")
    assert set(some) == {"heads/1"}


def test_padding_is_excluded():
    layer = nnx.List([Dense(5, 3, rngs=nnx.Rngs(0))])
    x = jax.random.normal(jax.random.key(0), (2, 7, 5))
    mask = jnp.arange(7)[None] < jnp.array([[3], [6]])
    forward = lambda model, x: model[0](x, token_mask=mask)  # noqa: E731
    actual = calibration.input_moments(
        layer, [jnp.where(mask[..., None], x, jnp.nan)], forward=forward
    )
    rows = np.asarray(x)[np.asarray(mask)]
    np.testing.assert_allclose(actual["0"], rows.T @ rows, rtol=1e-5, atol=1e-5)


def test_missing_statistics_are_an_error(net, batches):
    with pytest.raises(ValueError, match="blocks"):
        calibration.input_moments(net, batches, forward=lambda model, x: model(x)[0])
    with pytest.raises(ValueError, match="blocks"):
        calibration.input_moments(net, [])


@pytest.mark.parametrize("path", ["inp", "heads/1"])
def test_eva_starts_with_the_right_singular_vectors(path, net, batches, moments):
    """The span of A is that of an SVD of the stacked activations, vector by vector."""
    method = LoRA(rank=3, initialization="eva")
    model = lorasp_jax.adapt(net, [("inp|heads/1", method)], rngs=nnx.Rngs(1), statistics=moments)
    layer = model.inp if path == "inp" else model.heads[1]
    stacked = np.concatenate([np.asarray(inputs(net, x)[path]) for x in batches])
    right = np.linalg.svd(stacked, full_matrices=False)[2][:3]
    params = layer.adapter.get_value()
    np.testing.assert_allclose(np.abs(right @ params["lora_a"]), np.eye(3), atol=1e-3)
    np.testing.assert_array_equal(params["lora_b"], 0)


def test_eva_in_a_stack_is_saved_as_lora(net, batches, moments, tmp_path):
    rules = [("blocks", LoRA(rank=2, initialization="eva"))]
    model = lorasp_jax.adapt(net, rules, rngs=nnx.Rngs(1), statistics=moments)
    stacked = np.concatenate([np.asarray(inputs(net, x)["blocks"]) for x in batches], axis=1)
    for layer, rows in enumerate(stacked):
        right = np.linalg.svd(rows, full_matrices=False)[2][:2]
        a = model.blocks.adapter.get_value()["lora_a"][layer]
        np.testing.assert_allclose(np.abs(right @ a), np.eye(2), atol=1e-3)
    native.save_adapters(tmp_path, model)
    loaded = native.load_adapters(tmp_path, net)
    again = native.load_adapters(tmp_path, model)
    for restored in (loaded, again):
        np.testing.assert_array_equal(restored(batches[0])[0], model(batches[0])[0])


@pytest.mark.parametrize(
    ("rank", "statistics", "message"),
    [
        (2, {}, "needs statistics of the inputs: pass the result of `input_moments`"),
        (2, {"inp": jnp.eye(4)}, r"needs statistics \[5, 5\] .* got \[4, 4\] and 2"),
        (6, {"inp": jnp.eye(5)}, r"a rank of at most 5, got \[5, 5\] and 6"),
    ],
)
def test_eva_needs_statistics_of_its_layer(rank, statistics, message, net):
    method = LoRA(rank=rank, initialization="eva")
    with pytest.raises(ValueError, match=message):
        lorasp_jax.adapt(net, [("inp", method)], rngs=nnx.Rngs(1), statistics=statistics)
