"""Test DoRA against Hugging Face PEFT and its formula."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.peft.dora import DoRA
from tests.models.random_models import with_noise
from tests.peft.test_lora import HF_NAMES, assert_close, assert_equals_hugging_face, load

D_IN, D_OUT, RANK = 6, 10, 3
METHOD = DoRA(rank=RANK, alpha=5.0)
KERNEL = np.random.default_rng(1).normal(size=(D_IN, D_OUT)).astype("f")
X = np.random.default_rng(2).normal(size=(2, 5, D_IN)).astype("f")


def trained(method=METHOD, kernel=KERNEL):
    """Parameters away from their initial values, including B and the magnitude."""
    return with_noise(jax.jit(method.init)(jax.random.key(3), kernel)[0], 0.3)


def test_equals_hugging_face():
    names = HF_NAMES | {"magnitude": "lora_magnitude_vector"}
    golden, kernels, params, gradients = load("lora_dora", names)
    methods = [DoRA(rank=8, alpha=16)] * 3
    assert_equals_hugging_face(golden, methods, kernels, params, gradients)
    for kernel, recorded in zip(kernels, params, strict=True):  # PEFT's magnitudes are initial
        initial = jax.jit(methods[0].init)(jax.random.key(0), kernel)[0]
        assert_close(initial["magnitude"], recorded["magnitude"], 1e-6)


def test_initial_magnitude_is_the_column_norm():
    kernel = jnp.array([[3.0, 0.0], [4.0, 2.0], [0.0, 0.0]], jnp.bfloat16)
    magnitude = METHOD.init(jax.random.key(0), kernel)[0]["magnitude"]
    np.testing.assert_array_equal(magnitude, [5, 2])
    assert magnitude.dtype == jnp.float32


@pytest.mark.parametrize("stabilized", [False, True])
def test_formula_with_a_constant_norm(stabilized):
    """Output and gradients equal those of x (W + s A B) m / n with constant n."""
    method = DoRA(rank=RANK, alpha=5.0, rank_stabilized=stabilized)
    params = trained(method)
    scale = 5 / RANK ** (0.5 if stabilized else 1)

    def adapted(params):
        return KERNEL + scale * params["lora_a"] @ params["lora_b"]

    exact = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), params)
    norm = np.sqrt(np.square(adapted(exact)).sum(0)).astype(np.float32)

    def formula(params, x):
        y = x @ adapted(params) * params["magnitude"] / norm
        return (y**3).sum(), y

    def ours(params, x):
        y, _ = method.apply(params, x, KERNEL)
        return (y**3).sum(), y

    functions = [jax.value_and_grad(f, argnums=(0, 1), has_aux=True) for f in (formula, ours)]
    expected, actual = jax.jit(lambda params, x: [f(params, x) for f in functions])(params, X)
    jax.tree.map(lambda a, b: assert_close(a, b, 1e-5), actual, expected)


def test_kernel_has_no_gradient():
    params = trained()
    gradient = jax.jit(jax.grad(lambda kernel: METHOD.apply(params, X, kernel)[0].sum()))
    np.testing.assert_array_equal(gradient(KERNEL), 0)


def test_bfloat16():
    """bf16 input and kernel give a bf16 output and fp32 gradients, close to those in fp32."""
    params = trained()
    x, kernel = X.astype(jnp.bfloat16), KERNEL.astype(jnp.bfloat16)

    def loss(params, x, kernel):
        y, _ = METHOD.apply(params, x, kernel)
        return jnp.square(y.astype(jnp.float32)).sum(), y

    run = jax.jit(jax.grad(loss, has_aux=True))
    gradients, y = run(params, x, kernel)
    expected_gradients, expected = run(params, x.astype("f"), kernel.astype("f"))
    assert y.dtype == jnp.bfloat16
    assert {leaf.dtype for leaf in gradients.values()} == {jnp.dtype("float32")}
    assert_close(np.asarray(y, "f"), expected, 0.02)
    jax.tree.map(lambda a, b: assert_close(a, b, 0.03), gradients, expected_gradients)


def test_factor_is_not_rounded_to_bfloat16():
    """Rounded to bf16, a factor of 1.003 would become 1 and change no output."""
    method, kernel = DoRA(rank=1), np.ones((1, 1), jnp.bfloat16)
    params, _ = jax.jit(method.init)(jax.random.key(0), kernel)
    params["magnitude"] = np.float32(1.003) * np.asarray(params["magnitude"])
    x = np.linspace(1, 2, 129)[:, None].astype(jnp.bfloat16)
    y, _ = jax.jit(method.apply)(params, x, kernel)
    assert y.dtype == jnp.bfloat16
    assert (np.asarray(y) > x).mean() > 0.5


def test_zero_kernel_can_learn():
    """Columns without direction (0 / 0) give 0. B learns first, then the magnitude."""
    kernel = np.zeros((D_IN, D_OUT), "f")
    params, _ = jax.jit(METHOD.init)(jax.random.key(0), kernel)

    @jax.jit
    @functools.partial(jax.grad, has_aux=True)
    def loss_gradient(params):
        y, _ = METHOD.apply(params, X, kernel)
        return (y - 1).sum(), y

    gradient, y = loss_gradient(params)
    np.testing.assert_array_equal(y, 0)
    np.testing.assert_array_equal(gradient["magnitude"], 0)
    assert np.any(gradient["lora_b"])
    params = jax.tree.map(lambda p, g: p - np.float32(0.1) * np.asarray(g), params, gradient)
    assert np.all(loss_gradient(params)[0]["magnitude"])


def test_requires_kernel_values():
    shape = jax.ShapeDtypeStruct((D_IN, D_OUT), jnp.float32)
    with pytest.raises(ValueError, match=r"from the kernel's values, got only the shape \(6, 10\)"):
        METHOD.init(jax.random.key(0), shape)
    shapes, _ = jax.eval_shape(METHOD.init, jax.random.key(0), shape)  # the kernel is a tracer here
    assert {name: leaf.shape for name, leaf in shapes.items()} == {
        "lora_a": (D_IN, RANK),
        "lora_b": (RANK, D_OUT),
        "magnitude": (D_OUT,),
    }


def test_has_no_delta():
    with pytest.raises(ValueError, match="DoRA is not additive and has no delta; use apply"):
        METHOD.delta(trained(), X)
