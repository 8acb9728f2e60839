"""Quantised kernels of general, einsum, expert and scanned layers: no matrices at first."""

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
def quantised(request):
    return lorasp_jax.quantize(NET, [(".*", request.param)])


def widened(model):
    """A copy of NET with the kernels that the codes stand for, put into shape by hand."""
    wide = nnx.clone(NET)
    for path in MATRICES:
        kernel = np.asarray(getattr(model, path).kernel.get_value().astype(jnp.float32))
        if path == "blocks":  # "...d,fd->...f" in a stack
            kernel = kernel.swapaxes(-1, -2)
        old = getattr(NET, path).kernel[...]
        getattr(wide, path).kernel = nnx.Param(jnp.asarray(kernel.reshape(old.shape)))
    return wide


def with_adapters(net, model):
    """NET's copy with the adapters of another model."""
    graphdef, _, frozen = adaptation.split(adaptation.adapt(net, [LORA], rngs=nnx.Rngs(0)))
    return nnx.merge(graphdef, adaptation.split(model)[1], frozen)


def test_codes_lie_in_matrices_and_answer_for_the_kernel(quantised):
    model, errors = quantised
    assert errors.keys() == MATRICES.keys()
    for path, shape in MATRICES.items():
        kernel = getattr(model, path).kernel.get_value()
        assert isinstance(kernel, QuantizedKernel)
        assert getattr(model, path).kernel_matrices().shape == shape
        old = getattr(NET, path).kernel[...]
        assert kernel.shape == old.shape  # a model may read sizes off its kernels
        wide = getattr(widened(model), path).kernel[...]
        off = np.linalg.norm(wide - old) / np.linalg.norm(old)
        assert 0 < errors[path] < 0.2
        np.testing.assert_allclose(off, errors[path], rtol=1e-4)
    assert_close(call(model, IDS), call(widened(model), IDS))
    with pytest.raises(ValueError, match="no adapted layer stored any aux"):
        lorasp_jax.collect_aux(model)


def test_adapters_before_and_after(quantised):
    kind = "int8" if quantised.errors["out"] < 0.02 else "nf4"
    model = trained(LORA, seed=1, net=quantised.model)
    expected = with_adapters(widened(quantised.model), model)
    assert_close(call(model, IDS), call(expected, IDS))
    later, _ = lorasp_jax.quantize(trained(LORA, seed=1, net=NET), [(".*", kind)])
    assert_close(call(later, IDS), call(expected, IDS))

    def gradients(model):
        graphdef, adapters, frozen = adaptation.split(model)

        def loss(adapters):  # nnx.scan wants variables of this very trace
            model = nnx.clone(nnx.merge(graphdef, adapters, frozen))
            return jnp.square(model(IDS)).sum()

        return jax.tree.leaves(jax.jit(jax.grad(loss))(adapters))

    for found, wanted in zip(gradients(model), gradients(expected), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-3)


def test_merging_makes_whole_kernels_and_leaves_the_others(quantised):
    model = trained(("split|blocks|out", LoRA(rank=2)), seed=1, net=quantised.model)
    merged = lorasp_jax.merge(model)
    assert type(merged.split) is nnx.LinearGeneral
    assert merged.split.kernel.shape == (6, 2, 3)
    assert merged.blocks.kernel.shape == (3, 6, 6)
    assert isinstance(merged.experts.kernel.get_value(), QuantizedKernel)
    assert_close(call(merged, IDS), call(model, IDS))


@pytest.mark.slow
def test_saved_adapters_and_names_over_codes(quantised, tmp_path):
    model = trained(
        ("split|experts|blocks", LoRASP(rank=4, hidden_width=2)), seed=1, net=quantised.model
    )
    save_adapters(tmp_path, model)
    loaded = load_adapters(tmp_path, quantised.model)
    np.testing.assert_array_equal(call(loaded, IDS), call(model, IDS))
    other = trained(LORA, seed=2, net=quantised.model)
    both = lorasp_jax.combine({"a": model, "b": other})
    for name, expected in {"a": model, "b": other, None: quantised.model}.items():
        assert_close(call(lorasp_jax.choose(both, name), IDS), call(expected, IDS))
    alone = lorasp_jax.extract(both, "b")
    assert_close(call(lorasp_jax.merge(alone), IDS), call(other, IDS))


class Tied(nnx.Module):
    """One kernel read in three ways."""

    def __init__(self):
        self.there = nnx.Einsum("...i,io->...o", (6, 4), rngs=nnx.Rngs(0))
        self.back = nnx.Einsum("...o,io->...i", (6, 4), rngs=nnx.Rngs(0))
        self.again = nnx.Einsum("...i,io->...o", (6, 4), rngs=nnx.Rngs(0))
        self.back.kernel = self.again.kernel = self.there.kernel

    def __call__(self, x):
        return self.again(self.back(self.there(x)))


def test_a_shared_kernel_has_codes_for_each_way_to_read_it():
    net = Tied()
    model, errors = lorasp_jax.quantize(net, [(".*", "int8")])
    assert model.there.kernel is model.again.kernel
    assert model.back.kernel_matrices().shape == (4, 6)
    x = jax.random.normal(jax.random.key(0), (5, 6))
    lost = np.linalg.norm(model(x) - net(x)) / np.linalg.norm(net(x))
    assert 0 < lost < 2 * sum(errors.values())


def test_lookups_and_convolutions_stay():
    with pytest.raises(
        ValueError, match=r"rule 'embed' governs nothing; dense layers and einsums here"
    ):
        lorasp_jax.quantize(NET, [("embed", "nf4")])
