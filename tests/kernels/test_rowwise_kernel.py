"""The fused kernel against the function it runs, values and gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.kernels import rowwise_kernel as kernels

WIDTHS = (32, 16)


def gated(shared, columns, counts, kept):
    """Use everything a function may: two columns, a matrix product, a mask, sums."""
    left, right = columns
    mixed = left * jnp.tanh(right.astype(jnp.float32) @ shared["w"] + shared["b"])
    kept = mixed > 0 if kept is None else kept
    output = jnp.where(kept, mixed, 0)
    sums = {
        "squares": jnp.where(counts, output**2, 0).sum(0),
        "rows": jnp.where(counts, 1.0, 0).sum(0),
    }
    return output, sums, kept, [kept.astype(jnp.float32).sum(-1, keepdims=True)]


@pytest.fixture(scope="module")
def shared():
    keys = jax.random.split(jax.random.key(0))
    return {"w": jax.random.normal(keys[0], (16, 32)), "b": jax.random.normal(keys[1], (32,))}


def run(fused, shared, rows, counts):
    """Return the loss, all outputs and the gradients, with or without the kernel."""

    def loss(shared, rows):
        if fused:
            interpret = jax.default_backend() != "gpu"
            found = kernels.rowwise_kernel(gated, shared, rows, WIDTHS, counts, interpret=interpret)
        else:
            output, sums, _, statistics = gated(shared, jnp.split(rows, [32], 1), counts, None)
            found = output, sums, statistics
        return jnp.sin(found[0]).sum() + (found[1]["squares"] * jnp.arange(32)).sum(), found

    with jax.default_matmul_precision("highest"):
        return jax.jit(jax.value_and_grad(loss, argnums=(0, 1), has_aux=True))(shared, rows)


def close(found, expected):
    assert np.linalg.norm(found - expected) <= 1e-5 * np.linalg.norm(expected)


@pytest.mark.parametrize(
    ("num_rows", "few"),  # one row per program; less than a block, one block, a partial last block
    [(5, kernels.FEW_ROWS), (1, 0), (16, 0), (83, 0)],
)
def test_equals_the_function(shared, num_rows, few, monkeypatch):
    monkeypatch.setattr(kernels, "FEW_ROWS", few)
    rows = jax.random.normal(jax.random.key(1), (num_rows, 48))
    counts = jax.random.bernoulli(jax.random.key(2), 0.7, (num_rows, 1))
    expected, found = (run(fused, shared, rows, counts) for fused in (False, True))
    assert jax.tree.map(jnp.shape, found) == jax.tree.map(jnp.shape, expected)
    jax.tree.map(close, found, expected)


def test_programs_share_the_rows(shared, monkeypatch):
    """Several blocks per program give the same sums."""
    monkeypatch.setattr(kernels, "FEW_ROWS", 0)
    rows = jax.random.normal(jax.random.key(1), (16 * 12, 48))
    counts = jnp.ones((len(rows), 1), bool)
    one_each = run(True, shared, rows, counts)
    # Forward: 12 blocks over at most 5 programs, 3 blocks each. Backward: 3 blocks, 1 each.
    monkeypatch.setattr(kernels, "FORWARD", kernels.Launch(16, 4, 5))
    monkeypatch.setattr(kernels, "BACKWARD", kernels.Launch(64, 4, 2))
    together = run(True, shared, rows, counts)
    jax.tree.map(close, together, one_each)


def test_dtypes_are_those_of_the_function(shared):
    rows = jnp.ones((20, 48), jnp.bfloat16)
    (_, (output, _, _)), (_, d_rows) = run(True, shared, rows, jnp.ones((20, 1), bool))
    assert output.dtype == jnp.float32
    assert d_rows.dtype == jnp.bfloat16


def test_residuals_are_the_rows_and_the_packed_mask(shared):
    rows, counts = jnp.ones((32, 48)), jnp.ones((32, 1), bool)

    def call(rows):
        return kernels.rowwise_kernel(gated, shared, rows, WIDTHS, counts, interpret=True)[0]

    _, pull_back = jax.eval_shape(lambda rows: jax.vjp(call, rows), rows)
    stored = {leaf.shape for leaf in jax.tree.leaves(pull_back) if leaf.shape}
    assert stored <= {(32, 48), (32, 32 // 8), (32, 1), (1, 16 * 32 + 32)}


def test_shared_arrays_may_come_packed(shared):
    rows, counts = jnp.sin(jnp.arange(16.0 * 48)).reshape(16, 48), jnp.ones((16, 1), bool)
    packed = kernels.PackedTree.of(shared)
    assert packed.values.shape == (16 * 32 + 32,)
    jax.tree.map(np.testing.assert_array_equal, packed.tree(), shared)
    expected, (d_shared, d_rows) = run(True, shared, rows, counts)
    actual, (d_packed, others) = run(True, packed, rows, counts)
    jax.tree.map(close, (actual, d_packed.tree(), others), (expected, d_shared, d_rows))


@pytest.mark.parametrize("few", [0, pytest.param(kernels.FEW_ROWS, marks=pytest.mark.slow)])
def test_functions_side_by_side(shared, few, monkeypatch):
    """Two functions in one kernel, their columns starting at an offset, equal two single calls."""
    monkeypatch.setattr(kernels, "FEW_ROWS", few)
    trees = [shared, jax.tree.map(jnp.negative, shared)]
    pair = jax.tree.map(lambda *rows: jnp.stack(rows), *map(kernels.PackedTree.of, trees))
    rows = jax.random.normal(jax.random.key(1), (20, 8 + 2 * 48 + 3))
    counts = jax.random.bernoulli(jax.random.key(2), 0.7, (20, 1))

    def together(pair, rows):
        output, sums, (number,) = kernels.rowwise_kernel(
            gated, pair, rows, WIDTHS, counts, start=8, interpret=True
        )
        return jnp.sin(output).sum() + sums["squares"].sum(), (output, sums, number)

    def alone(trees, rows):
        starts = (8, 8 + 48)
        found = [
            gated(tree, [rows[:, at : at + 32], rows[:, at + 32 : at + 48]], counts, None)
            for tree, at in zip(trees, starts, strict=True)
        ]
        output = jnp.concatenate([one[0] for one in found], axis=1)
        sums = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(one[1] for one in found))
        number = jnp.concatenate([one[3][0] for one in found], axis=1)
        return jnp.sin(output).sum() + sums["squares"].sum(), (output, sums, number)

    run = lambda f: jax.jit(jax.value_and_grad(f, argnums=(0, 1), has_aux=True))  # noqa: E731
    (_, found), (d_pair, d_rows) = run(together)(pair, rows)
    (_, expected), (d_trees, others) = run(alone)(trees, rows)
    d_stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *d_trees)
    jax.tree.map(close, (found, d_pair.tree(), d_rows), (expected, d_stacked, others))


def test_bits_are_the_bools():
    kept = jax.random.bernoulli(jax.random.key(0), 0.5, (16, 128))
    packed = kernels._pack_bits(kept)
    assert packed.dtype == jnp.uint8
    np.testing.assert_array_equal(kernels._unpack_bits(packed), kept)


@pytest.mark.slow
def test_vmap_is_a_loop(shared):
    rows = jax.random.normal(jax.random.key(1), (3, 40, 48))
    counts = jax.random.bernoulli(jax.random.key(2), 0.7, (3, 40, 1))
    found = jax.vmap(lambda rows, counts: run(True, shared, rows, counts))(rows, counts)
    expected = [run(True, shared, *pair) for pair in zip(rows, counts, strict=True)]
    jax.tree.map(close, found, jax.tree.map(lambda *leaves: jnp.stack(leaves), *expected))
