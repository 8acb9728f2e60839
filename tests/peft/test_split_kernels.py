"""Initializations that split the kernel: PiSSA and OLoRA."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io import native
from lorasp_jax.dense import Dense, LinenDense
from lorasp_jax.peft import DoRA, LoRA

KERNEL = jax.random.normal(jax.random.key(0), (9, 14))
X = jax.random.normal(jax.random.key(1), (5, 9))
SPLIT = pytest.mark.parametrize("name", ["pissa", "olora"])
CLASSES = pytest.mark.parametrize("cls", [LoRA, DoRA])


def lora(name, cls=LoRA, **fields):
    return cls(**{"rank": 3, "alpha": 5.0, "initialization": name} | fields)


def model(depth=None):
    """A model with one layer, or with a stack of `depth` layers."""

    class Net(nnx.Module):
        def __init__(self):
            self.layer = Dense(9, 14, rngs=nnx.Rngs(0))
            if depth:
                kernels = jax.random.normal(jax.random.key(2), (depth, 9, 14))
                self.layer.kernel = nnx.Param(kernels)

    return Net()


@SPLIT
@CLASSES
def test_initially_equals_the_base(name, cls):
    method = lora(name, cls)
    params, residual = method.init(jax.random.key(3), KERNEL)
    np.testing.assert_allclose(method.apply(params, X, residual)[0], X @ KERNEL, atol=1e-5)
    np.testing.assert_allclose(method.merge(params, residual), KERNEL, atol=1e-5)
    assert np.abs(residual - KERNEL).max() > 0.1


def test_pissa_is_the_best_approximation():
    method = lora("pissa")
    params, residual = method.init(jax.random.key(3), KERNEL)
    values = np.linalg.svd(np.asarray(KERNEL), compute_uv=False)
    np.testing.assert_allclose(np.linalg.norm(residual), np.linalg.norm(values[3:]), rtol=1e-5)
    residual_values = np.linalg.svd(np.asarray(residual), compute_uv=False)
    np.testing.assert_allclose(residual_values[:6], values[3:], rtol=1e-4)
    a, b = params["lora_a"], params["lora_b"]
    np.testing.assert_allclose(jnp.linalg.norm(a, axis=0), jnp.linalg.norm(b, axis=1), rtol=1e-5)


def test_olora_is_orthonormal():
    method = lora("olora")
    params, residual = method.init(jax.random.key(3), KERNEL)
    a, b = map(np.asarray, (params["lora_a"], params["lora_b"]))
    np.testing.assert_allclose(b @ b.T, np.eye(3), atol=1e-5)
    orthonormal, triangular = np.linalg.qr(np.asarray(KERNEL).T)
    np.testing.assert_allclose(np.abs(b), np.abs(orthonormal[:, :3].T), atol=1e-5)
    np.testing.assert_allclose(a @ b, (orthonormal[:, :3] @ triangular[:3]).T, atol=1e-5)
    np.testing.assert_allclose(residual, KERNEL - 5 / 3 * a @ b, atol=1e-5)


@SPLIT
def test_bfloat16_base_keeps_its_dtype(name):
    low = KERNEL.astype(jnp.bfloat16)
    method = lora(name)
    params, residual = method.init(jax.random.key(3), low)
    assert residual.dtype == jnp.bfloat16
    assert {leaf.dtype for leaf in params.values()} == {jnp.dtype("float32")}
    np.testing.assert_allclose(method.merge(params, residual), low, atol=0.05)


@SPLIT
@pytest.mark.parametrize("depth", [None, 2])
def test_adapting_and_merging_restores_the_kernel(name, depth):
    base = model(depth)
    kernel = np.asarray(base.layer.kernel.get_value())
    adapted = adaptation.adapt(base, [("layer", lora(name))], rngs=nnx.Rngs(0))
    residual = adapted.layer.kernel.get_value()
    assert np.abs(residual - kernel).max() > 0.1
    np.testing.assert_array_equal(base.layer.kernel.get_value(), kernel)
    merged = adaptation.merge(adapted)
    np.testing.assert_allclose(merged.layer.kernel.get_value(), kernel, atol=1e-5)


@pytest.mark.parametrize("method", [LoRA(rank=3), lora("pissa"), lora("olora")], ids=str)
def test_layers_with_a_shared_kernel(method):
    class Tied(nnx.Module):
        def __init__(self):
            self.first, self.second = (Dense(9, 14, rngs=nnx.Rngs(i)) for i in range(2))
            self.second.kernel = self.first.kernel

    base = Tied()
    adapted = adaptation.adapt(base, [(".*", method)], rngs=nnx.Rngs(0))
    np.testing.assert_allclose(adapted.second(X), base.second(X), atol=1e-5)
    for layer in (adapted.first, adapted.second):
        params = layer.adapter.get_value()
        layer.adapter.set_value(jax.tree.map(lambda leaf: leaf + 0.2, params))
    merged = adaptation.merge(adapted)
    np.testing.assert_allclose(merged.first(X), adapted.first(X), atol=1e-4)
    np.testing.assert_allclose(merged.second(X), adapted.second(X), atol=1e-4)


@SPLIT
def test_save_and_load_with_the_original_base(name, tmp_path):
    adapted = adaptation.adapt(model(), [("layer", lora(name))], rngs=nnx.Rngs(0))
    trained = adapted.layer.adapter.get_value()
    adapted.layer.adapter.set_value(jax.tree.map(lambda leaf: leaf + 0.1, trained))
    native.save_adapters(tmp_path, adapted)
    loaded = native.load_adapters(tmp_path, model())
    np.testing.assert_allclose(loaded.layer(X), adapted.layer(X), atol=1e-5)


@SPLIT
def test_replacing_a_split_adapter_requires_merging(name):
    adapted = adaptation.adapt(model(), [("layer", lora(name))], rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match="already has a lora adapter: merge"):
        adaptation.adapt(adapted, [("layer", LoRA(rank=2))], rngs=nnx.Rngs(0))
    adaptation.adapt(adaptation.merge(adapted), [("layer", LoRA(rank=2))], rngs=nnx.Rngs(0))


@SPLIT
def test_linen_does_not_support_splitting(name):
    with pytest.raises(ValueError, match="changes the kernel, which Linen does not allow"):
        LinenDense(14, method=lora(name)).init(jax.random.key(0), X)
    assert isinstance(LinenDense(14, method=LoRA(rank=2)), nn.Module)


@SPLIT
@CLASSES
def test_requires_values_and_a_valid_rank(name, cls):
    shape = jax.ShapeDtypeStruct((9, 14), jnp.float32)
    with pytest.raises(ValueError, match="values"):
        lora(name, cls).init(jax.random.key(0), shape)
    with pytest.raises(ValueError, match=r"a rank of at most min\(I, O\), got rank 10"):
        lora(name, cls, rank=10).init(jax.random.key(0), KERNEL)


def test_gaussian():
    params, kernel = LoRA(rank=20, initialization="gaussian").init(
        jax.random.key(0), jax.ShapeDtypeStruct((900, 50), jnp.float32)
    )
    assert np.std(params["lora_a"]) == pytest.approx(1 / 20, rel=0.02)
    assert not params["lora_b"].any()
    assert kernel.shape == (900, 50)
