"""Pruning and distilling: what is exact, what an error is, that life goes on afterwards."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.adapters.compress import compaction
from lorasp_jax.adapters.io import native
from lorasp_jax.dense import AdapterParam, Dense
from lorasp_jax.peft import EnergySchedule, LoRA, LoRASP, LoRASPRelease
from tests.adapters.test_adaptation import Net, trained
from tests.cases import mostly_slow

pytestmark = pytest.mark.slow

RANK = 12
TOKENS = 40
VARIANTS = [
    LoRASP(rank=RANK, hidden_width=4, energy_target=0.6),
    LoRASP(RANK, 0.6, hidden_width=4, granularity="sample", schedule=EnergySchedule(0.7)),
    LoRASP(rank=4, hidden_width=2, energy_target=0.6, router="softmax"),
    LoRASP(rank=4, hidden_width=4, energy_target=0.6, normalized_bank=True),
    LoRASPRelease(rank=RANK, energy_target=0.5),
]
IDS = ["default", "sample", "softmax", "normalized", "release"]


def noisy(model, seed=0, size=1.0):
    """All adapters moved off their start, scores unlike each other; `size` is of their deltas."""
    for i, location in enumerate(paths.locate(nnx.List([model]), Dense)):
        if location.child.adapter is not None:
            params = location.child.adapter.get_value()
            leaves, structure = jax.tree.flatten(params)
            keys = jax.random.split(jax.random.key(seed + i), len(leaves))
            pairs = zip(keys, leaves, strict=True)
            moved = [p if p.ndim < 1 else p + jax.random.normal(k, p.shape) for k, p in pairs]
            params = jax.tree.unflatten(structure, moved)
            params["bank"]["u"] *= size
            if "gain" in params["bank"]:
                params["bank"]["gain"] += 0.3
            location.child.adapter = AdapterParam(params)
    return model


def model_of(method, seed=0):
    """Of deltas about as large as what they are added to: with far larger ones three blocks and
    heads make a thousand times as much of the rounding of the first."""
    net = Net(nnx.Rngs(0))
    model = adaptation.adapt(net, [("blocks|heads", method)], rngs=nnx.Rngs(1))
    return noisy(model, seed, size=0.1)


@pytest.fixture(scope="module")
def batches():
    return [jax.random.normal(jax.random.key(i), (TOKENS, 5)) for i in range(2)]


def forward(model, batch):
    y, aux = model(batch)
    return y, aux  # the stack's; the heads keep theirs


@jax.jit
def call(model, x):
    return model(x)[0]


def banish(model, path, layer, directions):
    """Some directions of one layer of a stack can no longer be kept: their logits are far down."""
    (location,) = (p for p in paths.locate(nnx.List([model]), Dense) if p.path == path)
    params = location.child.adapter.get_value()
    b2 = params["router"]["b2"].at[layer, jnp.array(directions)].set(-30.0)
    w2 = params["router"]["w2"].at[layer, :, jnp.array(directions)].set(0.0)
    location.child.adapter = AdapterParam(
        params | {"router": params["router"] | {"b2": b2, "w2": w2}}
    )
    return model


@pytest.mark.parametrize("method", mostly_slow(VARIANTS, VARIANTS[:1]), ids=IDS)
def test_never_active_directions_leave_outputs_as_they_are(method, batches):
    """What the calibration set never uses goes; on it every number is the same to rounding."""
    model = model_of(method)
    smaller, report = lorasp_jax.prune(model, batches, forward=forward)
    for x in batches:
        before, after = call(model, x), call(smaller, x)
        np.testing.assert_allclose(after, before, rtol=1e-4, atol=1e-4)
    assert report.output_error < 1e-5
    assert all((error < 1e-5).all() for error in report.layer_errors.values())


@pytest.mark.slow
def test_arrays_shrink_to_the_largest_need_of_a_stack(batches):
    """Ranks 7, 9 and 8 in three layers: one rank of 9, and a layer keeps what it uses."""
    model = model_of(dataclasses.replace(VARIANTS[0], energy_target=1.0))
    gone = [[0, 1, 2, 5, 11], [3, 4, 10], [0, 6, 7, 8]]
    for layer, directions in enumerate(gone):
        model = banish(model, "blocks", layer, directions)
    smaller, report = compaction.prune(model, batches, 0.0, forward=forward)
    # η = 1 keeps every positive score, and softplus(-30) is one: nothing may go.
    np.testing.assert_array_equal(report.ranks["blocks"], 12)

    method = dataclasses.replace(VARIANTS[0], energy_target=0.99)
    model = model_of(method)
    for layer, directions in enumerate(gone):
        model = banish(model, "blocks", layer, directions)
    smaller, report = compaction.prune(model, batches, 0.0, forward=forward)
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


def counted(model, batches):
    """Share of tokens by head and direction, from the heads run by themselves."""
    share = []
    for i in range(2):
        kept = []
        for x in batches:
            model(x)
            kept.append(lorasp_jax.collect_aux(model)[f"heads/{i}"].usage)
        share.append(np.mean(kept, axis=0) / TOKENS)
    return np.array(share)


@pytest.mark.slow
def test_a_tolerance_drops_what_is_hardly_active_and_says_what_it_costs(batches):
    model = model_of(VARIANTS[0])
    share = counted(model, batches)
    smaller, report = compaction.prune(model, batches, 0.3, forward=forward)
    for i in range(2):
        assert report.ranks[f"heads/{i}"] == (share[i] > 0.3).sum() == smaller.heads[i].method.rank
    assert 0 < report.ranks["heads/0"] < RANK
    before = np.concatenate([call(model, x) for x in batches])
    after = np.concatenate([call(smaller, x) for x in batches])
    error = np.linalg.norm(after - before) / np.linalg.norm(before)
    assert report.output_error == pytest.approx(error, rel=1e-3)
    assert error > 1e-3
    again, second = compaction.prune(smaller, batches, 0.3, forward=forward)
    assert adaptation.methods(again) == adaptation.methods(smaller)  # nothing more to drop
    assert second.output_error < 1e-6


@pytest.mark.slow
def test_the_error_of_a_layer_is_on_the_inputs_it_had():
    """One layer alone: its error is the model's, counted over valid tokens only."""
    layer = Dense(5, 4, use_bias=False, method=VARIANTS[0], rngs=nnx.Rngs(0))
    model = noisy(nnx.List([layer]))
    x = jax.random.normal(jax.random.key(3), (2, 20, 5))
    mask = jnp.arange(20)[None] < jnp.array([[7], [20]])

    def valid(model, x):
        y = model[0](x, token_mask=mask)
        return jnp.where(mask[..., None], y, 0)

    _, clean = compaction.prune(model, [x], 0.4, forward=valid)
    garbage = jnp.where(mask[..., None], x, 1e3)
    _, padded = compaction.prune(model, [garbage], 0.4, forward=valid)
    assert clean.layer_errors["0"] == pytest.approx(clean.output_error, rel=1e-5)
    assert clean.output_error > 1e-3
    assert padded.output_error == pytest.approx(clean.output_error, rel=1e-4)
    np.testing.assert_array_equal(clean.ranks["0"], padded.ranks["0"])


@pytest.mark.slow
def test_a_pruned_model_trains_saves_and_loads(batches, tmp_path):
    model = model_of(VARIANTS[0])
    smaller, _ = compaction.prune(model, batches, 0.3, forward=forward)
    assert f"{smaller.heads[0].method.rank}" in lorasp_jax.summary(smaller)
    native.save_adapters(tmp_path, smaller)
    loaded = native.load_adapters(tmp_path, Net(nnx.Rngs(0)))
    np.testing.assert_array_equal(call(loaded, batches[0]), call(smaller, batches[0]))
    after = trained(loaded, batches[0])
    assert jnp.isfinite(call(after, batches[0])).all()
    assert (call(after, batches[0]) != call(loaded, batches[0])).any()
    assert adaptation.count(smaller).trainable < adaptation.count(model).trainable


@pytest.mark.parametrize("rank", mostly_slow([None, 2], [None]))
def test_distill_is_the_best_update_of_its_rank(rank, batches):
    """Its error is the least squares' residual; a LoRA near it, or the mean update, is worse."""
    layer = Dense(5, 4, use_bias=False, method=VARIANTS[0], rngs=nnx.Rngs(0))
    model = noisy(nnx.List([layer]))
    one = lambda model, x: model[0](x)  # noqa: E731
    lora, report = lorasp_jax.distill(model, batches, rank, forward=one)
    x = np.concatenate(batches).astype(np.float64)
    y = np.float64(np.concatenate([one(model, b) for b in batches]))
    kernel = np.float64(layer.kernel.get_value())
    best = np.linalg.lstsq(x, y - x @ kernel, rcond=None)[0]
    if rank is not None:
        root = np.linalg.svd(x @ best, full_matrices=False)[2][:rank].T
        best = best @ root @ root.T

    def error(update):
        return np.linalg.norm(x @ (kernel + update) - y) / np.linalg.norm(y)

    found = lora[0].adapter.get_value()
    update = np.float64(found["lora_a"] @ found["lora_b"])
    assert isinstance(lora[0].method, LoRA)
    assert report.layer_errors["0"] == pytest.approx(error(best), rel=1e-4)
    assert report.output_error == pytest.approx(error(update), rel=1e-4)
    assert 0.01 < error(update) < 0.9
    mean = np.mean([_update_at(layer, token) for token in jnp.asarray(x[:80], jnp.float32)], axis=0)
    assert error(mean) > 1.01 * error(update)
    merged = adaptation.merge(lora)
    np.testing.assert_allclose(one(merged, batches[0]), one(lora, batches[0]), atol=1e-4)


def _update_at(layer, token):
    """ΔW(x) of one token, as a matrix."""
    params, method = layer.adapter.get_value(), layer.method
    z, _ = method.bottleneck(params, token @ method.down(params), None)
    u = method.up(params)
    s = z / (token @ params["bank"]["v"])
    return np.float64(params["bank"]["v"] * s @ u)


def test_distill_stacks_and_merges(batches):
    model = model_of(VARIANTS[0])
    lora, report = lorasp_jax.distill(model, batches, forward=forward)
    assert lora.blocks.adapter.get_value()["lora_a"].shape == (3, 4, 4)
    assert report.layer_errors["blocks"].shape == (3,)
    merged = lorasp_jax.merge(lora)
    np.testing.assert_allclose(call(merged, batches[0]), call(lora, batches[0]), atol=1e-4)
    x = np.concatenate([call(model, x) for x in batches])
    y = np.concatenate([call(lora, x) for x in batches])
    assert report.output_error == pytest.approx(np.linalg.norm(y - x) / np.linalg.norm(x), rel=1e-3)


def test_scores_that_do_not_depend_on_the_input_distill_exactly(batches):
    method = dataclasses.replace(VARIANTS[0], energy_target=0.8)
    model = nnx.List([Dense(5, 4, method=method, rngs=nnx.Rngs(0))])
    model = noisy(model)
    params = model[0].adapter.get_value()
    still = params["router"] | {"w1": jnp.zeros_like(params["router"]["w1"])}
    model[0].adapter = AdapterParam(params | {"router": still})
    _, report = lorasp_jax.distill(model, batches, forward=lambda model, x: model[0](x))
    assert report.output_error < 1e-5


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (functools.partial(lorasp_jax.prune, tolerance=1.0), r"tolerance must lie in \[0, 1\)"),
        (functools.partial(lorasp_jax.distill, rank=0), "at least 1, or None, got 0"),
    ],
)
def test_bad_arguments(act, message, batches):
    with pytest.raises(ValueError, match=message):
        act(model_of(VARIANTS[0]), batches)


def test_needs_lora_sp(batches):
    net = adaptation.adapt(Net(nnx.Rngs(0)), [("heads", LoRA(rank=2))], rngs=nnx.Rngs(1))
    with pytest.raises(ValueError, match="the model has no LoRA-SP layers"):
        lorasp_jax.prune(net, batches)
