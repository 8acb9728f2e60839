"""What the backbones share: norms, calls of dense layers, rotary positions and masks."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.adapters.layers import prepared
from lorasp_jax.dense import Dense, dense_together
from lorasp_jax.peft import Aux

LayerAux = dict[str, Aux]

QKV = ("q_proj", "k_proj", "v_proj")
"""Layers of an attention that read one input."""


def normalized(x: jax.Array, eps: float) -> jax.Array:
    """x / sqrt(mean(x^2) + eps) over the last axis, in fp32."""
    wide = x.astype(jnp.float32)
    return wide * jax.lax.rsqrt(jnp.mean(jnp.square(wide), axis=-1, keepdims=True) + eps)


class RMSNorm(nnx.Module):
    """x / sqrt(mean(x^2) + eps) * (offset + scale) in fp32, back in the type of x.

    Gemma stores its factor minus one (offset 1), other models the factor itself (offset 0).
    """

    def __init__(
        self,
        width: int,
        *,
        eps: float = 1e-6,
        offset: float = 1.0,
        param_dtype: Any = jnp.float32,
    ) -> None:
        self.scale = nnx.Param(jnp.full((width,), 1 - offset, param_dtype))
        self.eps = eps
        self.offset = offset

    def __call__(self, x: jax.Array) -> jax.Array:
        """x `[..., D]`."""
        factor = self.offset + self.scale.get_value().astype(jnp.float32)
        return (normalized(x, self.eps) * factor).astype(x.dtype)


class AdaptiveRMSNorm(nnx.Module):
    """RMSNorm with a factor, an offset and a gate from a condition, as pi0.5 has them ("adaRMS").

        y = x / sqrt(mean(x^2) + eps) * (1 + scale) + shift
        scale, shift, gate = split(dense(condition))

    The gate multiplies the residual branch that reads y. The dense layer starts at zero, and so
    do the branches (openpi, models/gemma.py).
    """

    def __init__(self, width: int, *, dtype: Any, param_dtype: Any, rngs: nnx.Rngs) -> None:
        kinds = {"dtype": dtype, "param_dtype": param_dtype, "rngs": rngs}
        self.dense = Dense(width, 3 * width, kernel_init=nnx.initializers.zeros, **kinds)
        self.eps = 1e-6

    def __call__(self, x: jax.Array, modulation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """y and the gate.

        Args:
            x: `[B, T, D]`.
            modulation: `[B, 1, 3 D]`, what `dense` made of the condition.

        Returns:
            `[B, T, D]` and `[B, 1, D]`, in the type of x.
        """
        scale, shift, gate = jnp.split(modulation.astype(jnp.float32), 3, axis=-1)
        y = normalized(x, self.eps) * (1 + scale) + shift
        return y.astype(x.dtype), gate.astype(x.dtype)


class LayerNorm(nnx.Module):
    """(x - mean) / sqrt(variance + eps) * scale + bias in fp32, back in the type of x."""

    def __init__(self, width: int, *, eps: float = 1e-6, param_dtype: Any = jnp.float32) -> None:
        self.scale = nnx.Param(jnp.ones((width,), param_dtype))
        self.bias = nnx.Param(jnp.zeros((width,), param_dtype))
        self.eps = eps

    def __call__(self, x: jax.Array) -> jax.Array:
        """x `[..., D]`."""
        wide = x.astype(jnp.float32)
        wide = wide - jnp.mean(wide, axis=-1, keepdims=True)
        wide = wide * jax.lax.rsqrt(jnp.mean(jnp.square(wide), axis=-1, keepdims=True) + self.eps)
        scale, bias = self.scale.get_value(), self.bias.get_value()
        return (wide * scale.astype(jnp.float32) + bias.astype(jnp.float32)).astype(x.dtype)


class Linears:
    """Calls the dense layers of one module by name and keeps what their adapters report.

    Attributes:
        aux: report of each layer called so far, by name.
    """

    def __init__(self, module: nnx.Module, token_mask: jax.Array | None) -> None:
        self.aux: LayerAux = {}
        self._module = module
        self._token_mask = token_mask

    def __call__(self, name: str, x: jax.Array) -> jax.Array:
        """y of the layer `name` for x `[B, T, I]`."""
        return self.together((name,), x)[0]

    def together(self, names: tuple[str, ...], x: jax.Array) -> list[jax.Array]:
        """y of each layer for the same x `[B, T, I]`, which adapters of `Dense` read once."""
        found = prepared.call(self._module, names, x, self._token_mask)
        if others := [name for name in names if name not in found]:
            found |= zip(others, self._together(others, x), strict=True)
        self.aux |= {name: found[name][1] for name in names}
        return [found[name][0] for name in names]

    def _together(self, names: list[str], x: jax.Array) -> list[tuple[jax.Array, Aux]]:
        layers = [getattr(self._module, name) for name in names]
        inputs = [layer.as_input(x) for layer in layers if type(layer) is Dense]
        mask = self._token_mask
        if len(inputs) < len(layers) or len({x.dtype for x in inputs}) > 1:
            return [layer(x, token_mask=mask, return_aux=True) for layer in layers]
        return dense_together(inputs[0], [layer.arrays() for layer in layers], token_mask=mask)

    def norm(self, name: str, x: jax.Array, condition: jax.Array | None) -> tuple[jax.Array, Any]:
        """y of the norm `name` for x `[B, T, D]`, and what multiplies the branch that reads it.

        An adaptive norm reads a condition `[B, 1, D]` and has a gate `[B, 1, D]`; others have 1.
        """
        norm = getattr(self._module, name)
        if condition is None:
            return norm(x), 1
        linear = Linears(norm, jnp.ones(condition.shape[:2], bool))
        modulation = linear("dense", condition)
        self.aux |= {f"{name}/{layer}": aux for layer, aux in linear.aux.items()}
        return norm(x, modulation)


def positions(valid: jax.Array) -> jax.Array:
    """`[B, T]` int32 positions that count valid tokens; padding repeats the last one."""
    return jnp.cumsum(valid, axis=-1, dtype=jnp.int32) - 1


def block_mask(
    query_block: np.ndarray, key_block: np.ndarray, query_valid: jax.Array, key_valid: jax.Array
) -> jax.Array:
    """Who sees whom: keys of the same block and of earlier ones, valid tokens only.

    Args:
        query_block: `[T]` int, number of the block each query token belongs to.
        key_block: `[S]` int.
        query_valid: `[B, T]` bool.
        key_valid: `[B, S]` bool.

    Returns:
        `[B, T, S]` bool.
    """
    order = key_block[None, :] <= query_block[:, None]
    return jnp.asarray(order) & query_valid[:, :, None] & key_valid[:, None, :]


def rope_table(position: jax.Array, head_dim: int) -> tuple[jax.Array, jax.Array]:
    """Sine and cosine, f32 `[B, T, 1, H/2]`, of position / 10000^(2i/H) (arXiv 2104.09864)."""
    wavelength = 10_000.0 ** (np.arange(0, head_dim, 2, dtype=np.float32) / head_dim)
    angle = position[:, :, None, None].astype(jnp.float32) / wavelength
    return jnp.sin(angle), jnp.cos(angle)


def rope(x: jax.Array, table: tuple[jax.Array, jax.Array], scale: float = 1.0) -> jax.Array:
    """Rotate the two halves of each head of x `[B, T, N, H]` in fp32, times `scale`."""
    sin, cos = table
    first, second = jnp.split(x.astype(jnp.float32), 2, axis=-1)
    turned = [first * cos - second * sin, second * cos + first * sin]
    return (scale * jnp.concatenate(turned, axis=-1)).astype(x.dtype)


def time_embedding(flow_time: jax.Array, width: int) -> jax.Array:
    """`[B, width]` f32: sines, then cosines, of `[B]` times at periods from 4e-3 to 4.

    Periods: openpi, src/openpi/models/pi0.py, `create_sinusoidal_pos_embedding`.
    """
    period = 4e-3 * (4.0 / 4e-3) ** np.linspace(0, 1, width // 2)
    angle = flow_time[:, None].astype(jnp.float32) * (2 * math.pi / period).astype(np.float32)
    return jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], axis=-1)
