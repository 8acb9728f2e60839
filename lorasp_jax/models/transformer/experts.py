"""Experts that share attention: a mixture of transformers (pi0, arXiv 2410.24164).

In each layer, action tokens attend to the language expert's keys and values and to their own.
Language tokens never attend to action tokens. The language expert therefore runs first, and the
action expert uses its cached keys and values, in training as in sampling.
"""

import functools
import math
from typing import Any

import jax
from flax import nnx

from lorasp_jax.adapters.layers.prepared import Layer
from lorasp_jax.dense import Dense
from lorasp_jax.kernels.cached_attention import KeysValues
from lorasp_jax.kernels.rematerialization import save_for_backward
from lorasp_jax.models.config import BackboneConfig, ExpertConfig
from lorasp_jax.models.transformer.attention import attention
from lorasp_jax.models.transformer.depth import ByLayer, scan_depth, stack
from lorasp_jax.models.transformer.layers import (
    AdaptiveRMSNorm,
    LayerAux,
    Norm,
    RMSNorm,
    apply_to_shared_input,
    nest_aux,
    rope,
    rope_table,
)


class ExpertBlock(nnx.Module):
    """One Gemma layer (arXiv 2403.08295): RMS norms, rotary grouped-query attention, GeGLU.

    The layer has no biases. Subclasses may override the norm and the activation.
    """

    shared_inputs: tuple[tuple[str, ...], ...] = (
        ("q_proj", "k_proj", "v_proj"),
        ("gate_proj", "up_proj"),
    )
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
        """`context` is the input width of k_proj and v_proj; None means `size.width`."""
        options: dict[str, Any] = {
            "use_bias": False,
            "dtype": config.dtype,
            "param_dtype": config.param_dtype,
            "rngs": rngs,
        }
        width, inner, context = size.width, size.heads * size.head_dim, context or size.width
        self.head_dim = size.head_dim
        self.input_layernorm: Norm = self.make_norm(width, param_dtype=config.param_dtype)
        self.q_proj: Layer = Dense(width, inner, **options)
        self.k_proj: Layer = Dense(context, size.kv_heads * size.head_dim, **options)
        self.v_proj: Layer = Dense(context, size.kv_heads * size.head_dim, **options)
        self.o_proj: Layer = Dense(inner, width, **options)
        self.post_attention_layernorm: Norm = self.make_norm(width, param_dtype=config.param_dtype)
        self.gate_proj: Layer = Dense(width, size.mlp, **options)
        self.up_proj: Layer = Dense(width, size.mlp, **options)
        self.down_proj: Layer = Dense(size.mlp, width, **options)

    def __call__(
        self,
        x: jax.Array,
        table: tuple[jax.Array, jax.Array],
        mask: jax.Array,
        cache: KeysValues | None,
        token_mask: jax.Array,
        condition: jax.Array | None = None,
    ) -> tuple[jax.Array, tuple[KeysValues, LayerAux]]:
        """Apply the layer.

        Args:
            x: `[B, T, D]`.
            table: RoPE sine and cosine for these tokens, from `rope_table`.
            mask: see `attention`; the keys are the cached ones, followed by this layer's.
            cache: keys and values of preceding tokens, or None (S = 0).
            token_mask: `[B, T]` bool, False excludes a token from aux.
            condition: `[B, 1, D]` or `[B, T, D]` for adaptive norms, or None.

        Returns:
            x, and a pair: this layer's keys and values, and the adapters' aux.
        """
        h, gate, norm_aux = self.input_layernorm.normalize(x, condition)
        qkv = {"q_proj": self.q_proj, "k_proj": self.k_proj, "v_proj": self.v_proj}
        projected, aux = apply_to_shared_input(h, token_mask, **qkv)
        q, k, v = (y.reshape(*x.shape[:2], -1, self.head_dim) for y in projected)
        q, k = rope(q, table, scale=self.head_dim**-0.5), rope(k, table)
        k, v = save_for_backward(k), save_for_backward(v)
        attended = attention(q, k, v, mask, cache)
        x, mlp_aux = self.output_and_mlp(x, attended, token_mask, gate, condition)
        return x, ((k, v), aux | nest_aux("input_layernorm", norm_aux) | mlp_aux)

    def output_and_mlp(
        self,
        x: jax.Array,
        attended: jax.Array,
        token_mask: jax.Array,
        gate: jax.Array | int = 1,
        condition: jax.Array | None = None,
    ) -> tuple[jax.Array, LayerAux]:
        """Add the output projection of attention `[B, T, N H]` and the gated MLP to x `[B, T, D]`.

        `gate` multiplies the attention branch; see `AdaptiveRMSNorm`.
        """
        y, o_aux = self.o_proj(attended, token_mask=token_mask, return_aux=True)
        x = x + gate * y
        h, gate, norm_aux = self.post_attention_layernorm.normalize(x, condition)
        gate_up = {"gate_proj": self.gate_proj, "up_proj": self.up_proj}
        (mlp_gate, up), aux = apply_to_shared_input(h, token_mask, **gate_up)
        h = self.activation(mlp_gate) * up
        y, aux["down_proj"] = self.down_proj(h, token_mask=token_mask, return_aux=True)
        aux |= {"o_proj": o_aux, **nest_aux("post_attention_layernorm", norm_aux)}
        return x + gate * y, aux


class Expert(nnx.Module):
    """A stack of layers and a final norm."""

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
        cache: KeysValues | ByLayer | None = None,
        *,
        token_mask: jax.Array,
        condition: jax.Array | None = None,
    ) -> tuple[jax.Array, KeysValues, LayerAux]:
        """Apply all layers and the final norm.

        Args:
            x: `[B, T, D]`.
            position: `[B, T]` int32.
            mask: see `attention`; the keys are the cached ones, followed by this expert's.
            cache: keys and values `[L, B, S, K, H]` of preceding tokens, or None (S = 0).
            token_mask: `[B, T]` bool, False excludes a token from aux.
            condition: `[B, 1, D]` or `[B, T, D]` for adaptive norms, or None.

        Returns:
            `[B, T, D]`, this expert's keys and values `[L, B, T, K, H]`, and the adapters' aux,
            stacked over layers.
        """
        table = rope_table(position, self.head_dim)
        x, (keys_values, aux) = scan_depth(
            self.blocks,
            lambda block, x, cache: block(x, table, mask, cache, token_mask, condition),
            x.astype(self.config.dtype),
            cache,
            remat=self.config.remat,
            unroll=self.config.unroll_layers,
        )
        x, _, norm_aux = self.norm.normalize(x, condition)
        return x, keys_values, aux | nest_aux("norm", norm_aux)


class AdaptiveBlock(ExpertBlock):
    """A layer with adaptive norms."""

    def __init__(self, size: ExpertConfig, config: BackboneConfig, *, rngs: nnx.Rngs) -> None:
        super().__init__(size, config, rngs=rngs)
        self.input_layernorm = adaptive_norm(size, config, rngs)
        self.post_attention_layernorm = adaptive_norm(size, config, rngs)


class AdaptiveExpert(Expert):
    """An expert with adaptive norms, such as pi0.5's action expert."""

    block = AdaptiveBlock

    def __init__(self, size: ExpertConfig, config: BackboneConfig, *, rngs: nnx.Rngs) -> None:
        super().__init__(size, config, rngs=rngs)
        self.norm = adaptive_norm(size, config, rngs)


def adaptive_norm(size: ExpertConfig, config: BackboneConfig, rngs: nnx.Rngs) -> AdaptiveRMSNorm:
    """Create an adaptive norm with the width of an expert."""
    options = {"dtype": config.dtype, "param_dtype": config.param_dtype, "rngs": rngs}
    return AdaptiveRMSNorm(size.width, **options)


class LanguageExpert(Expert):
    """An expert with a token embedding."""

    def __init__(self, size: ExpertConfig, config: BackboneConfig, *, rngs: nnx.Rngs) -> None:
        super().__init__(size, config, rngs=rngs)
        shape = (config.vocabulary, size.width)
        draw = jax.random.normal(rngs.params(), shape, config.param_dtype)
        self.embedding = nnx.Param(draw * size.width**-0.5)

    def embed(self, tokens: jax.Array) -> jax.Array:
        """Embed tokens `[B, T]` int32 as `[B, T, D]`, scaled by sqrt(D)."""
        table = self.embedding.get_value()
        return (table[tokens] * math.sqrt(table.shape[-1])).astype(self.config.dtype)
