"""Bytes that recomputing a layer takes, compared with counts by hand."""

import jax
import jax.numpy as jnp
import pytest

from lorasp_jax.training.cost import working_set

ROWS, WIDTH = 512, 1024
WIDE = 4 * ROWS * WIDTH
"""Bytes of one hidden layer [ROWS, WIDTH]."""
X, W = jnp.ones((ROWS, 8)), jnp.ones((8, WIDTH))


def mlp(x, w):
    return jnp.tanh(x @ w) @ w.T


def bytes_of(layer, *arguments, layers=1, **options):
    """Return the bytes for recomputing `layers` equal layers, in units of a hidden layer."""

    def loss(x, *weights):
        for _ in range(layers):
            x = jax.checkpoint(layer, **options)(x, *weights)
        return jnp.sum(x)

    gradient = jax.grad(loss, argnums=range(len(arguments)))
    return working_set.largest(jax.make_jaxpr(gradient)(*arguments).jaxpr) / WIDE


def test_a_layer_holds_its_activation_and_two_gradients():
    # tanh(x W), the gradient of it and that of x W; x W itself is no longer needed.
    assert bytes_of(mlp, X, W) == pytest.approx(3, abs=0.1)


def test_layers_do_not_add_up():
    assert bytes_of(mlp, X, W, layers=4) == pytest.approx(3, abs=0.1)


def test_functions_that_a_layer_calls_twice_do_not_share_their_values():
    called = jax.jit(mlp)
    once = bytes_of(called, X, W)
    assert bytes_of(lambda x, w: called(called(x, w), w), X, W) < once + 2.1


def test_fused_operations_store_nothing():
    def layer(x, w):
        return jnp.sum(jnp.cos(jnp.sin(jnp.exp(x @ w))), axis=1)

    # x W, and the gradient of it.
    assert bytes_of(layer, X, W) == pytest.approx(2, abs=0.1)


def test_a_product_is_added_to_another_in_place():
    def low_rank(x, w, p, u):
        return jnp.sum(jnp.sin(x @ w + (x @ p) @ u), axis=1)

    def single(x, w):
        return jnp.sum(jnp.sin(x @ w), axis=1)

    adapted = bytes_of(low_rank, X, W, jnp.ones((8, 2)), jnp.ones((2, WIDTH)))
    assert adapted == pytest.approx(bytes_of(single, X, W), abs=0.1)


def test_a_loop_over_layers_recomputes_one_at_a_time():
    def loss(x, weights):
        return jnp.sum(jax.lax.scan(lambda x, w: (jax.checkpoint(mlp)(x, w), None), x, weights)[0])

    jaxpr = jax.make_jaxpr(jax.grad(loss, argnums=1))(X, jnp.ones((5, *W.shape)))
    assert working_set.largest(jaxpr.jaxpr) / WIDE == pytest.approx(3, abs=0.1)


def test_without_rematerialization_nothing_is_recomputed():
    jaxpr = jax.make_jaxpr(jax.grad(lambda x: jnp.sum(mlp(x, W))))(X)
    assert working_set.largest(jaxpr.jaxpr) == 0


def test_what_the_forward_pass_kept_is_not_counted():
    everything = jax.checkpoint_policies.everything_saveable
    assert bytes_of(mlp, X, W, policy=everything) < bytes_of(mlp, X, W)
