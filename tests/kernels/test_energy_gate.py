"""Compare the energy gate with exact arithmetic, also under JAX transformations."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.kernels import energy_gate as gate
from tests import GOLDEN
from tests.cases import mostly_slow
from tests.jaxprs import target

GOLDEN = GOLDEN / "energy_gate_exact.npz"


@pytest.fixture(scope="module")
def golden():
    with np.load(GOLDEN) as file:
        return dict(file)


def energy_gate(scores, eta, implementation=None):
    """Run the gate; without a GPU the Triton kernel runs in the interpreter.

    "flags" is the gate inside the kernel of LoRA-SP.
    """
    if implementation == "flags":
        scores = jnp.abs(jnp.asarray(scores, jnp.float32))
        mask = gate.kept_flags(scores, eta) != 0
        return mask, mask.sum(-1), gate.kept_energy(scores, mask)
    interpret = jax.default_backend() != "gpu"
    return gate.energy_gate(scores, eta, implementation=implementation, interpret=interpret)


def random_scores(shape, seed=0):
    return np.logaddexp(0, 2 * np.random.default_rng(seed).normal(size=shape)).astype(np.float32)


@pytest.mark.parametrize(
    ("implementation", "max_misses"),
    [("pairwise", 0), ("bisection", 0), ("flags", 0), ("pallas", 0), ("sort", 1)],
)
@pytest.mark.parametrize("eta", mostly_slow([0.5, 0.7, 0.8, 0.9, 0.99], quick=[0.5, 0.9, 0.99]))
def test_equals_exact_arithmetic(golden, implementation, max_misses, eta):
    """`k` and `order` come from big-integer arithmetic; rounding in "sort" crosses η in one row."""
    row = [round(100 * eta) for eta in (0.5, 0.7, 0.8, 0.9, 0.99, 1)].index(round(100 * eta))
    k, order = golden["k"][row], golden["order"]
    run = jax.jit(lambda s: energy_gate(s, eta, implementation))
    mask, active_rank, kept_energy = map(np.asarray, run(golden["scores"]))
    expected = np.argsort(order, axis=1) < k[:, None]
    assert (mask != expected).any(1).sum() <= max_misses
    np.testing.assert_array_equal(active_rank, mask.sum(1))
    rows = (k > 0) & (mask == expected).all(1)
    np.testing.assert_allclose(kept_energy[rows], golden["E_k"][row][rows], rtol=1e-5)


def test_target_of_one_keeps_every_positive_score(golden):
    run = jax.jit(lambda s: gate.energy_gate(s, 1.0))
    mask, active_rank, kept_energy = run(golden["scores"])
    np.testing.assert_array_equal(mask, golden["scores"] > 0)
    assert (active_rank <= golden["k"][-1]).all()
    np.testing.assert_allclose(kept_energy, 1, rtol=1e-5)  # the order of summation may differ


@pytest.mark.parametrize("implementation", ["pairwise", "sort", "bisection", "pallas"])
def test_special_rows(implementation):
    rows = np.array([[0] * 4, [3e38] * 4, [0, 0, 0, 2e-38], [1] * 4, [0, 1e-20, 1, 1e-20]])
    run = jax.jit(lambda s: energy_gate(s, 0.5, implementation))
    mask, rank, kept = run(rows.astype(np.float32))
    expected = [[0, 0, 0, 0], [1, 1, 0, 0], [0, 0, 0, 1], [1, 1, 0, 0], [0, 0, 1, 0]]
    np.testing.assert_array_equal(mask, np.array(expected, bool))
    np.testing.assert_array_equal(rank, [0, 2, 1, 2, 1])
    np.testing.assert_allclose(kept, [1, 0.5, 1, 0.5, 1], rtol=1e-6)
    assert np.isnan(run(rows.astype(np.float32) + np.float32("nan"))[2]).all()


INF, NAN = np.inf, np.nan
EXTREME = [
    [INF] * 4,
    [INF, 1, INF, 0],
    [0, 0, 3e38, -0.0],
    [-0.0, 1, 1, 0],
    [-3, 1, 2, -4],
]


@pytest.mark.parametrize("implementation", ["pairwise", "sort", "bisection", "flags", "pallas"])
@pytest.mark.parametrize(
    ("eta", "expected"),
    [
        (1e-300, [1, 1, 1, 1, 1, 0]),  # a row's largest share is at least 1/R
        (0.5, [2, 1, 1, 1, 1, 0]),
        (0.9, [4, 2, 1, 2, 3, 0]),
        (1.0, [4, 3, 1, 2, 4, 0]),
    ],
)
def test_limits_of_fp32(implementation, eta, expected):
    """Infinite scores share the energy, rows with NaN keep nothing, signs are ignored."""
    rows = np.array([*EXTREME, [NAN, 1, INF, 2]], np.float32)
    run = jax.jit(lambda s: energy_gate(s, eta, implementation))
    mask, rank, kept = run(rows)
    np.testing.assert_array_equal(rank, expected)
    np.testing.assert_array_equal(mask.sum(1), expected)
    assert (mask <= (rows != 0)).all()
    assert np.isfinite(kept[:-1]).all()
    assert np.isnan(kept[-1])


@pytest.mark.parametrize("implementation", ["pairwise", "bisection", "flags", "pallas"])
def test_nan_with_a_maximum_that_ignores_it(monkeypatch, implementation):
    """Triton's maximum ignores NaN; emulate it with a patched `jnp.max`."""
    largest = jnp.max
    monkeypatch.setattr(jnp, "max", lambda a, **o: largest(jnp.where(a == a, a, -INF), **o))
    rows = np.array([[NAN, 1, INF, 2], [1, NAN, 3, 0], [NAN] * 4, [INF, 1, 2, 0]], np.float32)
    run = jax.jit(lambda s: energy_gate(s, 0.9, implementation))
    _, rank, kept = run(rows)
    np.testing.assert_array_equal(rank, [0, 0, 0, 1])
    np.testing.assert_array_equal(kept, [NAN, NAN, NAN, 1])


@pytest.mark.parametrize("eta", [1e-300, 0.5, 0.9, 1.0])
def test_gradients_at_the_limits_of_fp32(eta):
    rows = np.array(EXTREME, np.float32)
    gradient = jax.jit(jax.grad(lambda s: gate.energy_gate(s, eta)[2].sum()))(rows)
    assert np.isfinite(gradient).all()


def test_flags_take_any_leading_axes():
    scores = random_scores((1, 5, 7))
    run = jax.jit(lambda s, name: energy_gate(s, 0.9, name), static_argnums=1)
    (*flags, kept), (*bisected, expected) = run(scores, "flags"), run(scores, "bisection")
    jax.tree.map(np.testing.assert_array_equal, flags, bisected)
    np.testing.assert_allclose(kept, expected, rtol=1e-5)  # two programs round differently


@pytest.mark.parametrize("shape", [(3, 1), (2, 5, 100)])
def test_pallas_takes_any_shape(shape):
    scores = random_scores(shape)
    (pallas,) = jax.jit(jax.vmap(lambda s: energy_gate(s, 0.9, "pallas")[0]))(scores[None])
    bisected = jax.jit(lambda s: energy_gate(s, 0.9, "bisection")[0])(scores)
    np.testing.assert_array_equal(pallas, bisected)


@pytest.mark.parametrize("implementation", ["pairwise", "sort", "bisection"])
def test_transformations_agree(implementation):
    @jax.jit
    def all_ways(scores):
        run = functools.partial(gate.energy_gate, energy_target=0.9, implementation=implementation)
        scanned = jax.lax.scan(lambda _, s: (None, run(s)), None, scores)[1]
        return run(scores), scanned, jax.vmap(run)(scores), jax.checkpoint(run)(scores)

    direct, *others = all_ways(random_scores((4, 6, 33)))
    for other in others:
        np.testing.assert_array_equal(other[0], direct[0])
        np.testing.assert_allclose(other[2], direct[2], rtol=1e-5)


@pytest.mark.parametrize("rank", [gate.PAIRWISE_RANK, gate.PAIRWISE_RANK + 1])
def test_only_larger_banks_search_in_a_loop_on_a_cpu(rank):
    """The loop of "bisection" made a training step on a CPU a fifth slower."""
    jaxpr = str(jax.make_jaxpr(lambda s: gate.energy_gate(s, 0.9))(np.ones((2, rank), "f")))
    assert ("scan[" in jaxpr or "while[" in jaxpr) == (rank > gate.PAIRWISE_RANK)


def test_gradient_of_the_kept_energy():
    """d(1 - E)/ds_i = -2 s_i (m_i - E) / Σ s² for a constant mask; zero rows have zero gradient."""
    scores = random_scores((5, 16))
    scores[0] = 0

    def loss(scores):
        mask, _, kept = gate.energy_gate(scores, 0.8)
        return (1 - kept).sum(), (mask, kept)

    gradient, (mask, kept) = jax.device_get(jax.jit(jax.grad(loss, has_aux=True))(scores))
    total = np.sum(scores**2, -1, keepdims=True)
    total[0] = 1
    expected = -2 * scores * (mask - kept[:, None]) / total
    np.testing.assert_allclose(gradient, expected, atol=1e-6)
    np.testing.assert_allclose(np.sum(scores * gradient, -1), 0, atol=1e-6)  # scale-free
    np.testing.assert_array_equal(gradient[0], 0)


def test_target_is_an_exact_decimal():
    """Nine of ten equal energies are exactly 9/10, although 0.9 is rounded in fp32."""
    etas = [0.9, np.float32(0.9), 0.900001]
    ranks = jax.jit(lambda s: [gate.energy_gate(s, eta)[1] for eta in etas])(np.ones(10, "f"))
    assert ranks == [9, 9, 10]


@pytest.mark.parametrize("eta", [0, -0.1, 1.0001, float("nan"), float("inf"), "high"])
def test_invalid_target(eta):
    with pytest.raises(ValueError, match=r"energy_target must lie in \(0, 1\]"):
        gate.energy_gate(jnp.ones(3), eta)


def test_unknown_implementation():
    with pytest.raises(ValueError, match="one of pairwise, sort, bisection, pallas"):
        gate.energy_gate(jnp.ones(3), 0.9, implementation="argsort")


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
@pytest.mark.parametrize(
    ("platform", "kind", "implementation", "call"),
    [
        ("cuda", "NVIDIA H200", "pallas", "__gpu$xla.gpu.triton"),
        ("tpu", "TPU v5e", "bisection", ""),
        ("cpu", "cpu", "pairwise", ""),
    ],
)
def test_lowers_without_the_device(platform, kind, implementation, call):
    run = jax.jit(lambda s: gate.energy_gate(s, 0.9, implementation=implementation))
    with target(platform, kind):
        traced = run.trace(jax.ShapeDtypeStruct((3, 50, 100), jnp.float32))
        text = traced.lower(lowering_platforms=(platform,)).as_text()
    assert call in text
    assert ".py" not in text  # `compilation_cache.enable` leaves the call stack out of programs
