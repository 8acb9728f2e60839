"""Quantized bases: memory, errors, and every operation on adapted models."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.adapters.io.native import load_adapters, save_adapters
from lorasp_jax.dense import AdapterParam, Dense
from lorasp_jax.kernels.quantized_weights import KINDS, QuantizedKernel
from lorasp_jax.peft import FullFineTuning, LoRA
from tests.cases import mostly_slow
from tests.models.random_models import with_random_parameters
from tests.nets import METHODS, NET, SP, Net, X, assert_close, call, trained


@functools.cache
def quantized(kind):
    return lorasp_jax.quantize(NET, [("", kind)]).model


@jax.jit
def dequantized(model):
    """Copy of the model with dequantized kernels."""
    root = nnx.List([nnx.clone(model)])
    for location in paths.locate(root, Dense):
        kernel = location.child.kernel.get_value()
        if isinstance(kernel, QuantizedKernel):
            location.child.kernel = nnx.Param(kernel.astype(kernel.dtype))
    return root[0]


def size(model):
    return sum(leaf.nbytes for leaf in jax.tree.leaves(nnx.state(model, nnx.Param)))


@pytest.mark.parametrize(
    ("kind", "bits", "error"),
    [("float8", 8 + 32 / 2**17, 0.0265), ("int8", 8.125, 0.0051), ("nf4", 4.5, 0.092)],
)
def test_memory_and_error(kind, bits, error):
    """Check the parameter bytes, and the reported error against outputs for isotropic inputs."""
    wide = jax.jit(lambda: nnx.Linear(256, 512, rngs=nnx.Rngs(0)))()
    smaller, errors = lorasp_jax.quantize(wide, [("", kind)])
    assert size(smaller) == 256 * 512 * bits / 8 + 512 * 4
    assert errors[""] == pytest.approx(error, rel=0.1)
    x = np.random.default_rng(1).normal(size=(2048, 256)).astype("f")
    y = x @ np.asarray(wide.kernel.get_value())
    lost = np.linalg.norm(call(smaller, x) - y) / np.linalg.norm(y)
    assert float(lost) == pytest.approx(errors[""], rel=0.02)


@pytest.mark.parametrize("kind", KINDS)
def test_quantized_equals_dequantized(kind):
    model = quantized(kind)
    assert isinstance(model.blocks.kernel.get_value(), QuantizedKernel)
    assert_close(call(model, X), call(dequantized(model), X))
    assert np.abs(call(model, X) - call(NET, X)).max() > 1e-4  # quantization changed the kernels
    assert isinstance(NET.inp, nnx.Linear)
    graphdef, state = nnx.split(model)
    assert_close(jax.jit(lambda s: nnx.merge(graphdef, s)(X))(state), call(model, X))


@pytest.mark.parametrize("name", mostly_slow(METHODS, ["lora", "lora_sp"]))
def test_methods_on_a_quantized_base(name):
    """Adapters attached before or after quantization match those on dequantized kernels."""
    method = METHODS[name]
    if method.trains_base:
        with pytest.raises(ValueError, match="inp/kernel is quantized"):
            adaptation.adapt(quantized("nf4"), [("inp", method)], rngs=nnx.Rngs(0))
        with pytest.raises(ValueError, match=r"quantize inp: .* trainable"):
            lorasp_jax.quantize(trained(("inp", method), seed=0), [("", "nf4")])
        return
    model = trained(("inp|blocks", method), seed=1, net=quantized("nf4"))
    assert_close(call(model, X), call(dequantized(model), X))
    later, _ = lorasp_jax.quantize(trained(("inp|blocks", method), seed=1), [("", "nf4")])
    if method.additive:  # DoRA's initial magnitude depends on the kernel
        assert_close(call(later, X), call(model, X))
    count = adaptation.count(trained(("inp|blocks", method), seed=1))
    assert adaptation.count(model) == count


def test_adapters_on_a_quantized_base_are_saved(tmp_path):
    model = trained(("inp|blocks", SP), seed=1, net=quantized("int8"))
    save_adapters(tmp_path, model)
    assert_close(call(load_adapters(tmp_path, quantized("int8")), X), call(model, X))
    own, _ = lorasp_jax.quantize(load_adapters(tmp_path, NET), [("", "int8")])
    assert_close(call(own, X), call(model, X))


def test_adapters_that_split_kernels_come_first():
    pissa = LoRA(rank=2, initialization="pissa")
    with pytest.raises(ValueError, match="quantized kernel"):
        adaptation.adapt(quantized("int8"), [("inp", pissa)], rngs=nnx.Rngs(0))
    model, errors = lorasp_jax.quantize(trained(("inp", pissa), seed=1), [("inp", "nf4")])
    assert_close(call(model, X), call(dequantized(model), X))
    assert 0 < errors["inp"] < 0.12


def test_low_precision():
    half = lambda leaf: jax.device_put(np.asarray(leaf).astype(jnp.bfloat16))  # noqa: E731
    state = jax.tree.map(half, nnx.state(NET))
    net = nnx.merge(nnx.graphdef(NET), state)
    model, _ = lorasp_jax.quantize(net, [("", "int8")])
    assert model.inp.kernel.get_value().dtype == jnp.bfloat16
    y = call(model, np.asarray(X).astype(jnp.bfloat16))
    assert y.dtype == jnp.bfloat16
    np.testing.assert_allclose(np.asarray(y, "f"), call(NET, X), atol=0.1)
    merged = jax.eval_shape(lorasp_jax.merge, trained(("", LoRA(rank=2)), seed=0, net=model))
    assert merged.inp.kernel.get_value().dtype == jnp.bfloat16


def test_rules():
    model, errors = lorasp_jax.quantize(NET, [("inp", None), ("blocks", "int8"), ("", "nf4")])
    assert isinstance(model.inp, nnx.Linear)
    assert model.blocks.kernel.get_value().codes.dtype == jnp.int8
    assert set(errors) == {"blocks", "out"}
    assert errors["blocks"] < 0.01 < errors["out"]
    assert not jax.tree.leaves(nnx.state(model, AdapterParam))
    for rules, message in (
        ([("blcks", "nf4")], "'blcks' .* blocks"),
        ([("", "nf4"), ("out", "int8")], "rule 'out'"),
        ([("out", "fp4")], "'nf4' or None.* 'fp4'"),
        ([("(", "nf4")], r"'\(' is not"),
    ):
        with pytest.raises(ValueError, match=message):
            lorasp_jax.quantize(NET, rules)
    with pytest.raises(ValueError, match="already quantized"):
        lorasp_jax.quantize(model, [("out", "nf4")])
    broken = with_random_parameters(Net)
    broken.out.kernel.set_value(np.full((4, 2), np.inf, "f"))
    with pytest.raises(ValueError, match=r"quantize out: .* NaN"):
        lorasp_jax.quantize(broken, [("", "nf4")])
    with pytest.raises(ValueError, match="out/kernel is quantized"):
        adaptation.adapt(model, [("out", FullFineTuning())], rngs=nnx.Rngs(0))


def test_summary_and_aux():
    """A summary counts weights, not bytes; adapters still report aux."""
    model = trained(("", LoRA(rank=2)), seed=1, net=quantized("nf4"))
    assert "inp" in lorasp_jax.summary(model)
    assert lorasp_jax.summary(model) == lorasp_jax.summary(dequantized(model))
    named = jax.jit(lambda model: lorasp_jax.choose(lorasp_jax.combine({"a": model}), None))(model)

    @jax.jit
    def aux_of(named):
        named(X)
        return lorasp_jax.collect_aux(named)

    assert not np.any(aux_of(named)["inp"].active_rank)
    assert "adapter_set" in lorasp_jax.summary(named)
