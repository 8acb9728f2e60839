"""Pruning: unused directions are dropped without error, others with the reported error."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.adapters.io import native
from lorasp_jax.dense import AdapterParam, Dense
from lorasp_jax.peft import LoRA
from tests.adapters.compress.lora_sp_models import (
    IDS,
    RANK,
    TOKENS,
    VARIANTS,
    call,
    forward,
    lora_sp_model,
    perturbed,
)
from tests.adapters.test_adaptation import Net, trained
from tests.cases import mostly_slow

pytestmark = pytest.mark.slow


def deactivate(model, path, layer, directions):
    """Keep directions of one layer of a stack inactive, with very low logits."""
    (location,) = (p for p in paths.locate(nnx.List([model]), Dense) if p.path == path)
    params = location.child.adapter.get_value()
    b2 = params["router"]["b2"].at[layer, jnp.array(directions)].set(-30.0)
    w2 = params["router"]["w2"].at[layer, :, jnp.array(directions)].set(0.0)
    location.child.adapter = AdapterParam(
        params | {"router": params["router"] | {"b2": b2, "w2": w2}}
    )
    return model


@pytest.mark.parametrize("method", mostly_slow(VARIANTS, VARIANTS[:1]), ids=IDS)
def test_pruning_inactive_directions_preserves_outputs(method, batches):
    """Directions that are never active are dropped without changing outputs on these batches."""
    model = lora_sp_model(method)
    smaller, report = lorasp_jax.prune(model, batches, forward=forward)
    for x in batches:
        before, after = call(model, x), call(smaller, x)
        np.testing.assert_allclose(after, before, rtol=1e-4, atol=1e-4)
    assert report.output_error < 1e-5


@pytest.mark.slow
def test_a_stack_gets_the_largest_rank_that_a_layer_needs(batches):
    """Three layers need ranks 7, 9 and 8: all get rank 9 and keep the directions they use."""
    inactive = [[0, 1, 2, 5, 11], [3, 4, 10], [0, 6, 7, 8]]
    method = dataclasses.replace(VARIANTS[0], energy_target=0.99)
    model = lora_sp_model(method)
    for layer, directions in enumerate(inactive):
        model = deactivate(model, "blocks", layer, directions)
    smaller, report = lorasp_jax.prune(model, batches, 0.0, forward=forward)
    np.testing.assert_array_equal(report.ranks["blocks"], [7, 9, 8])
    params = smaller.blocks.adapter.get_value()
    assert params["bank"]["u"].shape == (3, 9, 4)
    assert params["bank"]["v"].shape == (3, 4, 9)
    assert params["router"]["w2"].shape == (3, 4, 12)
    assert smaller.blocks.method.rank == 9
    assert smaller.blocks.method.scale == method.scale
    assert report.output_error < 1e-6
    for x in batches:
        np.testing.assert_allclose(call(smaller, x), call(model, x), rtol=1e-5, atol=1e-5)


def active_fractions(model, batches):
    """Fraction of tokens by head and direction, from the aux of the heads."""
    fractions = []
    for i in range(2):
        usage = []
        for x in batches:
            model(x)
            usage.append(lorasp_jax.collect_aux(model)[f"heads/{i}"].usage)
        fractions.append(np.mean(usage, axis=0) / TOKENS)
    return np.array(fractions)


@pytest.mark.slow
def test_a_tolerance_drops_rarely_active_directions_and_reports_the_error(batches):
    model = lora_sp_model(VARIANTS[0])
    fractions = active_fractions(model, batches)
    smaller, report = lorasp_jax.prune(model, batches, 0.3, forward=forward)
    for i in range(2):
        assert (
            report.ranks[f"heads/{i}"] == (fractions[i] > 0.3).sum() == smaller.heads[i].method.rank
        )
    assert 0 < report.ranks["heads/0"] < RANK
    before = np.concatenate([call(model, x) for x in batches])
    after = np.concatenate([call(smaller, x) for x in batches])
    error = np.linalg.norm(after - before) / np.linalg.norm(before)
    assert report.output_error == pytest.approx(error, rel=1e-3)
    assert error > 1e-3
    again, second = lorasp_jax.prune(smaller, batches, 0.3, forward=forward)
    assert adaptation.methods(again) == adaptation.methods(smaller)  # nothing else is dropped
    assert second.output_error < 1e-6


@pytest.mark.slow
def test_padding_is_ignored():
    layer = Dense(5, 4, use_bias=False, method=VARIANTS[0], rngs=nnx.Rngs(0))
    model = perturbed(nnx.List([layer]))
    x = jax.random.normal(jax.random.key(3), (2, 20, 5))
    mask = jnp.arange(20)[None] < jnp.array([[7], [20]])

    def valid(model, x):
        y = model[0](x, token_mask=mask)
        return jnp.where(mask[..., None], y, 0)

    _, clean = lorasp_jax.prune(model, [x], 0.4, forward=valid)
    garbage = jnp.where(mask[..., None], x, 1e3)
    _, padded = lorasp_jax.prune(model, [garbage], 0.4, forward=valid)
    assert clean.output_error > 1e-3
    assert padded.output_error == pytest.approx(clean.output_error, rel=1e-4)
    np.testing.assert_array_equal(clean.ranks["0"], padded.ranks["0"])


@pytest.mark.slow
def test_a_pruned_model_trains_saves_and_loads(batches, tmp_path):
    model = lora_sp_model(VARIANTS[0])
    smaller, _ = lorasp_jax.prune(model, batches, 0.3, forward=forward)
    assert f"{smaller.heads[0].method.rank}" in lorasp_jax.summary(smaller)
    native.save_adapters(tmp_path, smaller)
    loaded = native.load_adapters(tmp_path, Net(nnx.Rngs(0)))
    np.testing.assert_array_equal(call(loaded, batches[0]), call(smaller, batches[0]))
    after = trained(loaded, batches[0])
    assert jnp.isfinite(call(after, batches[0])).all()
    assert (call(after, batches[0]) != call(loaded, batches[0])).any()
    assert adaptation.count(smaller).trainable < adaptation.count(model).trainable


def test_needs_lora_sp(batches):
    net = adaptation.adapt(Net(nnx.Rngs(0)), [("heads", LoRA(rank=2))], rngs=nnx.Rngs(1))
    with pytest.raises(ValueError, match="LoRA-SP"):
        lorasp_jax.prune(net, batches)


def test_a_rank_keeps_the_most_used_directions(batches):
    model = lora_sp_model(VARIANTS[0])
    fractions = active_fractions(model, batches)
    smaller, report = lorasp_jax.prune(model, batches, rank=RANK // 2, forward=forward)
    assert {method.rank for method in adaptation.methods(smaller).values()} == {RANK // 2}
    assert all((ranks == RANK // 2).all() for ranks in report.ranks.values())
    for i in range(2):
        kept = np.sort(np.argsort(-fractions[i], kind="stable")[: RANK // 2])
        u, rest = (m.heads[i].adapter.get_value()["bank"]["u"] for m in (model, smaller))
        np.testing.assert_array_equal(rest, u[kept])
    whole, report = lorasp_jax.prune(model, batches, rank=RANK + 1, forward=forward)
    assert {method.rank for method in adaptation.methods(whole).values()} == {RANK}
    assert report.output_error < 1e-5


def test_a_fraction_shrinks_banks_of_any_size(batches):
    large, small = VARIANTS[0], dataclasses.replace(VARIANTS[0], rank=4)
    rules = [("blocks", large), ("heads", small)]
    model = perturbed(adaptation.adapt(Net(nnx.Rngs(0)), rules, rngs=nnx.Rngs(1)), size=0.1)
    for rank, kept in ((0.5, (RANK // 2, 2)), (0.1, (1, 1))):
        smaller, _ = lorasp_jax.prune(model, batches, rank=rank, forward=forward)
        methods = adaptation.methods(smaller)
        for name, number in zip(("blocks", "heads"), kept, strict=True):
            assert {m.rank for path, m in methods.items() if path.startswith(name)} == {number}
    with pytest.raises(ValueError, match="rank"):
        lorasp_jax.prune(model, batches, rank=2.5, forward=forward)


@pytest.mark.parametrize(("rank", "kept"), [(1, 16), (16, 16), (17, 32), (33, 40)])
def test_kernels_get_16_32_64_directions(batches, rank, kept):
    model = lora_sp_model(dataclasses.replace(VARIANTS[0], rank=40))
    smaller, _ = lorasp_jax.prune(model, batches, rank=rank, for_kernel=True, forward=forward)
    assert {method.rank for method in adaptation.methods(smaller).values()} == {kept}


def test_kernels_get_all_directions_in_use(batches):
    model = lora_sp_model(dataclasses.replace(VARIANTS[0], rank=40))
    used, report = lorasp_jax.prune(model, batches, forward=forward)
    more, same = lorasp_jax.prune(model, batches, for_kernel=True, forward=forward)
    ranks = [{m.rank for m in adaptation.methods(x).values()} for x in (used, more)]
    assert max(ranks[0]) <= min(ranks[1])
    assert ranks[1] <= {16, 32, 40}
    jax.tree.map(np.testing.assert_array_equal, same.ranks, report.ranks)


@pytest.mark.parametrize(
    "options", [{"rank": 0}, {"rank": 2, "tolerance": 0.1}, {"tolerance": 1.0}]
)
def test_bad_options(batches, options):
    with pytest.raises(ValueError, match=r"tolerance .* rank"):
        lorasp_jax.prune(lora_sp_model(VARIANTS[0]), batches, **options)
