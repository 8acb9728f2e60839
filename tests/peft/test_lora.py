"""Test LoRA against Hugging Face PEFT: output, gradients and merged weights of a small net."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.peft import LoRA
from tests import GOLDEN

HF_NAMES = {"lora_a": "lora_A", "lora_b": "lora_B"}
CASES = [
    ("lora_r8", [LoRA(rank=8, alpha=16)] * 3),
    ("lora_rslora", [LoRA(rank=8, alpha=16, rank_stabilized=True)] * 3),
    (
        "lora_rank_alpha_pattern",
        [LoRA(rank=8, alpha=16), LoRA(rank=4, alpha=16), LoRA(rank=8, alpha=4)],
    ),
]


def assert_close(actual, expected, relative):
    """Compare with a tolerance relative to the largest expected value."""
    np.testing.assert_allclose(actual, expected, rtol=0, atol=relative * np.abs(expected).max())


def load(case, names):
    """Load a golden file, its kernels [I, O], and adapter params and gradients in our layout."""
    with np.load(GOLDEN / f"{case}.npz") as file:
        golden = dict(file)

    def adapters(kind):
        return [
            {
                ours: jnp.asarray(golden[f"{kind}/lin.{i}.{theirs}.default.weight"].T)
                for ours, theirs in names.items()
            }
            for i in range(3)
        ]

    kernels = [jnp.asarray(golden[f"base/lin.{i}.weight"].T) for i in range(3)]
    return golden, kernels, adapters("param"), adapters("grad")


def forward(x, golden, layer):
    """Apply the three-layer net with `layer(i, x)` instead of x @ kernels[i]."""
    for i in range(3):
        x = layer(i, x) + golden[f"base/lin.{i}.bias"]
        x = jnp.tanh(x) if i < 2 else x
    return x


def assert_equals_hugging_face(golden, methods, kernels, params, gradients):
    """Compare output, loss, gradients, scales and merged weights with a golden file."""

    def loss(params):
        y = forward(golden["x"], golden, lambda i, x: methods[i].apply(params[i], x, kernels[i])[0])
        return 0.5 * jnp.mean(y**2), y

    @jax.jit
    def results(params):
        merged = [methods[i].merge(params[i], kernels[i]) for i in range(3)]
        y_merged = forward(golden["x"], golden, lambda i, x: x @ merged[i])
        return jax.value_and_grad(loss, has_aux=True)(params), merged, y_merged

    ((value, y), actual), merged, y_merged = results(params)
    assert_close(value, golden["loss"], 1e-5)
    assert_close(y, golden["y"], 1e-5)
    jax.tree.map(lambda a, b: assert_close(a, b, 1e-4), actual, gradients)
    for i in range(3):
        assert methods[i].scale == pytest.approx(float(golden[f"scaling/{i}"]))
        assert_close(merged[i], golden[f"merged/{i}"].T, 1e-5)
    assert_close(y_merged, golden["y_merged"], 1e-5)


@pytest.mark.parametrize(("case", "methods"), CASES)
def test_equals_hugging_face(case, methods):
    golden, kernels, params, gradients = load(case, HF_NAMES)
    assert_equals_hugging_face(golden, methods, kernels, params, gradients)
    for i in range(3):
        delta, _ = methods[i].delta(params[i], jnp.eye(len(kernels[i])))
        assert_close(delta, golden[f"delta_weight/{i}"].T, 1e-5)


def test_initialization():
    """A is uniform in ±1/√I and B zero."""
    params, _ = LoRA(rank=4).init(jax.random.key(0), jax.ShapeDtypeStruct((900, 50), jnp.float32))
    bound = 1 / 30
    assert np.abs(params["lora_a"]).max() == pytest.approx(bound, rel=0.01)
    assert np.std(params["lora_a"]) == pytest.approx(bound / 3**0.5, rel=0.03)
    assert not params["lora_b"].any()
