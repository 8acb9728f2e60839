"""What an adapted layer leaves for the backward pass under each policy."""

import jax
import jax.numpy as jnp
import pytest

from lorasp_jax.kernels.quantized_weights import quantize_kernel
from lorasp_jax.kernels.rematerialization import save_narrow_products, save_products
from lorasp_jax.peft import LoRA, LoRASP
from tests.jaxprs import target

TOKENS, WIDTH = 8192, 2048


def saved(policy, columns, *, method, float8):
    """Number of arrays as large as the layer's output that the backward pass keeps."""
    kernel = jnp.zeros((WIDTH, columns), jnp.bfloat16)
    params, _ = jax.eval_shape(lambda: method.init(jax.random.key(0), kernel))

    def residuals(params, x):
        w = quantize_kernel(kernel, "float8") if float8 else kernel

        def block(params, x):
            y, _ = method.apply(params, x, w)
            return jnp.cos(jnp.square(y)).sum()

        return jax.vjp(jax.checkpoint(block, policy=policy), params, x)[1]

    with target("cuda"):
        x = jax.ShapeDtypeStruct((TOKENS, WIDTH), jnp.bfloat16)
        leaves = jax.tree.leaves(jax.eval_shape(residuals, params, x))
    return sum(leaf.shape == (TOKENS, columns) for leaf in leaves)


@pytest.mark.parametrize("float8", [False, True])
@pytest.mark.parametrize("method", [LoRA(rank=8), LoRASP(rank=8)])
@pytest.mark.parametrize("columns", [1024, 3 * WIDTH])
def test_an_output_is_kept_once_or_not_at_all(columns, method, float8):
    """Not as its parts x W and z U, which would take twice the memory; and never if it is wide."""
    options = {"method": method, "float8": float8}
    assert saved(save_products, columns, **options) == 1
    assert saved(save_narrow_products, columns, **options) == (columns == 1024)
    assert saved(None, columns, **options) == 0
