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

from lorasp_jax.dense import Dense
from lorasp_jax.models.config import BackboneConfig, ExpertConfig
from lorasp_jax.models.transformer.attention import attention
from lorasp_jax.models.transformer.depth import scan_depth, stack, stored
from lorasp_jax.models.transformer.layers import (
    QKV,
    AdaptiveRMSNorm,
    LayerAux,
    Linears,
    RMSNorm,
    rope,
    rope_table,
)

KeysValues = tuple[jax.Array, jax.Array]
"""Keys after the rotation and values, each `[B, S, K, H]`, or `[L, B, S, K, H]` for all layers."""


GATED = ("gate_proj", "up_proj")


class ExpertBlock(nnx.Module):
    """One Gemma layer (arXiv 2403.08295): RMS norms, rotary grouped-query attention, GeGLU.

    There are no biases. Subclasses have other norms and activations.
    """

    together = (QKV, GATED)
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
        self.input_layernorm = self.make_norm(width, param_dtype=config.param_dtype)
        self.q_proj = Dense(width, inner, **kinds)
        self.k_proj = Dense(context, size.kv_heads * size.head_dim, **kinds)
        self.v_proj = Dense(context, size.kv_heads * size.head_dim, **kinds)
        self.o_proj = Dense(inner, width, **kinds)
        self.post_attention_layernorm = self.make_norm(width, param_dtype=config.param_dtype)
        self.gate_proj = Dense(width, size.mlp, **kinds)
        self.up_proj = Dense(width, size.mlp, **kinds)
        self.down_proj = Dense(size.mlp, width, **kinds)

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
        linear = Linears(self, token_mask)
        heads = (*x.shape[:2], -1, self.head_dim)
        h, branch = linear.norm("input_layernorm", x, condition)
        read = linear.together(QKV, h)
        q, k, v = (y.reshape(heads) for y in read)
        q, k = rope(q, table, scale=self.head_dim**-0.5), rope(k, table)
        keys, values = k, v = stored(k), stored(v)
        if cache is not None:
            keys = jnp.concatenate([cache[0], k], axis=1)
            values = jnp.concatenate([cache[1], v], axis=1)
        attended = attention(q, keys, values, mask)
        return self.finish(linear, x, attended, branch, condition), ((k, v), linear.aux)

    def finish(
        self,
        linear: Linears,
        x: jax.Array,
        attended: jax.Array,
        branch: jax.Array | int = 1,
        condition: jax.Array | None = None,
    ) -> jax.Array:
        """x `[B, T, D]` after the attention's result `[B, T, N H]` and the gated MLP.

        `branch` multiplies what the attention adds, see `Linears.norm`.
        """
        x = x + branch * linear("o_proj", attended)
        h, branch = linear.norm("post_attention_layernorm", x, condition)
        gate, up = linear.together(GATED, h)
        return x + branch * linear("down_proj", self.activation(gate) * up)


class Expert(nnx.Module):
    """A stack of layers with its final norm."""

    block = ExpertBlock

    def __init__(self, size: ExpertConfig, config: BackboneConfig, *, rngs: nnx.Rngs) -> None:
        self.config = config
        self.head_dim = size.head_dim
        self.blocks = stack(lambda rngs: self.block(size, config, rngs=rngs), size.depth, rngs)
        self.norm = self.block.make_norm(size.width, param_dtype=config.param_dtype)

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
            unroll=self.config.straight_line,
        )
        linear = Linears(self, None)
        x, _ = linear.norm("norm", x, condition)
        return x, own, aux | linear.aux


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
