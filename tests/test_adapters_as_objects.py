"""Test removing, merging, saving and combining adapters, for every method in `peft/`.

Removing an adapter restores the base's outputs, merging preserves outputs, unmerging restores the
kernels, and saved, combined and extracted adapters round-trip. Methods that do not allow an
operation raise an error.
"""

import jax
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.combine.named import strip_adapters
from lorasp_jax.adapters.io.native import load_adapters, save_adapters
from lorasp_jax.peft import LoRA, LoRAMoE, LoRASP, LoRASPRelease
from tests import nets
from tests.cases import mostly_slow
from tests.nets import NET, X, assert_close, call, trained

pytestmark = pytest.mark.slow

INITIALIZATIONS = ["gaussian", "pissa", "olora"]
METHODS = nets.METHODS | {name: LoRA(rank=2, initialization=name) for name in INITIALIZATIONS}
LAYERS = "inp|blocks"


@pytest.fixture(params=mostly_slow(METHODS, ["lora", "lora_sp", "dora"]))
def method(request):
    return METHODS[request.param]


@pytest.fixture
def model(method):
    return trained((LAYERS, method), seed=3)


def parameters(model):
    return jax.tree.leaves(nnx.to_pure_dict(nnx.state(model, nnx.Param)))


def test_removing_the_adapter_restores_the_base(method, model):
    """Outputs are bitwise equal without the adapter, and close if its weight is zero."""
    if method.trains_base:
        with pytest.raises(ValueError, match=r"own .* (blocks|inp)/(bias|kernel)"):
            lorasp_jax.combine({"own": model})
        return
    if method.splits_kernel:
        for operation in (strip_adapters, lambda model: lorasp_jax.combine({"own": model})):
            with pytest.raises(ValueError, match="split"):
                operation(model)
        return
    assert np.abs(call(model, X) - call(NET, X)).max() > 1e-3
    pair = lorasp_jax.combine({"other": trained(("out", LoRA(rank=2)), seed=1), "own": model})
    for base in (strip_adapters(model), lorasp_jax.extract(pair, None)):
        np.testing.assert_array_equal(call(base, X), call(NET, X))
        for ours, theirs in zip(parameters(base), parameters(NET), strict=True):
            np.testing.assert_array_equal(ours, theirs)
    assert_close(call(lorasp_jax.choose(pair, None), X), call(NET, X))
    assert_close(call(lorasp_jax.choose(pair, "own"), X), call(model, X))


def test_merging_preserves_outputs_and_unmerging_restores_kernels(method, model):
    if isinstance(method, LoRASP | LoRASPRelease | LoRAMoE):
        advice = "keep the adapter" if isinstance(method, LoRAMoE) else "distill it into"
        with pytest.raises(ValueError, match=rf"cannot merge (inp|blocks): .*{advice}"):
            lorasp_jax.merge(model)
        return
    merged = lorasp_jax.merge(model)
    assert not adaptation.methods(merged)
    assert_close(call(merged, X), call(model, X))
    assert_close(call(lorasp_jax.merge(merged), X), call(model, X))  # merging twice is harmless
    if not method.additive:
        with pytest.raises(ValueError, match=r"unmerge|also trains"):
            lorasp_jax.unmerge(merged, model)
        return
    back = lorasp_jax.unmerge(merged, model)
    for ours, theirs in zip(parameters(back), parameters(model), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)
    assert_close(call(back, X), call(model, X))


def test_saved_adapters_round_trip(tmp_path, method, model):
    """Save the adapter alone, and after extracting it from a combined model if possible."""
    save_adapters(tmp_path / "alone", model)
    loaded = load_adapters(tmp_path / "alone", NET)
    np.testing.assert_array_equal(call(loaded, X), call(model, X))
    if method.trains_base or method.splits_kernel:
        return
    pair = lorasp_jax.combine({"other": trained(("", LoRA(rank=5)), seed=1), "own": loaded})
    save_adapters(tmp_path / "out", lorasp_jax.extract(pair, "own"))
    again = load_adapters(tmp_path / "out", NET)
    for ours, theirs in zip(parameters(again), parameters(model), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    with pytest.raises(ValueError, match="combined model"):
        save_adapters(tmp_path / "none", pair)


def test_mapped_choices(method, model):
    """vmap over choices gives the values and gradients of x of separate calls."""
    if method.trains_base or method.splits_kernel:
        return
    pair = lorasp_jax.combine({"other": trained(("", LoRA(rank=2)), seed=1), "own": model})
    rows = np.array([[0.0, 1.0], [1.0, 0.0], [0.3, -0.5]], np.float32)

    def loss(x, weights):
        return (lorasp_jax.choose(pair, weights)(x) ** 2).sum()

    both = jax.value_and_grad(loss)
    mapped = jax.jit(jax.vmap(both, (None, 0)))(X, rows)
    single = jax.jit(both)
    for i, row in enumerate(rows):
        for ours, theirs in zip(mapped, single(X, row), strict=True):
            np.testing.assert_allclose(ours[i], theirs, rtol=1e-3, atol=1e-3)
