"""The frozen-base product equals x @ W + z @ U and never computes a gradient for W."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.kernels.low_rank_matmul import low_rank_matmul

SHAPES = [(6, 10), (10, 6), (8, 8)]
RANK = 3


@pytest.fixture(autouse=True)
def full_precision():
    """A GPU would multiply in TF32."""
    with jax.default_matmul_precision("highest"):
        yield


def inputs(d_in, d_out, dtype=jnp.float32):
    keys = jax.random.split(jax.random.key(0), 4)
    shapes = [(2, 5, d_in), (d_in, d_out), (2, 5, RANK), (RANK, d_out)]
    return [jax.random.normal(k, s, dtype) for k, s in zip(keys, shapes, strict=True)]


def reference(x, kernel, z, u):
    return x @ kernel + z @ u


@pytest.mark.parametrize(("d_in", "d_out"), SHAPES)
def test_equals_the_reference(d_in, d_out):
    x, kernel, z, u = inputs(d_in, d_out)

    def gradients(product):
        def loss(x, z, u):
            return jnp.sum(jnp.sin(product(x, kernel, z, u)))

        return jax.jit(jax.value_and_grad(jax.checkpoint(loss), argnums=(0, 1, 2)))(x, z, u)

    for ours, theirs in zip(
        jax.tree.leaves(gradients(low_rank_matmul)),
        jax.tree.leaves(gradients(reference)),
        strict=True,
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("d_in", "d_out"), SHAPES)
def test_no_gradient_of_the_kernel(d_in, d_out):
    """Not even a buffer: no product in the gradient's program has the kernel's shape."""
    x, kernel, z, u = inputs(d_in, d_out)

    def program(product):
        def loss(kernel, z):
            return jnp.sum(product(x, kernel, z, u) ** 2)

        return loss, str(jax.make_jaxpr(jax.grad(loss, argnums=(0, 1)))(kernel, z))

    sides = rf"({d_in}|{d_in + RANK}|{d_out})"
    products = rf"f32\[{sides},{sides}\] = dot_general"
    loss, text = program(low_rank_matmul)
    assert not re.search(products, text)
    assert re.search(products, program(reference)[1])
    np.testing.assert_array_equal(jax.grad(loss)(kernel, z), 0)


def test_keeps_the_type_of_the_input():
    y = jax.eval_shape(low_rank_matmul, *inputs(6, 10, jnp.bfloat16))
    assert y.dtype == jnp.bfloat16


def test_vmap():
    x, kernel, z, u = inputs(6, 10)
    ours = jax.vmap(low_rank_matmul, in_axes=(0, None, 0, None))(x, kernel, z, u)
    np.testing.assert_allclose(ours, reference(x, kernel, z, u), rtol=1e-5, atol=1e-5)
