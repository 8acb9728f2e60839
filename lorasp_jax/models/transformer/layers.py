"""What the backbones share: norms, layers that read one input, rotary positions and masks."""

import math
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.adapters.layers.prepared import Layer, Prepared, join_one
from lorasp_jax.dense import Dense, dense_shared_input
from lorasp_jax.peft import Aux

LayerAux = dict[str, Aux]
"""Adapters' reports by layer name."""
ModelAux = dict[str, LayerAux]
"""Adapters' reports by tower ("vision", "language", "action") and layer name."""


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

    def conditioned(
        self, x: jax.Array, condition: jax.Array | None
    ) -> tuple[jax.Array, int, LayerAux]:
        """What `AdaptiveRMSNorm.conditioned` returns, without a condition and with a gate of 1."""
        del condition
        return self(x), 1, {}


class AdaptiveRMSNorm(nnx.Module):
    """RMSNorm with a factor, an offset and a gate from a condition, as pi0.5 has them ("adaRMS").

        y = x / sqrt(mean(x^2) + eps) * (1 + scale) + shift
        scale, shift, gate = split(dense(condition))

    The gate multiplies the residual branch that reads y. The dense layer starts at zero, and so
    do the branches (openpi, models/gemma.py).
    """

    def __init__(self, width: int, *, dtype: Any, param_dtype: Any, rngs: nnx.Rngs) -> None:
        kinds = {"dtype": dtype, "param_dtype": param_dtype, "rngs": rngs}
        self.dense: Layer = Dense(width, 3 * width, kernel_init=nnx.initializers.zeros, **kinds)
        self.eps = 1e-6

    def join_layers(self, *, copy_kernels: bool = True) -> None:
        """See `prepared.JoinsLayers`."""
        self.dense = join_one(self.dense, copy_kernels=copy_kernels)

    def conditioned(
        self, x: jax.Array, condition: jax.Array | None
    ) -> tuple[jax.Array, jax.Array, LayerAux]:
        """y, the gate and the adapter's report.

        Args:
            x: `[B, T, D]`.
            condition: `[B, 1, D]`.

        Returns:
            `[B, T, D]` and `[B, 1, D]` in the type of x, and the report of `dense`.
        """
        assert condition is not None  # whoever has such norms makes one
        every = jnp.ones(condition.shape[:2], bool)
        modulation, aux = self.dense(condition, token_mask=every, return_aux=True)
        scale, shift, gate = jnp.split(modulation.astype(jnp.float32), 3, axis=-1)
        y = normalized(x, self.eps) * (1 + scale) + shift
        return y.astype(x.dtype), gate.astype(x.dtype), {"dense": aux}


Norm: TypeAlias = RMSNorm | AdaptiveRMSNorm


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


def together(
    x: jax.Array, token_mask: jax.Array | None, **layers: Layer
) -> tuple[list[jax.Array], LayerAux]:
    """Layers that read the same x `[B, T, I]`, which adapters of `Dense` then read once.

    Args:
        x: `[B, T, I]`.
        token_mask: `[B, T]` bool, what the adapters count; None counts all.
        layers: by name, in the order in which they were joined if they are joined.

    Returns:
        y `[B, T, O]` of each layer, and the adapters' reports by name.
    """
    plain = [layer for layer in layers.values() if type(layer) is Dense]
    inputs = [layer.cast_input(x) for layer in plain]
    fused = []
    if len({x.dtype for x in inputs}) == 1:
        fused = dense_shared_input(
            inputs[0], [one.arrays() for one in plain], token_mask=token_mask
        )
    of_plain, found = iter(fused), []
    for layer in layers.values():
        if isinstance(layer, Prepared):
            found += layer.results(x, token_mask)
        elif fused and type(layer) is Dense:
            found.append(next(of_plain))
        else:
            found.append(layer(x, token_mask=token_mask, return_aux=True))
    ys, reports = zip(*found, strict=True)
    return list(ys), dict(zip(layers, reports, strict=True))


def under(name: str, aux: LayerAux) -> LayerAux:
    """Reports of the layers of a module called `name`, by their path from its parent on."""
    return {f"{name}/{layer}": report for layer, report in aux.items()}


def with_action(aux: ModelAux, action: LayerAux) -> ModelAux:
    """Reports with those of the action expert's steps next to what it did in the prefix."""
    return {**aux, "action": {**aux.get("action", {}), **action}}


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
