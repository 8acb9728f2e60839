"""Experts that share attention: a mixture of transformers (pi0, arXiv 2410.24164).

An expert's tokens attend to the keys and values that earlier experts left for the same layer.
Since language tokens never see action tokens, the language expert runs first, whole, and the action
expert follows with its cache; training and sampling take the same path.
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.adapters.layers.prepared import Layer, join, join_one
from lorasp_jax.dense import Dense
from lorasp_jax.models.config import BackboneConfig, ExpertConfig
from lorasp_jax.models.transformer.attention import attention
from lorasp_jax.models.transformer.depth import scan_depth, stack, stored
from lorasp_jax.models.transformer.layers import (
    AdaptiveRMSNorm,
    LayerAux,
    Norm,
    RMSNorm,
    rope,
    rope_table,
    together,
    under,
)

KeysValues = tuple[jax.Array, jax.Array]
"""Keys after the rotation and values, each `[B, S, K, H]`, or `[L, B, S, K, H]` for all layers."""


class ExpertBlock(nnx.Module):
    """One Gemma layer (arXiv 2403.08295): RMS norms, rotary grouped-query attention, GeGLU.

    There are no biases. Subclasses have other norms and activations.
    """

    make_norm = staticmethod(RMSNorm)
    activation = staticmethod(functools.partial(jax.nn.gelu, approximate=True))

    def __init__(
        self,
        size: ExpertConfig,
        config: BackboneConfig,
        *,
        context: int | None = None,
        rngs: nnx.Rngs,
    ) -> None:
        """Draws the weights; keys and values are read from width `context`, its own by default."""
        kinds: dict[str, Any] = {
            "use_bias": False,
            "dtype": config.dtype,
            "param_dtype": config.param_dtype,
            "rngs": rngs,
        }
        width, inner, context = size.width, size.heads * size.head_dim, context or size.width
        self.head_dim = size.head_dim
        self.input_layernorm: Norm = self.make_norm(width, param_dtype=config.param_dtype)
        self.q_proj: Layer = Dense(width, inner, **kinds)
        self.k_proj: Layer = Dense(context, size.kv_heads * size.head_dim, **kinds)
        self.v_proj: Layer = Dense(context, size.kv_heads * size.head_dim, **kinds)
        self.o_proj: Layer = Dense(inner, width, **kinds)
        self.post_attention_layernorm: Norm = self.make_norm(width, param_dtype=config.param_dtype)
        self.gate_proj: Layer = Dense(width, size.mlp, **kinds)
        self.up_proj: Layer = Dense(width, size.mlp, **kinds)
        self.down_proj: Layer = Dense(size.mlp, width, **kinds)

    def join_layers(self, *, copy_kernels: bool = True) -> None:
        """See `prepared.JoinsLayers`."""
        qkv = self.q_proj, self.k_proj, self.v_proj
        self.q_proj, self.k_proj, self.v_proj = join(qkv, copy_kernels=copy_kernels)
        self.join_rest(copy_kernels=copy_kernels)

    def join_rest(self, *, copy_kernels: bool) -> None:
        """Joins what `finish` calls."""
        self.o_proj = join_one(self.o_proj, copy_kernels=copy_kernels)
        gated = self.gate_proj, self.up_proj
        self.gate_proj, self.up_proj = join(gated, copy_kernels=copy_kernels)
        self.down_proj = join_one(self.down_proj, copy_kernels=copy_kernels)

    def __call__(
        self,
        x: jax.Array,
        table: tuple[jax.Array, jax.Array],
        mask: jax.Array,
        cache: KeysValues | None,
        token_mask: jax.Array,
        condition: jax.Array | None = None,
    ) -> tuple[jax.Array, tuple[KeysValues, LayerAux]]:
        """One layer.

        Args:
            x: `[B, T, D]`.
            table: rotation of these tokens, from `rope_table`.
            mask: `[B, T, S + T]` bool over the cache's keys and the own ones, in this order.
            cache: keys and values of earlier tokens, or None (S = 0).
            token_mask: `[B, T]` bool, what the adapters count.
            condition: `[B, 1, D]` of adaptive norms, or None.

        Returns:
            x, then the own keys and values and the adapters' reports.
        """
        h, gate, norm_aux = self.input_layernorm.conditioned(x, condition)
        qkv = {"q_proj": self.q_proj, "k_proj": self.k_proj, "v_proj": self.v_proj}
        read, aux = together(h, token_mask, **qkv)
        q, k, v = (y.reshape(*x.shape[:2], -1, self.head_dim) for y in read)
        q, k = rope(q, table, scale=self.head_dim**-0.5), rope(k, table)
        keys, values = k, v = stored(k), stored(v)
        if cache is not None:
            keys = jnp.concatenate([cache[0], k], axis=1)
            values = jnp.concatenate([cache[1], v], axis=1)
        attended = attention(q, keys, values, mask)
        x, rest = self.finish(x, attended, token_mask, gate, condition)
        return x, ((k, v), aux | under("input_layernorm", norm_aux) | rest)

    def finish(
        self,
        x: jax.Array,
        attended: jax.Array,
        token_mask: jax.Array,
        gate: jax.Array | int = 1,
        condition: jax.Array | None = None,
    ) -> tuple[jax.Array, LayerAux]:
        """x `[B, T, D]` after the attention's result `[B, T, N H]` and the gated MLP.

        `gate` multiplies what the attention adds, see `AdaptiveRMSNorm`.
        """
        y, o_aux = self.o_proj(attended, token_mask=token_mask, return_aux=True)
        x = x + gate * y
        h, gate, norm_aux = self.post_attention_layernorm.conditioned(x, condition)
        gated = {"gate_proj": self.gate_proj, "up_proj": self.up_proj}
        (opened, up), aux = together(h, token_mask, **gated)
        h = self.activation(opened) * up
        y, aux["down_proj"] = self.down_proj(h, token_mask=token_mask, return_aux=True)
        aux |= {"o_proj": o_aux, **under("post_attention_layernorm", norm_aux)}
        return x + gate * y, aux


class Expert(nnx.Module):
    """A stack of layers with its final norm."""

    block = ExpertBlock

    def __init__(self, size: ExpertConfig, config: BackboneConfig, *, rngs: nnx.Rngs) -> None:
        self.config = config
        self.head_dim = size.head_dim
        self.blocks = stack(lambda rngs: self.block(size, config, rngs=rngs), size.depth, rngs)
        self.norm: Norm = self.block.make_norm(size.width, param_dtype=config.param_dtype)

    def __call__(
        self,
        x: jax.Array,
        position: jax.Array,
        mask: jax.Array,
        cache: KeysValues | None = None,
        *,
        token_mask: jax.Array,
        condition: jax.Array | None = None,
    ) -> tuple[jax.Array, KeysValues, LayerAux]:
        """All layers.

        Args:
            x: `[B, T, D]`.
            position: `[B, T]` int32.
            mask: `[B, T, S + T]` bool.
            cache: keys and values `[L, B, S, K, H]` of earlier tokens, or None (S = 0).
            token_mask: `[B, T]` bool.
            condition: `[B, 1, D]` of adaptive norms, or None.

        Returns:
            `[B, T, D]` after the final norm, the own keys and values `[L, B, T, K, H]`, and the
            adapters' reports, stacked over layers.
        """
        table = rope_table(position, self.head_dim)
        x, (own, aux) = scan_depth(
            self.blocks,
            lambda block, x, cache: block(x, table, mask, cache, token_mask, condition),
            x.astype(self.config.dtype),
            cache,
            remat=self.config.remat,
            unroll=self.config.unroll_layers,
        )
        x, _, norm_aux = self.norm.conditioned(x, condition)
        return x, own, aux | under("norm", norm_aux)


class AdaptiveBlock(ExpertBlock):
    """A layer whose norms follow a condition."""

    def __init__(self, size: ExpertConfig, config: BackboneConfig, *, rngs: nnx.Rngs) -> None:
        super().__init__(size, config, rngs=rngs)
        self.input_layernorm = adaptive_norm(size, config, rngs)
        self.post_attention_layernorm = adaptive_norm(size, config, rngs)


class AdaptiveExpert(Expert):
    """An expert whose norms follow a condition, pi0.5's for actions."""

    block = AdaptiveBlock

    def __init__(self, size: ExpertConfig, config: BackboneConfig, *, rngs: nnx.Rngs) -> None:
        super().__init__(size, config, rngs=rngs)
        self.norm = adaptive_norm(size, config, rngs)


def adaptive_norm(size: ExpertConfig, config: BackboneConfig, rngs: nnx.Rngs) -> AdaptiveRMSNorm:
    """A norm of an expert's tokens."""
    kinds = {"dtype": config.dtype, "param_dtype": config.param_dtype, "rngs": rngs}
    return AdaptiveRMSNorm(size.width, **kinds)


class LanguageExpert(Expert):
    """The expert that owns the token embedding."""

    def __init__(self, size: ExpertConfig, config: BackboneConfig, *, rngs: nnx.Rngs) -> None:
        super().__init__(size, config, rngs=rngs)
        shape = (config.vocabulary, size.width)
        draw = jax.random.normal(rngs.params(), shape, config.param_dtype)
        self.embedding = nnx.Param(draw * size.width**-0.5)

    def embed(self, tokens: jax.Array) -> jax.Array:
        """`[B, T]` int32 -> `[B, T, D]`, scaled by sqrt(D)."""
        table = self.embedding.get_value()
        return (table[tokens] * math.sqrt(table.shape[-1])).astype(self.config.dtype)
