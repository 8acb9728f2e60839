"""`low_rank_matmul` equals its formula and computes no gradient for W."""

import dataclasses
import math
import re
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.kernels.low_rank_matmul import Bottleneck, LowRankLayer, low_rank_matmul

# (I, O), every code path for 10 tokens: output wider, more than twice as wide, square, input wider;
# then I above the number of tokens, where nothing is concatenated.
SHAPES = [(9, 10), (6, 20), (10, 10), (10, 7), (12, 30)]
DOWN, RANK = 4, 3


@pytest.fixture(autouse=True)
def full_precision(monkeypatch):
    """Avoid TF32 on GPU, and take the GPU's code path, which concatenates matrices, on CPU too."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with jax.default_matmul_precision("highest"):
        yield


def inner(params, rows, token_mask):
    """Nonlinear f with R < Q, a loss and a statistic."""
    rows = rows if token_mask is None else jnp.where(token_mask[..., None], rows, 0)
    z = jnp.tanh(rows[..., :RANK] * params["scale"]) * rows[..., RANK:]
    return z, {"loss": jnp.square(rows).mean(), "statistic": rows.max(-1)}


@dataclasses.dataclass(frozen=True)
class Method(Bottleneck):
    """An f."""

    bottleneck: Callable = inner


def inputs(d_in, d_out, dtype=jnp.float32):
    rng = np.random.default_rng(0)
    shapes = [(2, 5, d_in), (d_in, d_out), (d_in, DOWN), (RANK, d_out)]
    x, kernel, down, up = (rng.normal(size=shape).astype(np.float32) for shape in shapes)
    scale = np.full(RANK, 0.3, np.float32)
    return {"scale": scale}, x.astype(dtype), kernel.astype(dtype), down, up


MASK = np.arange(10).reshape(2, 5) != 3


def ours(params, x, kernel, down, up, mask=MASK):
    layers = [LowRankLayer(params, kernel, down, up)]
    return low_rank_matmul(Method(), x.dtype, layers, x, mask)[0]


def reference(params, x, kernel, down, up, mask=MASK):
    z, aux = inner(params, x @ down, mask)
    return x @ kernel + z @ up, aux


def loss_of(function):
    def loss(params, x, kernel, down, up):
        y, aux = function(params, x, kernel, down, up)
        return jnp.sum(jnp.sin(y)) + 0.7 * aux["loss"], aux

    return loss


@pytest.mark.parametrize("shape", SHAPES)
def test_equals_the_formula(shape):
    def value_and_grad(function):
        return jax.value_and_grad(jax.checkpoint(loss_of(function)), (0, 1, 3, 4), has_aux=True)

    run = jax.jit(lambda *a: [value_and_grad(function)(*a) for function in (ours, reference)])
    actual, expected = run(*inputs(*shape))
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)
        assert np.linalg.norm(b) > 0


@pytest.mark.parametrize("d_outs", [(4, 3), (12, 9), (30, 20, 3)])
def test_several_layers_with_one_input(d_outs):
    """Every way to compute the gradient of x: one matmul, separate matmuls, through [W; U]."""
    params, x, *_ = inputs(9, 1)
    layers = [LowRankLayer(params, *inputs(9, d_out)[2:]) for d_out in d_outs]

    def grouped(params, x, layers):
        layers = [layer._replace(params=p) for p, layer in zip(params, layers, strict=True)]
        return low_rank_matmul(Method(), x.dtype, layers, x, MASK)

    def separate(params, x, layers):
        return [reference(p, x, *layer[1:]) for p, layer in zip(params, layers, strict=True)]

    def value_and_grad(apply):
        def loss(params, x, layers):
            outputs = apply(params, x, layers)
            total = sum(jnp.sum(jnp.sin((i + 1) * y)) for i, (y, _) in enumerate(outputs))
            return total + sum(0.3 * i * aux["loss"] for i, (_, aux) in enumerate(outputs)), outputs

        (_, outputs), gradients = jax.value_and_grad(loss, (0, 1, 2), has_aux=True)(
            [{"scale": params["scale"] * (i + 1)} for i in range(len(layers))], x, layers
        )
        d_params, dx, d_layers = gradients
        return outputs, d_params, dx, [layer[2:] for layer in d_layers]

    run = jax.jit(value_and_grad, static_argnums=0)
    actual, expected = run(grouped), run(separate)
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-3)


def test_several_layers_share_the_down_projection():
    params, x, *_ = inputs(9, 1)
    layers = [LowRankLayer(params, *inputs(9, d_out)[2:]) for d_out in (4, 3, 2)]
    program = jax.make_jaxpr(lambda x: low_rank_matmul(Method(), x.dtype, layers, x, MASK))(x)
    matmuls = [line for line in str(program).splitlines() if "dot_general" in line]
    assert len(matmuls) == 1 + 3 * 2  # x P; x W and z U of each


@pytest.mark.parametrize("shape", SHAPES)
def test_no_gradient_of_the_kernel(shape):
    """No matmul in the gradient's jaxpr has the shape of W, so its gradient is never computed."""
    arguments = inputs(*shape)

    def gradient(function):
        return jax.grad(loss_of(function), argnums=(2, 3), has_aux=True)

    def program(function):
        return str(jax.make_jaxpr(gradient(function))(*arguments))

    d_in, d_out = shape
    sides = rf"({d_in}|{d_in + RANK}|{d_out})"
    matmul = rf"f32\[{sides},{sides}\] = dot_general"
    assert not re.search(matmul, program(ours))
    assert re.search(matmul, program(reference))
    np.testing.assert_array_equal(jax.jit(gradient(ours))(*arguments)[0][0], 0)


def test_dtypes():
    """y has the dtype of x, gradients of fp32 matrices are fp32, rows have `rows_dtype`."""
    arguments = inputs(6, 10, jnp.bfloat16)
    y, aux = jax.eval_shape(ours, *arguments)
    assert (y.dtype, aux["statistic"].dtype) == (jnp.bfloat16, jnp.bfloat16)
    gradient = jax.grad(loss_of(ours), argnums=(1, 3, 4), has_aux=True)
    dx, d_down, d_up = jax.eval_shape(gradient, *arguments)[0]
    assert (dx.dtype, d_down.dtype, d_up.dtype) == (jnp.bfloat16, jnp.float32, jnp.float32)
    params, x, *matrices = arguments
    layers = [LowRankLayer(params, *matrices)]
    exact = jax.jit(lambda x: low_rank_matmul(Method(), jnp.float32, layers, x, MASK)[0])
    expected = x.astype(np.float32) @ matrices[1].astype(jnp.bfloat16).astype(np.float32)
    statistic = exact(x)[1]["statistic"]
    assert statistic.dtype == jnp.float32
    np.testing.assert_allclose(statistic[0, 0], expected[0, 0].max(), rtol=1e-5)


def test_vmap():
    params, x, *matrices = inputs(6, 10)
    run = jax.jit(jax.vmap(lambda x, mask: ours(params, x, *matrices, mask)[0]))
    expected = jax.jit(reference)(params, x, *matrices)[0]
    np.testing.assert_allclose(run(x, MASK), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("shape", [(9, 20), (10, 10), (10, 7), (12, 30), (12, 12), (12, 7)])
def test_kernels_are_concatenated_only_for_many_tokens(shape):
    params, x, *rest = inputs(*shape)

    def gradients(*arrays):
        y, vjp = jax.vjp(lambda *a: ours(*a)[0], *arrays)
        return vjp(y)

    program = str(jax.make_jaxpr(gradients)(params, x, *rest))
    concatenated = re.findall(r"f32\[(\d+),(\d+)\] = concatenate", program)
    copies = [sides for sides in concatenated if math.prod(map(int, sides)) > math.prod(shape)]
    assert bool(copies) == (shape[0] <= 10)


def test_no_concatenated_kernels_on_cpu(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    jax.clear_caches()  # drop traces for the GPU
    program = str(jax.make_jaxpr(lambda *a: jax.vjp(ours, *a)[0])(*inputs(9, 20)))
    assert "dot_general" in program
    assert not re.search(r"f32\[\d+,20\] = concatenate", program)


def counted():
    """A list that grows with each trace of an f, and this f."""
    calls = []

    def counting(params, rows, token_mask):
        calls.append(rows.shape)
        return inner(params, rows, token_mask)

    return calls, Method(counting)


def test_equal_layers_are_traced_once():
    calls, f = counted()
    params, x, *rest = inputs(9, 9)

    def loss(params, x, depth):
        for _ in range(depth):
            ((x, aux),) = low_rank_matmul(f, x.dtype, [LowRankLayer(params, *rest)], x, MASK)
        return x.sum() + aux["loss"]

    num_traces = []
    for depth in (2, 6):  # at least 2: the first layer needs no gradient of its input
        jax.clear_caches()
        calls.clear()
        jax.jit(jax.grad(loss), static_argnums=2).lower(params, x, depth)
        num_traces.append(len(calls))
    assert num_traces[0] == num_traces[1]


def test_layers_of_other_shapes_share_the_traced_bottleneck():
    calls, f = counted()

    def loss(params, shapes):
        total = 0.0
        for shape in shapes:
            _, x, *rest = inputs(*shape)
            ((y, aux),) = low_rank_matmul(f, x.dtype, [LowRankLayer(params, *rest)], x, MASK)
            total += y.sum() + aux["loss"]
        return total

    num_traces = []
    for shapes in (SHAPES[:1], SHAPES):
        jax.clear_caches()
        calls.clear()
        jax.make_jaxpr(lambda params, shapes=shapes: jax.grad(loss)(params, shapes))(
            inputs(1, 1)[0]
        )
        num_traces.append(len(calls))
    assert num_traces[0] == num_traces[1] > 0
