"""SmolVLA's experts: SmolLM2 (arXiv 2502.02737), and an action expert that uses SmolLM2's cache.

Even layers of the action expert attend to the language model's keys and values and to their own, as
in pi0. Odd layers use cross-attention: they attend only to projections of the language model's keys
and values in the same layer. Action tokens do not attend to each other there.
"""

import functools

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.models.config import BackboneConfig, ExpertConfig
from lorasp_jax.models.transformer.attention import attention
from lorasp_jax.models.transformer.depth import ByLayer, scan_depth, stack
from lorasp_jax.models.transformer.experts import ExpertBlock, KeysValues, LanguageExpert
from lorasp_jax.models.transformer.layers import (
    LayerAux,
    RMSNorm,
    nest_aux,
    positions,
    rope,
    rope_table,
)


class SelfBlock(ExpertBlock):
    """One SmolLM2 layer: like Gemma's, but with SiLU, and norms with offset 0."""

    make_norm = staticmethod(functools.partial(RMSNorm, eps=1e-5, offset=0.0))
    activation = staticmethod(jax.nn.silu)


class CrossBlock(SelfBlock):
    """Cross-attention layer of the action expert."""

    shared_inputs = (("gate_proj", "up_proj"),)  # q_proj has another input than k_proj and v_proj

    def __init__(self, size: ExpertConfig, config: BackboneConfig, *, rngs: nnx.Rngs) -> None:
        super().__init__(size, config, context=size.kv_heads * size.head_dim, rngs=rngs)

    def project_cache(self, cache: KeysValues, valid: jax.Array) -> tuple[KeysValues, LayerAux]:
        """Compute this layer's keys and values `[B, P, K, H]` from the language model's.

        The language model's keys already include RoPE.
        """
        aux: LayerAux = {}
        keys, values = cache
        flat = (*keys.shape[:2], -1)
        k, aux["k_proj"] = self.k_proj(keys.reshape(flat), token_mask=valid, return_aux=True)
        k = k.reshape(keys.shape)
        v, aux["v_proj"] = self.v_proj(values.reshape(flat), token_mask=valid, return_aux=True)
        return (k, v.reshape(values.shape)), aux

    def attend(
        self,
        x: jax.Array,
        table: tuple[jax.Array, jax.Array],
        mask: jax.Array,
        keys_values: KeysValues,
        token_mask: jax.Array,
    ) -> tuple[jax.Array, LayerAux]:
        """Apply the layer to x.

        Args:
            x: `[B, T, D]`.
            table: RoPE sine and cosine for these tokens, from `rope_table`.
            mask: `[B, T, P]` bool.
            keys_values: from `project_cache`.
            token_mask: `[B, T]` bool, False excludes a token from aux.
        """
        h, *_ = self.input_layernorm.normalize(x, None)
        q, q_aux = self.q_proj(h, token_mask=token_mask, return_aux=True)
        q = q.reshape(*x.shape[:2], -1, self.head_dim)
        q = rope(q, table, scale=self.head_dim**-0.5)
        x, aux = self.output_and_mlp(x, attention(q, *keys_values, mask), token_mask)
        return x, {"q_proj": q_aux, **aux}


class SmolLM2(LanguageExpert):
    """SmolLM2. Actions do not depend on `lm_head`, which is loaded only to be saved again."""

    block = SelfBlock

    def __init__(self, size: ExpertConfig, config: BackboneConfig, *, rngs: nnx.Rngs) -> None:
        super().__init__(size, config, rngs=rngs)
        self.lm_head = nnx.Param(jnp.array(self.embedding.get_value()))  # a copy of the buffer


class LayerPair(nnx.Module):
    """A self-attention layer and a cross-attention layer of the action expert."""

    def __init__(self, size: ExpertConfig, config: BackboneConfig, *, rngs: nnx.Rngs) -> None:
        self.self_layer = SelfBlock(size, config, rngs=rngs)
        self.cross_layer = CrossBlock(size, config, rngs=rngs)


class ActionExpert(nnx.Module):
    """Alternating self-attention and cross-attention layers, and a final norm."""

    def __init__(self, size: ExpertConfig, config: BackboneConfig, *, rngs: nnx.Rngs) -> None:
        self.config = config
        self.head_dim = size.head_dim
        self.blocks = stack(lambda rngs: LayerPair(size, config, rngs=rngs), size.depth // 2, rngs)
        self.norm = SelfBlock.make_norm(size.width, param_dtype=config.param_dtype)

    def project_cache(
        self, cache: KeysValues, valid: jax.Array
    ) -> tuple[KeysValues, KeysValues, LayerAux]:
        """Compute the prefix keys and values of all layers, once per observation.

        Args:
            cache: keys and values `[L, B, P, K, H]` of the language model.
            valid: `[B, P]` bool.

        Returns:
            Keys and values `[L / 2, B, P, K, H]` for the self-attention layers, those for the
            cross-attention layers, and the adapters' aux.
        """
        even, odd = (jax.tree.map(lambda a, i=i: a[i::2], cache) for i in (0, 1))
        pairs = self.blocks
        _, (cross, aux) = scan_depth(
            nnx.List([pair.cross_layer for pair in pairs])
            if isinstance(pairs, nnx.List)  # from `unstack`
            else pairs.cross_layer,
            lambda block, valid, cache: (valid, block.project_cache(cache, valid)),
            valid,
            odd,
            remat=self.config.remat,
            unroll=self.config.unroll_layers,
        )
        return even, cross, nest_aux("cross_layer", aux)

    def __call__(
        self,
        x: jax.Array,
        position: jax.Array,
        mask: jax.Array,
        cache: KeysValues | ByLayer,
        cross: KeysValues | ByLayer,
        *,
        token_mask: jax.Array,
    ) -> tuple[jax.Array, LayerAux]:
        """Apply all layers and the final norm.

        Args:
            x: `[B, T, D]`.
            position: `[B, T]` int32, continuing the prefix's, for self-attention layers.
                Cross-attention layers number these tokens from zero.
            mask: `[B, T, P + T]` bool.
            cache: prefix keys and values for self-attention, from `project_cache`.
            cross: prefix keys and values for cross-attention, from `project_cache`.
            token_mask: `[B, T]` bool, False excludes a token from aux.

        Returns:
            `[B, T, D]`, and the adapters' aux, stacked over layer pairs.
        """
        self_table = rope_table(position, self.head_dim)
        cross_table = rope_table(positions(jnp.ones(x.shape[:2], bool)), self.head_dim)
        prefix_mask = mask[:, :, : -x.shape[1]]

        def call(
            pair: LayerPair, x: jax.Array, prefix: tuple[KeysValues, KeysValues]
        ) -> tuple[jax.Array, LayerAux]:
            cache, cross = prefix
            x, (_, self_aux) = pair.self_layer(x, self_table, mask, cache, token_mask)
            x, cross_aux = pair.cross_layer.attend(x, cross_table, prefix_mask, cross, token_mask)
            return x, nest_aux("self_layer", self_aux) | nest_aux("cross_layer", cross_aux)

        x, aux = scan_depth(
            self.blocks,
            call,
            x.astype(self.config.dtype),
            (cache, cross),
            remat=self.config.remat,
            unroll=self.config.unroll_layers,
        )
        return self.norm(x), aux
