"""Compare fused LoRAs with the weighted sum, and unmerged kernels with the original ones."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.combine.fusion import truncated
from lorasp_jax.adapters.io.native import load_adapters, save_adapters
from lorasp_jax.peft import AdaLoRA, DoRA, FullFineTuning, LoRA, LoRAMoE
from tests.cases import mostly_slow
from tests.nets import NET, SP, X, assert_close, call, golden_models, trained

WEIGHTS = {"pour": 0.5, "press": -0.7}


@functools.cache
def pair():
    models = {
        "pour": trained(("inp", LoRA(rank=2, alpha=3)), ("blocks", LoRA(rank=3)), seed=1),
        "press": trained(("", LoRA(rank=4, alpha=5, rank_stabilized=True)), seed=2),
        "sp": trained(("inp", SP), seed=3),
    }
    return jax.jit(lambda: lorasp_jax.combine(models))()


@functools.cache
def exact():
    return lorasp_jax.fuse(pair(), WEIGHTS)


merge, unmerge = jax.jit(lorasp_jax.merge), jax.jit(lorasp_jax.unmerge)


def test_full_rank_fusion_is_exact():
    fused, errors = exact()
    assert_close(call(fused, X), call(lorasp_jax.choose(pair(), WEIGHTS), X))
    assert {path: method.rank for path, method in adaptation.methods(fused).items()} == {
        "inp": 6, "blocks": 7, "out": 4,
    }  # fmt: skip
    assert errors == {"inp": 0.0, "blocks": 0.0, "out": 0.0}
    assert_close(call(merge(fused), X), call(fused, X))


def deltas(fused, path):
    """Deltas of a layer's kernel matrices, [..., I, O]."""
    layers = (getattr(model, path) for model in (merge(fused), NET))
    kernel, base = (np.asarray(layer.kernel.get_value()) for layer in layers)
    delta = kernel - base
    return delta.reshape(-1, *delta.shape[-2:])


@pytest.mark.parametrize("rank", mostly_slow([1, 2, 3], [2]))
def test_truncation_is_the_best_low_rank_approximation(rank):
    """Compare with the SVD of the full delta, for each layer of the stack."""
    fused, errors = lorasp_jax.fuse(pair(), WEIGHTS, rank=rank)
    for path in ("inp", "blocks"):
        full, ours = deltas(exact().model, path), deltas(fused, path)
        left, values, right = np.linalg.svd(full, full_matrices=False)
        best = left[..., :rank] * values[..., None, :rank] @ right[..., :rank, :]
        np.testing.assert_allclose(ours, best, atol=1e-4 * np.abs(best).max())
        lost = np.linalg.norm(full - best) / np.linalg.norm(full)
        assert errors[path] == pytest.approx(lost, rel=1e-3, abs=1e-5)
        assert getattr(fused, path).method == LoRA(rank=rank, alpha=rank)


@pytest.mark.slow
def test_hugging_face():
    """PEFT 0.21.2's add_weighted_adapter, "cat" and "svd": deltas and outputs to 1e-5."""
    golden, models = golden_models()
    model = lorasp_jax.combine({name: models[name] for name in "ac"})
    for case, rank in (("cat", None), ("svd", 5)):
        fused, _ = lorasp_jax.fuse(model, {"a": 0.7, "c": 0.3}, rank=rank)
        merged = lorasp_jax.merge(fused)
        for i, layer in enumerate(merged.lin):
            delta = layer.kernel.get_value() - golden[f"base/lin.{i}.weight"].T
            expected = golden[f"delta/{case}/{i}"].T
            np.testing.assert_allclose(delta, expected, rtol=0, atol=1e-5 * np.abs(expected).max())
        expected = golden[f"y/{case}"]
        y = fused(golden["x"])
        np.testing.assert_allclose(y, expected, rtol=0, atol=1e-5 * np.abs(expected).max())


def test_zero_deltas():
    a, b, error = truncated(jnp.ones((3, 4, 7)), jnp.zeros((3, 7, 4)), 2)
    assert error == 0.0
    np.testing.assert_array_equal(np.asarray(a) @ np.asarray(b), 0)


def test_fuse_errors():
    with pytest.raises(ValueError, match="sp at inp"):
        lorasp_jax.fuse(pair(), {"pour": 1.0, "sp": 0.5})
    with pytest.raises(ValueError, match=r"'pure'.* pour"):
        lorasp_jax.fuse(pair(), {"pure": 1.0})
    with pytest.raises(ValueError, match="rank"):
        lorasp_jax.fuse(pair(), WEIGHTS, rank=0)


SPLITS = [LoRA(rank=2, initialization=name) for name in ("pissa", "olora")]
UNMERGED = list(
    itertools.product([LoRA(rank=2), AdaLoRA(rank=2), *SPLITS], [jnp.float32, jnp.bfloat16])
)


@pytest.mark.parametrize("case", mostly_slow(UNMERGED, [*UNMERGED[:3], UNMERGED[4]]), ids=str)
def test_unmerge(case):
    """The base kernels are restored up to the documented rounding, with the same adapters."""
    (method, dtype), (graphdef, state) = case, nnx.split(NET)
    half = lambda leaf: jax.device_put(np.asarray(leaf).astype(dtype))  # noqa: E731
    net = nnx.merge(graphdef, jax.tree.map(half, state))
    model = trained(("inp|blocks", method), seed=4, net=net)
    merged = merge(model)
    back = unmerge(merged, model)
    for layer in ("inp", "blocks", "out"):
        kernels = [getattr(m, layer).kernel.get_value() for m in (back, model, merged)]
        assert {kernel.dtype for kernel in kernels} == {jnp.dtype(dtype)}
        ours, base, folded = (np.asarray(kernel, np.float64) for kernel in kernels)
        bound = 0.51 * float(jnp.finfo(dtype).eps) * (np.abs(folded) + np.abs(base)) + 1e-7
        assert (np.abs(ours - base) <= bound).all()
    assert adaptation.methods(back) == adaptation.methods(model)
    if dtype == jnp.float32:
        assert_close(call(back, X), call(model, X))
        assert_close(call(merge(back), X), call(merged, X))
    assert not adaptation.methods(merged)


def test_unmerge_with_a_saved_adapter(tmp_path):
    model = trained(("", LoRA(rank=2)), seed=4)
    save_adapters(tmp_path, model)
    merged = merge(model)
    back = unmerge(merged, load_adapters(tmp_path, merged, any_base=True))
    assert_close(call(back, X), call(model, X))
    assert_close(back.blocks.kernel.get_value(), NET.blocks.kernel.get_value())


def test_unmerge_errors():
    model = trained(("blocks", LoRA(rank=2)), seed=4)
    merged = merge(model)
    for method in (DoRA(rank=2), SP, LoRAMoE(experts=2, rank=2)):
        with pytest.raises(ValueError, match="cannot unmerge blocks"):
            lorasp_jax.unmerge(merged, trained(("blocks", method), seed=4))
    full = trained(("bias", FullFineTuning()), ("blocks", LoRA(rank=2)), seed=4)
    with pytest.raises(ValueError, match="the adapted model also trains"):
        lorasp_jax.unmerge(merge(full), full)
    with pytest.raises(ValueError, match="blocks has one"):
        lorasp_jax.unmerge(model, model)
    with pytest.raises(ValueError, match="layer blocks"):
        lorasp_jax.unmerge(merged.inp, model)
    other = trained(("", LoRA(rank=2)), seed=0, net=merged.inp)
    with pytest.raises(ValueError, match="cannot unmerge the model"):
        lorasp_jax.unmerge(merged.out, other)
