"""Physics: sums in a fixed order, so that accelerators give the same again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs import physics


@pytest.mark.parametrize(
    ("segments", "number"),
    [([0], 1), ([1, 0, 2], 3), ([0, 0, 0], 1), ([2, 0, 2, 0], 4), ([1], 2)],
    ids=str,
)
def test_sums_in_order(segments, number):
    segments = np.array(segments)
    for values in (
        jax.random.normal(jax.random.key(0), (len(segments), 3)),
        jnp.arange(len(segments)) + 1,
    ):
        found = physics._sum_in_order(values, segments, number)
        expected = jax.ops.segment_sum(values, segments, number)
        assert found.dtype == expected.dtype
        np.testing.assert_allclose(found, expected, rtol=1e-6)
    order = np.array([1e8, 1.0, -1e8], np.float32)  # the sum tells the order
    assert physics._sum_in_order(jnp.array(order), np.zeros(3, int), 1)[0] == 0.0


def equations(jaxpr):
    """All of a program, those of its loops and calls included."""
    for equation in jaxpr.eqns:
        yield equation
        for inner in jax.tree.leaves(list(equation.params.values())):
            inner = getattr(inner, "jaxpr", inner)
            if hasattr(inner, "eqns"):
                yield from equations(inner)


def unordered(function, *arguments):
    """Scatters that add floats, perhaps several to one place, which a GPU does in any order."""
    return [
        equation
        for equation in equations(jax.make_jaxpr(function)(*arguments).jaxpr)
        if equation.primitive.name in ("scatter-add", "scatter_add", "scatter-mul", "scatter_mul")
        and jnp.issubdtype(equation.invars[0].aval.dtype, jnp.floating)
        and not equation.params["unique_indices"]
    ]


def test_a_step_adds_in_a_fixed_order(env):
    state = jax.eval_shape(env.reset, jax.random.key(0))
    assert not unordered(env.step, state, state.info["command"])


def test_unordered_sums_would_be_found(env):
    def loop(x):
        return jax.lax.scan(
            lambda c, _: (jax.ops.segment_sum(c, jnp.zeros(3, int), 3), 0), x, length=2
        )

    assert len(unordered(jax.jit(loop), jnp.ones(3))) == 1
