"""Compare values and gradients of the kernel with those of its function."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.kernels import rowwise_kernel as kernels

WIDTHS = (32, 16)


def gated(shared, columns, valid, mask):
    """Use every feature: two column groups, a matmul, a mask, sums, statistics."""
    left, right = columns
    mixed = left * jnp.tanh(right.astype(jnp.float32) @ shared["w"] + shared["b"])
    mask = (mixed > 0).astype(jnp.int32) if mask is None else mask
    output = jnp.where(mask != 0, mixed, 0)
    sums = {
        "squares": jnp.where(valid, output**2, 0).sum(0),
        "rows": jnp.where(valid, 1.0, 0).sum(0),
    }
    return output, sums, mask, [mask.astype(jnp.float32).sum(-1, keepdims=True)]


def normal(*shape):
    return np.random.default_rng(0).normal(size=shape).astype(np.float32)


def rows_and_valid(rows, width):
    return normal(rows, width), np.random.default_rng(1).random((rows, 1)) < 0.7


@pytest.fixture(scope="module")
def shared():
    return {"w": normal(16, 32), "b": normal(32)}


def kernel(shared, rows, valid, function=gated):
    """Run the kernel for a single function."""
    interpret = jax.default_backend() != "gpu"
    packed = jax.tree.map(lambda leaf: leaf[None], kernels.PackedTree.of(shared))
    output, sums, statistics = kernels.rowwise_kernel(
        function, packed, rows, WIDTHS, valid, interpret=interpret
    )
    return output, jax.tree.map(lambda leaf: leaf[0], sums), statistics


def run(as_kernel, shared, rows, valid):
    """Return the loss, all outputs and the gradients, with or without the kernel."""

    def loss(shared, rows):
        if as_kernel:
            results = kernel(shared, rows, valid)
        else:
            output, sums, _, statistics = gated(shared, jnp.split(rows, [32], 1), valid, None)
            results = output, sums, statistics
        return jnp.sin(results[0]).sum() + (results[1]["squares"] * jnp.arange(32)).sum(), results

    with jax.default_matmul_precision("highest"):
        return jax.jit(jax.value_and_grad(loss, argnums=(0, 1), has_aux=True))(shared, rows)


def close(actual, expected):
    assert np.linalg.norm(actual - expected) <= 1e-5 * np.linalg.norm(expected)


@pytest.mark.parametrize(
    ("num_rows", "few"),  # one row per program; less than a block, one block, a partial last block
    [(5, kernels.FEW_ROWS), (1, 0), (16, 0), (83, 0)],
)
def test_equals_the_function(shared, num_rows, few, monkeypatch):
    monkeypatch.setattr(kernels, "FEW_ROWS", few)
    rows, valid = rows_and_valid(num_rows, 48)
    expected, actual = (run(as_kernel, shared, rows, valid) for as_kernel in (False, True))
    assert jax.tree.map(jnp.shape, actual) == jax.tree.map(jnp.shape, expected)
    jax.tree.map(close, actual, expected)


def test_programs_share_the_rows(shared, monkeypatch):
    """Several blocks per program, and not as many in each, give the same sums."""
    monkeypatch.setattr(kernels, "FEW_ROWS", 0)
    rows, valid = normal(16 * 12, 48), np.ones((16 * 12, 1), bool)
    one_block_each = run(True, shared, rows, valid)
    # Forward: 12 blocks over 5 programs, 2 or 3 each. Backward: 3 blocks over 2, 1 or 2 each.
    monkeypatch.setattr(kernels, "FORWARD", kernels.Launch(16, 4, 5))
    monkeypatch.setattr(kernels, "BACKWARD", kernels.Launch(64, 4, 2))
    several_blocks = run(True, shared, rows, valid)
    jax.tree.map(close, several_blocks, one_block_each)


def test_dtypes_are_those_of_the_function(shared):
    rows, valid = np.ones((20, 48), jnp.bfloat16), np.ones((20, 1), bool)
    (_, (output, _, _)), (_, d_rows) = jax.eval_shape(lambda *a: run(True, *a), shared, rows, valid)
    assert output.dtype == jnp.float32
    assert d_rows.dtype == jnp.bfloat16


def test_residuals_are_the_rows_and_the_packed_mask(shared):
    rows, valid = np.ones((32, 48), "f"), np.ones((32, 1), bool)

    _, vjp = jax.eval_shape(
        lambda rows: jax.vjp(lambda rows: kernel(shared, rows, valid)[0], rows), rows
    )
    stored = {leaf.shape for leaf in jax.tree.leaves(vjp) if leaf.shape}
    assert stored <= {(32, 48), (32, 32 // 8), (32, 1), (1, 16 * 32 + 32)}


def test_layers_share_traced_kernels(shared):
    """Otherwise, tracing and lowering a training step take twice as long."""
    rows, valid = np.zeros((4, 48), "f"), np.ones((4, 1), bool)

    def traces(layers):
        calls = []

        def counted(*arguments):
            calls.append(None)
            return gated(*arguments)

        def loss(rows):
            results = [kernel(shared, rows, valid, counted) for _ in range(layers)]
            return sum(output.sum() for output, *_ in results)

        jax.make_jaxpr(jax.grad(loss))(rows)
        return len(calls)

    assert traces(3) == traces(1) > 0


@pytest.mark.parametrize("few", [0, pytest.param(kernels.FEW_ROWS, marks=pytest.mark.slow)])
def test_stacked_functions(shared, few, monkeypatch):
    """Two functions in one kernel, with columns that start at an offset, equal two single calls."""
    monkeypatch.setattr(kernels, "FEW_ROWS", few)
    trees = [shared, jax.tree.map(np.negative, shared)]
    pair = jax.tree.map(lambda *rows: np.stack(rows), *map(kernels.PackedTree.of, trees))
    rows, valid = rows_and_valid(20, 8 + 2 * 48 + 3)

    def stacked(pair, rows):
        output, sums, (number,) = kernels.rowwise_kernel(
            gated, pair, rows, WIDTHS, valid, start=8, interpret=True
        )
        return jnp.sin(output).sum() + sums["squares"].sum(), (output, sums, number)

    def separate(trees, rows):
        starts = (8, 8 + 48)
        results = [
            gated(tree, [rows[:, at : at + 32], rows[:, at + 32 : at + 48]], valid, None)
            for tree, at in zip(trees, starts, strict=True)
        ]
        output = jnp.concatenate([r[0] for r in results], axis=1)
        sums = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(r[1] for r in results))
        number = jnp.concatenate([r[3][0] for r in results], axis=1)
        return jnp.sin(output).sum() + sums["squares"].sum(), (output, sums, number)

    run = lambda f: jax.jit(jax.value_and_grad(f, argnums=(0, 1), has_aux=True))  # noqa: E731
    (_, actual), (d_pair, d_rows) = jax.device_get(run(stacked)(pair, rows))
    (_, expected), (d_trees, others) = jax.device_get(run(separate)(trees, rows))
    d_stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *d_trees)
    jax.tree.map(close, (actual, d_pair.tree(), d_rows), (expected, d_stacked, others))


def test_bits_unpack_to_the_mask():
    mask = (normal(16, 128) > 0).astype(np.int32)
    packed = jax.jit(kernels._pack_bits)(mask)
    assert packed.dtype == jnp.uint8
    np.testing.assert_array_equal(jax.jit(kernels._unpack_bits)(packed), mask)


@pytest.mark.slow
def test_vmap_equals_a_loop(shared):
    rows, valid = (a.reshape(3, 40, -1) for a in rows_and_valid(120, 48))
    actual = jax.vmap(lambda rows, valid: run(True, shared, rows, valid))(rows, valid)
    expected = [run(True, shared, *pair) for pair in zip(rows, valid, strict=True)]
    jax.tree.map(close, actual, jax.tree.map(lambda *leaves: jnp.stack(leaves), *expected))
