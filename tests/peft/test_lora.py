"""LoRA against Hugging Face PEFT: forward, gradients and merged weights of a three-layer net."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.peft import LoRA

GOLDEN = Path(__file__).parent.parent / "golden"
CASES = [
    ("lora_r8", LoRA(rank=8, alpha=16)),
    ("lora_rslora", LoRA(rank=8, alpha=16, rank_stabilized=True)),
]


@pytest.mark.parametrize(("case", "method"), CASES)
def test_equals_hugging_face(case, method):
    with np.load(GOLDEN / f"{case}.npz") as file:
        golden = dict(file)
    kernels = [golden[f"base/lin.{i}.weight"].T for i in range(3)]
    biases = [golden[f"base/lin.{i}.bias"] for i in range(3)]

    def factors(kind, i):
        a, b = (golden[f"{kind}/lin.{i}.lora_{side}.default.weight"].T for side in "AB")
        return {"lora_a": a, "lora_b": b}

    def loss(params):
        x = golden["x"]
        for i in range(3):
            x = method.apply(params[i], x, jnp.asarray(kernels[i]))[0] + biases[i]
            x = jnp.tanh(x) if i < 2 else x
        return 0.5 * jnp.mean(x**2), x

    params = [factors("param", i) for i in range(3)]
    (value, y), gradients = jax.jit(jax.value_and_grad(loss, has_aux=True))(params)
    np.testing.assert_allclose(value, golden["loss"], rtol=1e-5)
    np.testing.assert_allclose(y, golden["y"], atol=1e-5 * np.abs(golden["y"]).max())
    for i in range(3):
        assert method.scale == pytest.approx(float(golden[f"scaling/{i}"]))
        merged = method.merge(params[i], jnp.asarray(kernels[i]))
        expected = golden[f"merged/{i}"].T
        np.testing.assert_allclose(merged, expected, atol=1e-5 * np.abs(expected).max())
        for name, expected in factors("grad", i).items():
            tolerance = 1e-4 * np.abs(expected).max()
            np.testing.assert_allclose(gradients[i][name], expected, atol=tolerance)


def test_initialisation_and_count():
    """A is uniform in ±1/√I, B zero: (I + O) R parameters."""
    params, _ = LoRA(rank=4).init(jax.random.key(0), jax.ShapeDtypeStruct((900, 50), jnp.float32))
    assert sum(leaf.size for leaf in jax.tree.leaves(params)) == (900 + 50) * 4
    bound = 1 / 30
    assert np.abs(params["lora_a"]).max() == pytest.approx(bound, rel=0.01)
    assert np.std(params["lora_a"]) == pytest.approx(bound / 3**0.5, rel=0.03)
    assert not params["lora_b"].any()


def test_bad_rank():
    with pytest.raises(ValueError, match="rank must be at least 1, got 0"):
        LoRA(rank=0)
