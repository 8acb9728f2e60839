"""Properties of every adapter method. New files in `peft/` are tested automatically."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax import peft
from tests.models.random_models import with_noise
from tests.nets import small

D_IN, D_OUT, RANK = 6, 10, 12  # the rank exceeds both widths
# Cannot be merged, unlike every other method.
INPUT_DEPENDENT = (peft.LoRASP, peft.LoRASPRelease, peft.LoRAMoE)
# alpha differs from the rank
SMALL = {"rank": RANK, "target_rank": 6, "hidden_width": 4, "alpha": 5.0, "experts": 2}


@pytest.fixture(params=peft.names())
def method(request):
    return small(request.param, SMALL)


@pytest.fixture
def kernel():
    return np.random.default_rng(1).normal(size=(D_IN, D_OUT)).astype("f")


@pytest.fixture
def x():
    return np.random.default_rng(2).normal(size=(2, 5, D_IN)).astype("f")


@functools.partial(jax.jit, static_argnums=0)
def apply(method, params, x, kernel):
    return method.apply(params, x, kernel)


@functools.partial(jax.jit, static_argnums=0)
def delta(method, params, x):
    return method.delta(params, x)


@functools.partial(jax.jit, static_argnums=0)
def initial(method, key, kernel):
    return method.init(key, kernel)[0]


@functools.partial(jax.jit, static_argnums=0)
def scaled_loss_gradients(method, params, x, kernel, size):
    def loss(params):
        y, aux = method.apply(params, size * x, kernel)
        return y.mean() / size + sum(aux.losses.values()), (y, aux.losses)

    return jax.grad(loss, has_aux=True)(params)


def trained(method, kernel):
    """Parameters away from their initial values, so that all are nonzero."""
    return with_noise(initial(method, jax.random.key(3), kernel), 0.3)


def test_initially_equals_the_base(method, kernel, x):
    params = initial(method, jax.random.key(0), kernel)
    y, _ = apply(method, params, x, kernel)
    np.testing.assert_allclose(y, x @ kernel, rtol=1e-5, atol=1e-5)
    if method.additive:
        np.testing.assert_array_equal(delta(method, params, x)[0], 0)


@pytest.mark.parametrize("size", [1e15, 1e25, 1e35])
def test_huge_inputs(method, kernel, x, size):
    """If the base layer's output is finite, so are the adapted output, losses and gradients."""
    params = initial(method, jax.random.key(0), kernel)
    gradients, (y, losses) = scaled_loss_gradients(method, params, x, kernel, size)
    np.testing.assert_allclose(y, size * x @ kernel, rtol=1e-5, atol=1e-5 * size)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((losses, gradients)))
    y, _ = apply(method, trained(method, kernel), size * x, kernel)
    assert np.isfinite(y).all()


def test_init_depends_only_on_key_and_shape(method, kernel):
    if not method.additive:
        pytest.skip("initialized from the kernel's values")
    params = initial(method, jax.random.key(0), kernel)
    shape = jax.ShapeDtypeStruct(kernel.shape, jnp.bfloat16)
    again = jax.jit(lambda key: method.init(key, shape)[0])(jax.random.key(0))
    other = initial(method, jax.random.key(1), kernel)

    def equal(a, b):
        return all(jax.tree.leaves(jax.tree.map(np.array_equal, a, b)))

    assert equal(params, again)
    assert not equal(params, other)
    assert {leaf.dtype for leaf in jax.tree.leaves(params)} == {jnp.dtype("float32")}


def test_apply_is_base_plus_delta(method, kernel, x):
    params = trained(method, kernel)
    y, aux = apply(method, params, x, kernel)
    assert y.shape == (2, 5, D_OUT)
    if method.additive:
        expected = x @ kernel + np.asarray(delta(method, params, x)[0])
        np.testing.assert_allclose(y, expected, rtol=1e-5, atol=1e-5)
    for per_token in (aux.active_rank, aux.kept_energy):
        assert per_token is None or (per_token.shape, per_token.dtype) == ((2, 5), jnp.float32)
    if aux.active_rank is not None:
        assert aux.active_rank.max() <= method.largest_active_rank
    assert all(v.shape == () and v.dtype == jnp.float32 for v in aux.losses.values())


def test_merge_equals_apply_or_suggests_an_alternative(method, kernel, x):
    params = trained(method, kernel)
    if isinstance(method, INPUT_DEPENDENT):
        with pytest.raises(ValueError, match=r"cannot be merged .* (distill it|keep the adapter)"):
            method.merge(params, kernel)
        return
    merged = jax.jit(method.merge)(params, kernel)
    np.testing.assert_allclose(
        x @ np.asarray(merged), apply(method, params, x, kernel)[0], atol=1e-4
    )
    assert jax.eval_shape(method.merge, params, kernel.astype(jnp.bfloat16)).dtype == jnp.bfloat16


def test_bfloat16(method, kernel, x):
    """bf16 input and kernel give a bf16 output; parameters, aux and gradients stay fp32."""
    params = initial(method, jax.random.key(0), kernel)

    def loss(params, x, kernel):
        y, aux = method.apply(params, x, kernel)
        assert y.dtype == jnp.bfloat16
        assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(aux))
        return y.sum()

    half = (x.astype(jnp.bfloat16), kernel.astype(jnp.bfloat16))
    gradients = jax.eval_shape(jax.grad(loss), params, *half)
    assert {leaf.dtype for leaf in jax.tree.leaves(gradients)} == {jnp.dtype("float32")}


def test_transformations_agree(method, kernel, x):
    params = trained(method, kernel)

    def loss(params, x):
        y, aux = method.apply(params, x, kernel)
        return jnp.sum(y**2) + sum(aux.losses.values()), y

    @jax.jit
    def all_transformations(params, x):
        gradient = jax.grad(loss, has_aux=True)
        scanned = jax.lax.scan(lambda _, row: (None, gradient(params, row)), None, x)[1]
        mapped = jax.vmap(gradient, in_axes=(None, 0))(params, x)
        remat = jax.vmap(jax.grad(jax.checkpoint(loss), has_aux=True), (None, 0))(params, x)
        return scanned, mapped, remat

    scanned, *others = all_transformations(params, x)
    for other in others:
        for a, b in zip(jax.tree.leaves(scanned), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4 * float(np.abs(a).max()))
    eager, _ = method.apply(params, x, kernel)
    np.testing.assert_allclose(scanned[1], eager, rtol=1e-4, atol=1e-4)


def test_padding_is_ignored(method, kernel, x):
    """Losses, gradients and statistics over valid tokens do not depend on padding."""
    params = trained(method, kernel)
    mask = np.arange(5)[None] < np.array([[3], [4]])

    @jax.jit
    def run(params, x):
        def loss(params):
            y, aux = method.apply(params, x, kernel, token_mask=mask)
            task = jnp.where(mask[..., None], y, 0).sum()
            return task + sum(aux.losses.values()), (aux.losses, aux.mean_active_rank())

        return jax.value_and_grad(loss, has_aux=True)(params)

    clean, padded = run(params, x), run(params, np.where(mask[..., None], x, np.float32(1e3)))
    for a, b in zip(jax.tree.leaves(clean), jax.tree.leaves(padded), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


def test_requires_a_matrix(method):
    if not method.trains_base:
        with pytest.raises(
            ValueError, match=r"needs a floating-point kernel \[I, O\], got float32 \[2, 3, 4\]"
        ):
            method.init(jax.random.key(0), jnp.zeros((2, 3, 4)))


def test_create_by_file_name(method):
    assert peft.create(method.name) == type(method)()
    assert hash(method) == hash(dataclasses.replace(method))


def test_unknown_names():
    with pytest.raises(
        ValueError,
        match=r"did you mean 'lora_sp'.*valid methods are ada_lora, dora, full, lora, lora_moe, ",
    ):
        peft.create("lora_ps")
