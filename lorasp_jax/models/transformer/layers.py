"""Components shared by the backbones: norms, layers with a shared input, RoPE and masks."""

import math
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.adapters.layers.prepared import Layer, Prepared
from lorasp_jax.dense import Dense, cast_input, dense_shared_input
from lorasp_jax.peft import Aux

LayerAux = dict[str, Aux]
"""The adapters' aux (losses and statistics) by layer name."""
ModelAux = dict[str, LayerAux]
"""The adapters' aux by tower ("vision", "language", "action") and layer name."""


def rms_normalize(x: jax.Array, eps: float) -> jax.Array:
    """Compute x / sqrt(mean(x^2) + eps) over the last axis, in fp32."""
    x = x.astype(jnp.float32)
    return x * jax.lax.rsqrt(jnp.mean(jnp.square(x), axis=-1, keepdims=True) + eps)


class RMSNorm(nnx.Module):
    """x / sqrt(mean(x^2) + eps) * (offset + scale), computed in fp32, returned in the dtype of x.

    Gemma stores the factor minus one (offset 1); other models store the factor itself (offset 0).
    """

    def __init__(
        self,
        width: int,
        *,
        eps: float = 1e-6,
        offset: float = 1.0,
        param_dtype: Any = jnp.float32,
    ) -> None:
        self.scale: nnx.Param[jax.Array] = nnx.Param(jnp.full((width,), 1 - offset, param_dtype))
        self.eps = eps
        self.offset = offset

    def __call__(self, x: jax.Array) -> jax.Array:
        """Normalize x `[..., D]`."""
        factor = self.offset + self.scale.get_value().astype(jnp.float32)
        return (rms_normalize(x, self.eps) * factor).astype(x.dtype)

    def normalize(
        self, x: jax.Array, condition: jax.Array | None
    ) -> tuple[jax.Array, int, LayerAux]:
        """Like `AdaptiveRMSNorm.normalize`, but unconditional: gate 1 and no aux."""
        del condition
        return self(x), 1, {}


class AdaptiveRMSNorm(nnx.Module):
    """RMSNorm with scale, shift and gate computed from a condition, called "adaRMS" in pi0.5.

        y = x / sqrt(mean(x^2) + eps) * (1 + scale) + shift
        scale, shift, gate = split(dense(condition))

    The gate multiplies the output of the residual branch whose input is y. The dense layer is
    initialized to zero, so the branches initially contribute nothing (openpi, models/gemma.py).
    """

    def __init__(self, width: int, *, dtype: Any, param_dtype: Any, rngs: nnx.Rngs) -> None:
        options = {"dtype": dtype, "param_dtype": param_dtype, "rngs": rngs}
        self.dense: Layer = Dense(width, 3 * width, kernel_init=nnx.initializers.zeros, **options)
        self.eps = 1e-6

    def normalize(
        self, x: jax.Array, condition: jax.Array | None
    ) -> tuple[jax.Array, jax.Array, LayerAux]:
        """Compute y and the gate.

        Args:
            x: `[B, T, D]`.
            condition: `[B, 1, D]`, or `[B, T, D]` with one condition per token.

        Returns:
            y `[B, T, D]` and the gate, shaped like the condition, in the dtype of x, and the aux
            of `dense`.
        """
        assert condition is not None  # models with adaptive norms always pass one
        valid = jnp.ones(condition.shape[:2], bool)
        modulation, aux = self.dense(condition, token_mask=valid, return_aux=True)
        scale, shift, gate = jnp.split(modulation.astype(jnp.float32), 3, axis=-1)
        y = rms_normalize(x, self.eps) * (1 + scale) + shift
        return y.astype(x.dtype), gate.astype(x.dtype), {"dense": aux}


Norm: TypeAlias = RMSNorm | AdaptiveRMSNorm


class LayerNorm(nnx.Module):
    """(x - mean) / sqrt(variance + 1e-6) * scale + bias, in fp32, returned in the dtype of x."""

    def __init__(self, width: int, *, param_dtype: Any = jnp.float32) -> None:
        self.scale: nnx.Param[jax.Array] = nnx.Param(jnp.ones((width,), param_dtype))
        self.bias: nnx.Param[jax.Array] = nnx.Param(jnp.zeros((width,), param_dtype))

    def __call__(self, x: jax.Array) -> jax.Array:
        """Normalize x `[..., D]`."""
        h = x.astype(jnp.float32)
        h = h - jnp.mean(h, axis=-1, keepdims=True)
        h = h * jax.lax.rsqrt(jnp.mean(jnp.square(h), axis=-1, keepdims=True) + 1e-6)
        scale, bias = self.scale.get_value(), self.bias.get_value()
        return (h * scale.astype(jnp.float32) + bias.astype(jnp.float32)).astype(x.dtype)


def apply_to_shared_input(
    x: jax.Array, token_mask: jax.Array | None, **layers: Layer
) -> tuple[list[jax.Array], LayerAux]:
    """Apply layers to the same input; the adapters of `Dense` layers share one matmul with x.

    Args:
        x: `[B, T, I]`.
        token_mask: `[B, T]` bool, False excludes a token from aux.
        layers: the layers by name. Fused layers must come in the order in which they were fused.

    Returns:
        y `[B, T, O]` of each layer, and the adapters' aux by layer name.
    """
    dense = [layer for layer in layers.values() if type(layer) is Dense]
    fused = []
    if len({layer.dtype for layer in dense}) == 1:
        arrays = [layer.arrays() for layer in dense]
        kernel = arrays[0].kernel
        x_cast = cast_input(dense[0].dtype, x, kernel, token_mask, kernel.shape[0])
        fused = dense_shared_input(x_cast, arrays, token_mask=token_mask)
    fused_results, results = iter(fused), []
    for layer in layers.values():
        if isinstance(layer, Prepared):
            results += layer.results(x, token_mask)
        elif fused and type(layer) is Dense:
            results.append(next(fused_results))
        else:
            results.append(layer(x, token_mask=token_mask, return_aux=True))
    ys, aux = zip(*results, strict=True)
    return list(ys), dict(zip(layers, aux, strict=True))


def nest_aux(module: str, aux: LayerAux) -> LayerAux:
    """Prepend a module's name to the layer names."""
    return {f"{module}/{layer}": layer_aux for layer, layer_aux in aux.items()}


def merge_action_aux(aux: ModelAux, action: LayerAux) -> ModelAux:
    """Add the aux of the flow steps to the "action" aux of the prefix."""
    return {**aux, "action": {**aux.get("action", {}), **action}}


def positions(valid: jax.Array) -> jax.Array:
    """Number the valid tokens from 0, `[B, T]` int32; padding repeats the previous number."""
    return jnp.cumsum(valid, axis=-1, dtype=jnp.int32) - 1


def valid_first(x: jax.Array, valid: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return x `[B, T, D]` and valid `[B, T]` with the valid tokens first, in their own order."""
    order = jnp.argsort(~valid, axis=1, stable=True)

    def permute(x: jax.Array, order: jax.Array) -> jax.Array:
        # Unique indices: the backward pass stores gradients instead of adding them atomically.
        return x.at[order].get(unique_indices=True, mode="promise_in_bounds")

    return jax.vmap(permute)(x, order), jax.vmap(permute)(valid, order)


def block_mask(
    query_block: np.ndarray, key_block: np.ndarray, query_valid: jax.Array, key_valid: jax.Array
) -> jax.Array:
    """Create a mask: valid queries attend to valid keys of their own and earlier token blocks.

    Each token's block has a number: `query_block` is `[T]`, `key_block` `[S]`, and the mask
    `[B, T, S]`.
    """
    order = key_block[None, :] <= query_block[:, None]
    return jnp.asarray(order) & query_valid[:, :, None] & key_valid[:, None, :]


def rope_table(position: jax.Array, head_dim: int) -> tuple[jax.Array, jax.Array]:
    """Compute RoPE's sine and cosine of position / 10000^(2i/H) (arXiv 2104.09864).

    For positions `[B, T]` and heads of width H, both are `[B, T, 1, H/2]` f32.
    """
    wavelength = 10_000.0 ** (np.arange(0, head_dim, 2, dtype=np.float32) / head_dim)
    angle = position[:, :, None, None].astype(jnp.float32) / wavelength
    return jnp.sin(angle), jnp.cos(angle)


def rope(x: jax.Array, table: tuple[jax.Array, jax.Array], scale: float = 1.0) -> jax.Array:
    """Apply RoPE to x `[B, T, N, H]` in fp32 and multiply by `scale`.

    Element i of a head is rotated together with element i + H/2.
    """
    sin, cos = table
    first, second = jnp.split(x.astype(jnp.float32), 2, axis=-1)
    rotated = [first * cos - second * sin, second * cos + first * sin]
    return (scale * jnp.concatenate(rotated, axis=-1)).astype(x.dtype)


def time_embedding(flow_time: jax.Array, width: int) -> jax.Array:
    """Compute sinusoidal embeddings of flow times, with periods from 4e-3 to 4.

    Sines come first, then cosines. The periods match openpi's `create_sinusoidal_pos_embedding`
    (models/pi0.py).

    Returns:
        f32 `[B, 1, width]` for times `[B]`, `[B, C, width]` for times `[B, C]`.
    """
    period = 4e-3 * (4.0 / 4e-3) ** np.linspace(0, 1, width // 2)
    angle = flow_time[..., None].astype(jnp.float32) * (2 * math.pi / period).astype(np.float32)
    embedding = jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], axis=-1)
    return embedding[:, None] if flow_time.ndim == 1 else embedding
