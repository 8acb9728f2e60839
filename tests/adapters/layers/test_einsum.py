"""Compare adapted einsums with einsums of kernels that the tests merge manually."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.adapters.layers.einsum import (
    einsum,
    from_matrices,
    general_equation,
    parse,
    to_matrices,
)
from lorasp_jax.peft import LoRA, LoRASP

METHOD = LoRA(rank=3, alpha=5.0)
run = jax.jit(einsum, static_argnums=(0, 5))


def normal(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@pytest.mark.parametrize(
    ("equation", "x", "kernel", "matrices", "delta"),
    [
        ("...i,io->...o", (2, 3, 4), (4, 5), (4, 5), "ir,ro->io"),
        ("btd,ndh->btnh", (2, 3, 4), (5, 4, 6), (4, 30), "dr,rnh->ndh"),
        ("btnh,nhd->btd", (2, 3, 5, 6), (5, 6, 4), (30, 4), "nhr,rd->nhd"),
        ("bsd,ckdh->cbskh", (2, 3, 4), (2, 5, 4, 6), (4, 60), "dr,rckh->ckdh"),
        ("e b d, e f d -> b e f", (2, 3, 4), (2, 5, 4), (2, 4, 5), "edr,erf->efd"),
        ("...d,d->...", (2, 3, 4), (4,), (4, 1), "dr,r->d"),
    ],
)
def test_equals_the_einsum_of_the_merged_kernel(equation, x, kernel, matrices, delta):
    x, kernel = normal(0, *x), normal(1, *kernel)
    stacked = to_matrices(equation, kernel)
    assert stacked.shape == matrices
    np.testing.assert_array_equal(from_matrices(equation, stacked, kernel.shape), kernel)
    *stack, d_in, d_out = matrices
    a, b = normal(2, *stack, d_in, 3), normal(3, *stack, 3, d_out)
    sizes = dict(zip(parse(equation).kernel, kernel.shape, strict=True)) | {"r": 3}
    left, right = delta.split("->")[0].split(",")
    factors = [v.reshape([sizes[c] for c in part]) for part, v in ((left, a), (right, b))]
    merged = kernel + 5 / 3 * np.einsum(delta, *factors)
    y, aux = run(equation, x, kernel, None, {"lora_a": a, "lora_b": b}, METHOD)
    np.testing.assert_allclose(y, np.einsum(equation, x, merged), rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(aux.active_rank, 3)
    without_adapter, _ = run(equation, x, kernel)
    np.testing.assert_allclose(
        without_adapter, np.einsum(equation, x, kernel), rtol=1e-5, atol=1e-5
    )


def test_kernels_of_a_scanned_stack():
    kernel = normal(0, 7, 5, 4, 6)
    stacked = to_matrices("btd,ndh->btnh", kernel)
    np.testing.assert_array_equal(stacked[2], to_matrices("btd,ndh->btnh", kernel[2]))
    np.testing.assert_array_equal(from_matrices("btd,ndh->btnh", stacked, kernel.shape), kernel)


@pytest.mark.slow
def test_bias_and_losses_over_batch_axes():
    """One adapter per expert; losses are averaged over experts."""
    method, x, kernel = LoRASP(rank=8, hidden_width=4), normal(0, 3, 2, 4), normal(1, 3, 4, 5)
    keys = jax.random.split(jax.random.key(2), 3)
    params, _ = jax.vmap(method.init)(keys, kernel)
    bias = normal(3, 3, 5)
    y, aux = einsum("ebd,edf->bef", x, kernel, bias, params, method)
    expert_params = [jax.tree.map(lambda v, e=e: v[e], params) for e in range(3)]
    separate = [method.apply(expert_params[e], x[e], kernel[e]) for e in range(3)]
    np.testing.assert_allclose(
        y, jnp.stack([y for y, _ in separate], 1) + bias, rtol=1e-5, atol=1e-5
    )
    expected = np.mean([aux.losses["spectral"] for _, aux in separate])
    np.testing.assert_allclose(aux.losses["spectral"], expected, rtol=1e-5)
    assert aux.active_rank.shape == (3, 2)


@pytest.mark.parametrize(
    ("axis", "batch", "outputs", "shape"),
    [
        ((-1,), (), 2, (2, 3, 4)),
        ((-1, -2), (), 1, (2, 3, 4)),
        ((1, -1), (), 1, (2, 3, 4, 5)),
        ((-3, -1), (), 1, (2, 3, 4, 5)),
        ((1,), (), 2, (2, 3, 4)),
        ((-1,), (0,), 1, (2, 3, 4)),
        ((2,), (0, 1), 1, (2, 3, 4, 5)),
    ],
)
def test_general_equations_match_dot_general(axis, batch, outputs, shape):
    x, positive = normal(0, *shape), sorted(a % len(shape) for a in axis)
    inner = [shape[b] for b in batch] + [shape[a] for a in positive]
    kernel = normal(1, *inner, *(6, 7)[:outputs])
    contracted = tuple(range(len(batch), len(inner)))
    dims = ((tuple(positive), contracted), (batch, tuple(range(len(batch)))))
    expected = jax.lax.dot_general(x, kernel, dims)
    y, _ = run(general_equation(axis, batch, outputs), x, kernel)
    np.testing.assert_allclose(y, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    "equation",
    ["ab,bc", "ab,bc,cd->ad", "ab,bc->a", "aab,bc->ac", "...b,bc->c", "ab,...bc->ac"],
)
def test_unsupported_equations(equation):
    with pytest.raises(ValueError, match="cannot be adapted: it must be explicit, 'x,kernel->y'"):
        parse(equation)


def test_mismatched_shapes():
    with pytest.raises(
        ValueError, match=r"shapes \(2, 3\) and \(4, 5\) do not match the equation 'ab,bc->ac'"
    ):
        einsum("ab,bc->ac", normal(0, 2, 3), normal(1, 4, 5))
    with pytest.raises(ValueError, match="input with 3 axes does not match the equation ab,bc->ac"):
        einsum("ab,bc->ac", normal(0, 1, 2, 3), normal(1, 3, 5))
