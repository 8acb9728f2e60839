"""Test quantization of general, einsum, expert and scanned layers, whose kernels have more axes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io.native import load_adapters, save_adapters
from lorasp_jax.kernels.quantized_weights import KINDS, QuantizedKernel
from lorasp_jax.peft import LoRA, LoRASP
from tests.cases import mostly_slow
from tests.models.random_models import with_random_parameters
from tests.nets import Kinds, assert_close, call, trained

NET = with_random_parameters(Kinds)
IDS = jax.random.randint(jax.random.key(0), (4, 5), 0, 7)
LORA = (".*", LoRA(rank=2))
MATRICES = {
    "split": (6, 6),
    "experts": (2, 3, 3),
    "join": (6, 6),
    "blocks": (3, 6, 6),
    "out": (6, 4),
}


@pytest.fixture(scope="module", params=mostly_slow(KINDS, ["int8"]))
def quantized(request):
    return lorasp_jax.quantize(NET, [(".*", request.param)])


def dequantized(model):
    """Return a copy of NET with the dequantized kernels in their original shapes."""
    dequantized_copy = nnx.clone(NET)
    for path in MATRICES:
        kernel = np.asarray(getattr(model, path).kernel.get_value().astype(jnp.float32))
        if path == "blocks":  # "...d,fd->...f" in a stack
            kernel = kernel.swapaxes(-1, -2)
        old = getattr(NET, path).kernel[...]
        getattr(dequantized_copy, path).kernel = nnx.Param(jnp.asarray(kernel.reshape(old.shape)))
    return dequantized_copy


def with_adapters(net, model):
    """Return a copy of the network with the adapters of another model."""
    graphdef, _, frozen = adaptation.split(adaptation.adapt(net, [LORA], rngs=nnx.Rngs(0)))
    return nnx.merge(graphdef, adaptation.split(model)[1], frozen)


def test_quantized_matrices_represent_the_kernel(quantized):
    model, errors = quantized
    assert errors.keys() == MATRICES.keys()
    for path, shape in MATRICES.items():
        kernel = getattr(model, path).kernel.get_value()
        assert isinstance(kernel, QuantizedKernel)
        assert getattr(model, path).kernel_matrices().shape == shape
        old = getattr(NET, path).kernel[...]
        assert kernel.shape == old.shape  # models may read sizes from their kernels
        restored = getattr(dequantized(model), path).kernel[...]
        error = np.linalg.norm(restored - old) / np.linalg.norm(old)
        assert 0 < errors[path] < 0.2
        np.testing.assert_allclose(error, errors[path], rtol=1e-4)
    assert_close(call(model, IDS), call(dequantized(model), IDS))
    with pytest.raises(ValueError, match="no adapted layer stored any aux"):
        lorasp_jax.collect_aux(model)


def test_adapting_before_and_after_quantization(quantized):
    kind = quantized.model.out.kernel.get_value().kind
    model = trained(LORA, seed=1, net=quantized.model)
    expected = with_adapters(dequantized(quantized.model), model)
    assert_close(call(model, IDS), call(expected, IDS))
    later, _ = lorasp_jax.quantize(trained(LORA, seed=1, net=NET), [(".*", kind)])
    assert_close(call(later, IDS), call(expected, IDS))

    def gradients(model):
        graphdef, adapters, frozen = adaptation.split(model)

        def loss(adapters):  # nnx.scan needs variables created in this trace
            model = nnx.clone(nnx.merge(graphdef, adapters, frozen))
            return jnp.square(model(IDS)).sum()

        return jax.tree.leaves(jax.jit(jax.grad(loss))(adapters))

    for actual, desired in zip(gradients(model), gradients(expected), strict=True):
        np.testing.assert_allclose(actual, desired, rtol=1e-3, atol=1e-3)


def test_merging_dequantizes_only_merged_kernels(quantized):
    model = trained(("split|blocks|out", LoRA(rank=2)), seed=1, net=quantized.model)
    merged = lorasp_jax.merge(model)
    assert type(merged.split) is nnx.LinearGeneral
    assert merged.split.kernel.shape == (6, 2, 3)
    assert merged.blocks.kernel.shape == (3, 6, 6)
    assert isinstance(merged.experts.kernel.get_value(), QuantizedKernel)
    assert_close(call(merged, IDS), call(model, IDS))


@pytest.mark.slow
def test_saved_and_named_adapters_on_quantized_kernels(quantized, tmp_path):
    model = trained(
        ("split|experts|blocks", LoRASP(rank=4, hidden_width=2)), seed=1, net=quantized.model
    )
    save_adapters(tmp_path, model)
    loaded = load_adapters(tmp_path, quantized.model)
    np.testing.assert_array_equal(call(loaded, IDS), call(model, IDS))
    other = trained(LORA, seed=2, net=quantized.model)
    both = lorasp_jax.combine({"a": model, "b": other})
    for name, expected in {"a": model, "b": other, None: quantized.model}.items():
        assert_close(call(lorasp_jax.choose(both, name), IDS), call(expected, IDS))
    alone = lorasp_jax.extract(both, "b")
    assert_close(call(lorasp_jax.merge(alone), IDS), call(other, IDS))


class Tied(nnx.Module):
    """One kernel used by three layers in different ways."""

    def __init__(self):
        self.first = nnx.Einsum("...i,io->...o", (6, 4), rngs=nnx.Rngs(0))
        self.transposed = nnx.Einsum("...o,io->...i", (6, 4), rngs=nnx.Rngs(0))
        self.second = nnx.Einsum("...i,io->...o", (6, 4), rngs=nnx.Rngs(0))
        self.transposed.kernel = self.second.kernel = self.first.kernel

    def __call__(self, x):
        return self.second(self.transposed(self.first(x)))


def test_shared_kernel_is_quantized_once_per_layout():
    net = Tied()
    model, errors = lorasp_jax.quantize(net, [(".*", "int8")])
    assert model.first.kernel is model.second.kernel
    assert model.transposed.kernel_matrices().shape == (4, 6)
    x = jax.random.normal(jax.random.key(0), (5, 6))
    error = np.linalg.norm(model(x) - net(x)) / np.linalg.norm(net(x))
    assert 0 < error < 2 * sum(errors.values())


def test_embeddings_and_convolutions_are_not_quantized():
    with pytest.raises(ValueError, match="rule 'embed'"):
        lorasp_jax.quantize(NET, [("embed", "nf4")])
