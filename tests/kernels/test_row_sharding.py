"""On sharded rows each device runs the kernel on its own rows, and nothing is gathered."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import NamedSharding, PartitionSpec

from lorasp_jax.kernels import rowwise_kernel as kernels
from lorasp_jax.kernels.blocks import Launch
from lorasp_jax.kernels.cached_attention import cached_attention
from lorasp_jax.kernels.row_sharding import by_rows
from lorasp_jax.kernels.short_attention import short_attention
from lorasp_jax.training.distributed import mesh as meshes
from tests.kernels.test_rowwise_kernel import close, kernel, normal


def doubled(shared, arrays):
    """Double the rows, sum them, and report the number of rows per call."""
    (rows,) = arrays
    return [shared[0] * rows, jnp.full((len(rows), 1), len(rows))], [rows.sum(0)]


@functools.partial(jax.jit, static_argnums=2)
def call(factor, rows, function=doubled):
    return by_rows(function, [factor], [rows])


def shard(rows, fsdp=2, axes=("data", "fsdp")):
    return jax.device_put(rows, NamedSharding(meshes.make_mesh(fsdp), PartitionSpec(axes)))


@pytest.mark.parametrize(
    ("num_rows", "axes", "rows_per_call"),
    # sharded over all 8 devices, over 4 pairs, over 2 groups of 4, replicated
    [(16, ("data", "fsdp"), 2), (16, "data", 4), (16, "fsdp", 8), (16, None, 16)],
)
def test_each_device_has_its_own_rows(num_rows, axes, rows_per_call):
    rows = np.arange(num_rows * 3, dtype="f").reshape(num_rows, 3)
    (twice, counts), (total,) = call(jnp.float32(2), shard(rows, axes=axes))
    np.testing.assert_array_equal(twice, 2 * rows)
    np.testing.assert_array_equal(counts, rows_per_call)
    np.testing.assert_array_equal(total, rows.sum(0))


def test_rows_that_do_not_divide_are_gathered():
    """With 12 rows on 8 devices, the sums would include the padding of the shards."""

    @jax.jit
    def sliced(rows):
        return by_rows(doubled, [jnp.float32(2)], [rows[:12] + 1])

    rows = np.arange(16 * 3, dtype="f").reshape(16, 3)
    (twice, _), (total,) = sliced(shard(rows))
    np.testing.assert_array_equal(twice, 2 * rows[:12] + 2)
    np.testing.assert_array_equal(total, (rows[:12] + 1).sum(0))


def test_vmap():
    rows = np.arange(2 * 4 * 3, dtype="f").reshape(2, 4, 3)
    factors = np.float32([2, 3])
    (times, _), (totals,) = jax.jit(jax.vmap(call, in_axes=(0, 0)))(factors, rows)
    np.testing.assert_array_equal(times, factors[:, None, None] * rows)
    np.testing.assert_array_equal(totals, rows.sum(1))


def test_rowwise_kernel(monkeypatch):
    """Values and gradients of the row-wise kernel on tokens of a sharded batch."""
    monkeypatch.setattr(kernels, "FEW_ROWS", 0)
    shared, x = {"w": normal(16, 32), "b": normal(32)}, normal(8, 5, 48)

    @jax.jit
    def gradients(shared, x):
        def loss(shared, x):
            rows = jnp.sin(x).reshape(-1, 48)
            valid = rows[:, :1] > 0
            output, sums, _ = kernel(shared, rows, valid)
            return jnp.sin(output).sum() + sums["squares"].sum()

        return jax.value_and_grad(loss, argnums=(0, 1))(shared, x)

    compiled = gradients.lower(shared, shard(x)).compile()
    assert "all-gather" not in compiled.as_text()
    jax.tree.map(close, compiled(shared, shard(x)), gradients(shared, x))


@pytest.mark.slow
@pytest.mark.parametrize("batch", [1, 6, 8])
def test_short_attention(batch):
    """Values and gradients of attention on a sharded batch, also one that does not divide."""
    q, mask = normal(8, 5, 2, 16), np.tri(5, dtype=bool)[None].repeat(8, axis=0)

    @jax.jit
    def gradients(q, mask):
        launches = (Launch(rows=16, keys=16, warps=4),) * 2

        def loss(q):
            k, v = jnp.sin(q[:, :, :1]), jnp.cos(q[:, :, :1])
            arrays = (a[:batch] for a in (q, k, v, mask))
            y = short_attention(*arrays, launches=launches, interpret=True)
            return jnp.sin(y).sum()

        return jax.value_and_grad(loss)(q)

    compiled = gradients.lower(shard(q), shard(mask)).compile()
    if batch == 8:
        assert "all-gather" not in compiled.as_text()
    jax.tree.map(close, compiled(shard(q), shard(mask)), gradients(q, mask))


def test_cached_attention():
    """Attention on a sharded batch, whose cached keys are sharded, too."""
    q, mask = normal(8, 5, 2, 16), np.ones((8, 5, 16), bool)
    mask[:, :, ::3] = False

    @jax.jit
    def attend(q, mask):
        own, cached = jnp.sin(q[:, :, :1]), jnp.cos(jnp.tile(q[:, :, :1], (1, 3, 1, 1))[:, :11])
        launch = Launch(rows=16, keys=16, programs=2, warps=1)
        arrays = q, (own, own + 1), (cached, cached - 1), mask
        return cached_attention(*arrays, launch=launch, interpret=True)

    compiled = attend.lower(shard(q), shard(mask)).compile()
    assert "all-gather" not in compiled.as_text()
    close(compiled(shard(q), shard(mask)), attend(q, mask))
