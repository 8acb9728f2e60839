"""LoRA-SP's equations, losses, parameter counts, GPU kernel and equivalence with LoRA."""

import dataclasses
import functools
import operator
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.dense import DenseLayer, dense, dense_shared_input
from lorasp_jax.kernels import rowwise_kernel
from lorasp_jax.peft import LoRA, LoRASP
from lorasp_jax.peft.lora_sp import gpu_kernel, losses
from lorasp_jax.peft.lora_sp.gpu_kernel import FusedBottleneck
from lorasp_jax.peft.lora_sp.router import router_scores
from tests.jaxprs import primitives, target

D_IN, D_OUT = 24, 40
KERNEL = jax.ShapeDtypeStruct((D_IN, D_OUT), jnp.float32)
MASK = np.random.default_rng(4).random((3, 7)) < 0.6


def normal(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape).astype("f")


@pytest.fixture(scope="module")
def x():
    return normal(0, 3, 7, D_IN)


@functools.partial(jax.jit, static_argnums=0)
def _initial(method, key):
    return method.init(key, KERNEL)[0]


def initial(method, key=1):
    return _initial(method, jax.random.key(key))


@functools.partial(jax.jit, static_argnums=2)
def scores_of(router, x, kind="gelu"):
    return router_scores(router, x @ router["w1"], kind)


@jax.jit
def losses_of(scores, kept_energy=1.0, valid=None):
    """The three losses for scores that are also the logits; every positive score is active."""
    valid = jnp.ones((len(scores), 1), bool) if valid is None else valid
    energy = jnp.broadcast_to(jnp.asarray(kept_energy).reshape(-1, 1), (len(scores), 1))
    sums = losses.loss_sums(scores, scores, scores > 0, energy, valid)
    return losses.spectral_loss(sums), losses.balance_loss(sums), losses.z_loss(sums)


def test_initial_scores_are_one(x):
    scores, logits = scores_of(initial(LoRASP())["router"], x)
    assert (scores.shape, logits.shape) == ((3, 7, 128), (3, 7, 128))
    np.testing.assert_allclose(scores, 1, atol=0.15)
    assert (
        np.asarray(scores).std() > 1e-3
    )  # not equal, or ties would always prune the same directions


def test_paper_router_repeats_a_softmax(x):
    """Each of four softmax values scores 32 directions. Scores are non-negative for any W2."""
    router = initial(LoRASP.paper())["router"]
    scores, logits = scores_of(router, x, "softmax")
    exponentials = np.exp(np.asarray(logits))
    softmax = exponentials / exponentials.sum(-1, keepdims=True)
    np.testing.assert_allclose(scores, np.repeat(softmax, 32, -1), rtol=1e-5)
    shifted, _ = scores_of(
        router | {"w2": np.asarray(router["w2"]) - np.float32(0.3)}, x, "softmax"
    )
    assert np.min(shifted) == 0


def test_unit_scores_and_full_target_equal_lora(x):
    """With s = 1 (zero router weights) and η = 1, LoRA-SP is LoRA of the same rank and alpha."""
    method = LoRASP(rank=16, energy_target=1.0, alpha=8.0)
    params = initial(method)
    router = params["router"] | {"w2": np.zeros((32, 16), "f")}
    u = normal(2, 16, D_OUT)
    params = {"bank": params["bank"] | {"u": u}, "router": router}
    ours, aux = jax.jit(method.delta)(params, x)
    lora = {"lora_a": params["bank"]["v"], "lora_b": u}
    theirs, _ = jax.jit(LoRA(rank=16, alpha=8.0).delta)(lora, x)
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(aux.active_rank, 16)


def test_losses_of_uniform_and_concentrated_scores():
    """Balance is 1 for uniform use and R for a single direction; z is 0 for zero logits."""
    uniform, eye = np.ones((5, 8), "f"), np.eye(8, dtype="f")
    single = eye[[0] * 5]
    assert losses_of(uniform)[1] == pytest.approx(1)
    assert losses_of(single)[1] == pytest.approx(8)
    assert losses_of(eye[:5])[1] == pytest.approx(8 / 5)  # balanced over tokens
    assert losses_of(np.float32(3) * uniform)[2] == pytest.approx(9, rel=1e-5)
    assert losses_of(np.float32(1e-9) * uniform)[2] == pytest.approx(0, abs=1e-6)
    kept = np.array([0.9, 1.0, 0.95, 0.2, 0.1], "f")
    spectral, _, _ = losses_of(uniform, kept, valid=np.arange(5)[:, None] < 3)
    assert spectral == pytest.approx(0.05)


class WithFusedKernel(LoRASP):
    """Always use the fused kernel: Triton's on a GPU, interpreted elsewhere."""

    def implementation(self, params):
        interpret = jax.default_backend() != "gpu"
        sizes = self.rank, params["router"]["w2"].shape[-1], self.hidden_width
        return FusedBottleneck(*sizes, self.energy_target, self.scale, interpret=interpret)


def loss_and_gradients(params, x, mask, method):
    def loss(params, x):
        y, aux = method.delta(params, x, token_mask=mask)
        return jnp.sin(y).sum() + sum(i * v for i, v in enumerate(aux.losses.values())), (y, aux)

    return jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)(params, x)


expected_loss_and_gradients = jax.jit(loss_and_gradients, static_argnums=3)


@pytest.mark.parametrize("num_scores", [32, 64], ids=["whole", "pruned"])
@pytest.mark.parametrize(
    ("masked", "few"),
    [pytest.param(False, 0, marks=pytest.mark.slow), (True, 0), (True, rowwise_kernel.FEW_ROWS)],
)
def test_fused_kernel_equals_the_method(x, monkeypatch, masked, few, num_scores):
    monkeypatch.setattr(rowwise_kernel, "FEW_ROWS", few)
    fields = {"rank": 32, "hidden_width": 16, "energy_target": 0.7}
    params = initial(LoRASP(**fields))
    params["bank"]["u"] = normal(2, 32, D_OUT)
    params["router"]["w2"] = normal(3, 16, num_scores)
    params["router"]["b2"] = np.ones(num_scores, "f")
    mask = MASK if masked else None
    fused = functools.partial(loss_and_gradients, method=WithFusedKernel(**fields))
    with jax.default_matmul_precision("highest"):
        expected = expected_loss_and_gradients(params, x, mask, LoRASP(**fields))
        actual = jax.jit(fused)(params, x, mask)
    assert 1 < actual[0][1][1].mean_active_rank() < 31
    for a, e in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        error = np.asarray(a, float) - np.asarray(e, float)
        assert np.linalg.norm(error) <= 1e-5 * np.linalg.norm(e)


def test_layers_trace_the_same_kernel_once(x, monkeypatch):
    calls, block = [], gpu_kernel.bottleneck_block

    def counted(*arguments, **options):
        calls.append(None)
        return block(*arguments, **options)

    monkeypatch.setattr(gpu_kernel, "bottleneck_block", counted)

    def traces(layers, energy_target):
        method = WithFusedKernel(rank=32, hidden_width=16, energy_target=energy_target)
        params, before = [initial(method, i) for i in range(layers)], len(calls)
        jax.make_jaxpr(lambda x: [method.delta(p, x)[0] for p in params])(x)
        return len(calls) - before

    assert traces(3, 0.61) == traces(1, 0.62) > 0


def test_layers_with_a_shared_input_share_a_kernel(x):
    method = WithFusedKernel(rank=32, hidden_width=16, energy_target=0.7)
    params = [initial(method, key) for key in (1, 2)]
    for i, p in enumerate(params):
        p["bank"]["u"] = normal(i, 32, D_OUT)
        p["router"]["w2"] = normal(i + 3, 16, 32)
    weights = normal(9, 2, D_IN, D_OUT)

    def shared(params, x):
        pairs = zip(params, weights, strict=True)
        arrays = [DenseLayer(w, None, p, method) for p, w in pairs]
        return dense_shared_input(x, arrays, token_mask=MASK)

    def separate(params, x):
        pairs = zip(params, weights, strict=True)
        return [method.apply(p, x, w, token_mask=MASK) for p, w in pairs]

    def values_and_grads(layers):
        def loss(params, x):
            results = layers(params, x)
            losses = sum(i * v for _, aux in results for i, v in enumerate(aux.losses.values()))
            return sum(jnp.sin(y).sum() for y, _ in results) + losses, results

        return jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)

    functions = [jax.jit(values_and_grads(f)) for f in (shared, separate)]
    actual, expected = (f(params, x) for f in functions)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3), actual, expected
    )
    programs = [primitives(f, params, x) for f in functions]
    assert [names.count("pallas_call") for names in programs] == [2, 4]


@pytest.mark.parametrize(
    ("method", "kernels"),
    [
        (LoRASP(rank=64), ["rowwise_kernel"]),
        (LoRASP(rank=48), ["energy_gate"]),  # sizes that Triton does not support
        (LoRASP(hidden_width=8), ["energy_gate"]),
        (LoRASP.paper(rank=64), ["energy_gate"]),
        (LoRASP(rank=64, router="gelu_relu"), ["energy_gate"]),
    ],
)
def test_kernels_on_an_nvidia_gpu(x, method, kernels):
    params, kernel = jax.eval_shape(lambda: initial(method)), np.ones((D_IN, D_OUT), "f")
    run = jax.jit(lambda params, x: method.apply(params, x, kernel)[0])
    for platform, expected in (("cuda", kernels), ("cpu", [])):
        with target(platform):
            text = str(run.trace(params, x).jaxpr)
        assert sorted(set(re.findall(r"name=(rowwise_kernel|energy_gate)", text))) == expected


def test_pruned_directions_are_scored_but_inactive(x):
    """Scores beyond the bank's R directions contribute to E_k, but not to z."""
    method, unpruned = LoRASP(rank=8, energy_target=1.0), LoRASP(rank=12, energy_target=1.0)
    params = jax.tree.map(np.asarray, initial(unpruned))
    bank = {"u": params["bank"]["u"][:8], "v": params["bank"]["v"][:, :8]}
    aux = jax.jit(method.apply)(params | {"bank": bank}, x, np.ones((D_IN, D_OUT), "f"))[1]
    np.testing.assert_array_equal(aux.active_rank, 8)
    assert aux.usage.shape == (12,)
    np.testing.assert_allclose(aux.kept_energy, 8 / 12, atol=0.05)
    router = params["router"] | {"b2": params["router"]["b2"][:10]}
    with pytest.raises(ValueError, match=r"needs router/b2 \[12\], got \[10\]"):
        dense(x, np.ones((D_IN, D_OUT), "f"), None, {"bank": bank, "router": router}, method)


def test_softmax_router_covers_any_rank():
    w2 = np.asarray(initial(LoRASP(rank=7, router="softmax", hidden_width=3))["router"]["w2"])
    np.testing.assert_array_equal(w2.sum(0), 1)
    np.testing.assert_array_equal(w2.sum(1), [3, 2, 2])


def test_tokens_with_zero_scores_are_ignored(x):
    """Scores after a ReLU may all be 0: nothing is active, kept energy is 1, the losses are 0."""
    method = LoRASP.paper()
    params = initial(method)
    params["router"]["w2"] = -np.asarray(params["router"]["w2"])

    def loss(params):
        y, aux = method.delta(params, x)
        return y.sum() + sum(aux.losses.values()), aux

    gradients, aux = jax.jit(jax.grad(loss, has_aux=True))(params)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    np.testing.assert_array_equal(aux.active_rank, 0)
    np.testing.assert_array_equal(aux.kept_energy, 1)
    assert all(value == 0 for value in aux.losses.values())


@pytest.mark.parametrize("path", [("router", "b2"), ("router", "w1"), ("bank", "v")])
def test_nan_parameters_propagate(x, monkeypatch, path):
    """NaN propagates even if clipping drops it, as minimum and maximum do in a GPU kernel."""
    monkeypatch.setattr(jnp, "clip", lambda a, low, high: jnp.fmin(jnp.fmax(a, low), high))
    params = initial(LoRASP())
    part, name = path
    params[part][name] = np.array(params[part][name])
    params[part][name][0] = np.nan
    y, aux = jax.jit(LoRASP().delta)(params, x)
    assert np.isnan(y).all()
    if part == "router":
        assert all(np.isnan(value) for value in aux.losses.values())


def test_scale_follows_alpha():
    assert LoRASP().scale == LoRASP(rank=16).scale == 2
    assert dataclasses.replace(LoRASP(), alpha=64.0).scale == 0.5


def test_losses_of_stacked_layers():
    draw = lambda size: np.random.default_rng(size).uniform(1, 3, (3, size)).astype("f")  # noqa: E731
    sums = losses.LossSums(*map(draw, (1, 1, 1, 8, 8)))
    each = [jax.tree.map(operator.itemgetter(i), sums) for i in range(3)]
    stacked = losses.Losses(sums)
    assert [*stacked] == ["spectral", "balance", "z"]
    for name, values in stacked.items():
        np.testing.assert_allclose(values, [losses.Losses(one)[name] for one in each], rtol=1e-6)
