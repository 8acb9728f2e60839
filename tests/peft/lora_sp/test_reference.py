"""Test values and gradients of the fast path against the reference implementation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.dense import dense
from lorasp_jax.peft import LoRASP
from lorasp_jax.peft.lora_sp import reference


def normal(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape).astype("f")


def random_params(method, d_in, d_out, spread=1.0):
    """Parameters with U and W2 far from their initial values, so that the scores differ."""
    shapes = jax.eval_shape(lambda: method.init_params(jax.random.key(0), d_in, d_out))
    params = jax.tree.map(lambda leaf: normal(0, *leaf.shape) / leaf.shape[0] ** 0.5, shapes)
    params["bank"]["u"] = normal(1, method.rank, d_out) / np.float32(8)
    params["router"]["w2"] = np.float32(spread) * normal(2, method.hidden_width, method.rank)
    return params


def results(layer, *arguments):
    """y, the losses, and the gradients of a scalar function of both."""

    def loss(*arguments):
        y, losses = layer(*arguments)
        return jnp.sum(jnp.sin(y.astype(jnp.float32))) + sum(losses.values()), (y, losses)

    count = range(len(arguments))
    return jax.jit(jax.value_and_grad(loss, argnums=tuple(count), has_aux=True))(*arguments)


def fast(method):
    def layer(params, x, kernel):
        y, aux = method.apply(params, x, kernel)
        return y, dict(aux.losses)

    return layer


def paper(method):
    def layer(params, x, kernel):
        return reference.lora_sp(params, x, kernel, method.energy_target, method.scale)

    return layer


def assert_close(actual, expected, tolerance):
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for a, b in zip(*map(jax.tree.leaves, (actual, expected)), strict=True):
        error = np.linalg.norm(np.asarray(a, np.float64) - np.asarray(b, np.float64))
        assert error <= tolerance * max(np.linalg.norm(np.asarray(b, np.float64)), 1e-3)


@pytest.mark.parametrize(
    ("tokens", "d_in", "d_out", "fields"),
    [
        (48, 24, 20, {"rank": 32, "hidden_width": 16, "energy_target": 0.5, "alpha": 5.0}),
        (1, 6, 40, {"rank": 48, "hidden_width": 3}),  # a bank wider than the layer
        (7, 8, 8, {"rank": 1, "hidden_width": 1}),
    ],
)
def test_fast_path_equals_the_reference(tokens, d_in, d_out, fields):
    """Compare values and the gradients of all parameters, x and the kernel."""
    method = LoRASP(**fields)
    arguments = (
        random_params(method, d_in, d_out),
        normal(3, tokens, d_in),
        normal(4, d_in, d_out),
    )
    actual, expected = (results(layer(method), *arguments) for layer in (fast, paper))
    assert_close(actual, expected, 1e-4)


def test_bfloat16_equals_the_reference_up_to_rounding():
    method = LoRASP(rank=32, hidden_width=16)
    half = [
        (a / np.float32(4)).astype(jnp.bfloat16) for a in (normal(3, 96, 24), normal(4, 24, 20))
    ]
    params = random_params(method, 24, 20, spread=0.3)
    actual = results(fast(method), params, *half)
    expected = results(paper(method), params, *(a.astype("f") for a in half))
    assert actual[0][1][0].dtype == jnp.bfloat16
    assert_close(actual, expected, 0.05)


def test_dense_equals_the_reference():
    """The public `dense` agrees, with token axes and a bias."""
    method = LoRASP(rank=16, hidden_width=8, energy_target=0.7)
    params, x, kernel, bias = (
        random_params(method, 6, 5),
        normal(3, 2, 9, 6),
        normal(4, 6, 5),
        normal(5, 5),
    )
    y, aux = jax.jit(lambda x: dense(x, kernel, bias, params, method))(x)
    expected, losses = jax.jit(paper(method))(params, x.reshape(18, 6), kernel)
    assert_close(y, (np.asarray(expected) + bias).reshape(2, 9, 5), 1e-5)
    assert_close(dict(aux.losses), losses, 1e-5)


def test_gate_keeps_the_smallest_set():
    gate = jax.jit(reference.energy_gate)
    scores = np.array([[3, 1, 2, 0]], "f")  # energy 9, 1, 4, 0 of 14
    for target, kept in ((0.6, [1, 0, 0, 0]), (0.9, [1, 0, 1, 0]), (0.93, [1, 1, 1, 0])):
        mask, kept_energy = gate(scores, target)
        np.testing.assert_array_equal(mask, [kept])
        assert float(kept_energy.item()) == pytest.approx(sum(np.array(kept) * [9, 1, 4, 0]) / 14)
