"""Compare unrolled layers with the scan: values, gradients and residuals."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.dense import AdapterParam, Dense
from lorasp_jax.kernels.rematerialization import save_for_backward
from lorasp_jax.models.transformer.depth import (
    ByLayer,
    scan_depth,
    stack,
    unstack,
)
from lorasp_jax.peft import LoRA
from tests.jaxprs import primitives
from tests.models.random_models import with_random_parameters
from tests.nets import METHODS, trained
from tests.peft.lora_sp.test_method import WithFusedKernel

DEPTH, TOKENS, WIDTH, INNER = 3, 5, 8, 12


class Net(nnx.Module):
    """Residual layers in a stack."""

    def __init__(self):
        self.blocks = stack(lambda rngs: Layer(rngs=rngs), DEPTH, nnx.Rngs(0))


class Layer(nnx.Module):
    def __init__(self, *, rngs):
        self.up = Dense(WIDTH, INNER, rngs=rngs)
        self.down = Dense(INNER, WIDTH, rngs=rngs)

    def __call__(self, x):
        return x + self.down(jnp.tanh(self.up(x)))


NET = with_random_parameters(Net)
X = np.sin(np.arange(TOKENS * WIDTH, dtype=np.float32)).reshape(1, TOKENS, WIDTH)


@pytest.fixture(scope="module")
def split():
    return adaptation.split(trained((".*", METHODS["lora"]), seed=1, net=NET))


def loss_of(graphdef, frozen, **options):
    def loss(adapters):
        blocks = nnx.merge(graphdef, adapters, frozen).blocks
        y, sums = scan_depth(blocks, lambda block, x, _: (block(x), x.sum()), X, **options)
        return (y**2).sum() + (sums * jnp.arange(DEPTH)).sum()

    return loss


def assert_close(actual, expected):
    assert np.linalg.norm(actual - expected) <= 1e-3 * np.linalg.norm(expected)


def test_dropout_is_the_same_unrolled_and_scanned():
    """Each layer of the stack has its own key."""
    model = trained((".*", LoRA(rank=4, dropout=0.5)), seed=1, net=NET)
    with_dropout = adaptation.with_dropout(model, jax.random.key(5))
    losses = []
    for net, unroll in ((model, False), (with_dropout, False), (with_dropout, True)):
        graphdef, adapters, frozen = nnx.split(net, AdapterParam, ...)
        losses.append(jax.jit(loss_of(graphdef, frozen, remat="products", unroll=unroll))(adapters))
    np.testing.assert_allclose(losses[1], losses[2], rtol=1e-5)
    assert abs(losses[1] - losses[0]) > 1e-2 * losses[0]


@pytest.mark.parametrize("remat", ["none", "products"])
def test_unrolled_gradients_equal_scanned_gradients(split, remat):
    graphdef, adapters, frozen = split
    scanned, unrolled = (
        jax.jit(jax.value_and_grad(loss_of(graphdef, frozen, remat=remat, unroll=unroll)))(adapters)
        for unroll in (False, True)
    )
    jax.tree.map(assert_close, unrolled, scanned)


def test_unrolled_layers_save_no_weight_slices_and_concatenate_gradients(split):
    graphdef, adapters, frozen = split

    def residuals(adapters, frozen):
        return jax.vjp(loss_of(graphdef, frozen, remat="products", unroll=True), adapters)[1]

    jaxpr = jax.make_jaxpr(residuals)(adapters, frozen).jaxpr
    shapes = {v.aval.shape for v in jaxpr.outvars if v not in jaxpr.invars}
    assert (1, TOKENS, INNER) in shapes
    weights = {leaf.shape[1:] for leaf in jax.tree.leaves((adapters, frozen))}
    assert not shapes & weights
    gradient = jax.make_jaxpr(jax.grad(loss_of(graphdef, frozen, unroll=True)))(adapters)
    assert "dynamic_update_slice" not in str(gradient)


def test_marked_values_are_saved_instead_of_their_matmuls():
    class Sum(nnx.Module):
        def __init__(self, *, rngs):
            self.first, self.second = Dense(WIDTH, INNER, rngs=rngs), Dense(WIDTH, INNER, rngs=rngs)

        def __call__(self, x, mark):
            return x + jnp.cos(mark(self.first(x) + self.second(x))).sum(-1, keepdims=True)

    blocks = stack(lambda rngs: Sum(rngs=rngs), DEPTH, nnx.Rngs(0))

    def saved_count(mark):
        run = lambda x: scan_depth(blocks, lambda b, x, _: (b(x, mark), None), x, remat="products")  # noqa: E731
        residuals = jax.eval_shape(lambda x: jax.vjp(run, x)[1], jnp.ones((1, TOKENS, WIDTH)))
        return sum(leaf.shape[-2:] == (TOKENS, INNER) for leaf in jax.tree.leaves(residuals))

    assert (saved_count(lambda x: x), saved_count(save_for_backward)) == (2, 1)


@pytest.mark.parametrize("unroll", [False, True])
def test_a_stack_without_trainable_parameters(unroll):
    blocks, x = Net().blocks, jnp.ones((1, TOKENS, WIDTH))
    run = lambda x: scan_depth(blocks, lambda block, x, _: (block(x), None), x, unroll=unroll)[0]  # noqa: E731
    expected = x
    for i in range(DEPTH):
        graphdef, state = nnx.split(blocks)
        expected = nnx.merge(graphdef, jax.tree.map(lambda a, i=i: a[i], state))(expected)
    np.testing.assert_allclose(run(x), expected, rtol=1e-5, atol=1e-5)


def test_the_fused_kernel_runs_once_forward_and_once_backward():
    method = WithFusedKernel(rank=16, hidden_width=16)
    make = lambda rngs: Dense(WIDTH, WIDTH, method=method, rngs=rngs)  # noqa: E731
    blocks = nnx.eval_shape(lambda: stack(make, DEPTH, nnx.Rngs(0)))
    graphdef, adapters, frozen = adaptation.split(blocks)

    def loss(adapters, frozen):
        layer = lambda block, x, _: block(x, return_aux=True)  # noqa: E731
        blocks = nnx.merge(graphdef, adapters, frozen)
        return scan_depth(blocks, layer, jnp.ones((1, 16, WIDTH)), remat="products")[0].sum()

    assert primitives(jax.grad(loss), adapters, frozen).count("custom_vmap_call") == 2


def test_inputs_of_unstacked_layers_may_be_split_before():
    """In any part of a pytree."""
    scales, shifts = jnp.arange(1.0, 1 + DEPTH), {"by": [jnp.arange(2.0 * DEPTH).reshape(DEPTH, 2)]}

    @jax.jit
    def run(scales, shifts):
        call = lambda block, x, inputs: (block(x) * inputs[0], inputs[1]["by"][0].sum())  # noqa: E731
        halves = {True: ByLayer.of, False: lambda value: value}
        return [
            scan_depth(unstack(NET.blocks), call, X, (halves[a](scales), halves[b](shifts), None))
            for a, b in itertools.product((False, True), repeat=2)
        ]

    expected, *others = run(scales, shifts)
    for found in others:
        jax.tree.map(np.testing.assert_array_equal, found, expected)
