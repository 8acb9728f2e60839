"""SmolVLA's experts: SmolLM2 (arXiv 2502.02737) and the action expert that reads its cache.

The action expert's even layers attend to the language model's keys and values next to their own, as
pi0's do. Its odd layers only look at the language model: they project the keys and values of its
layer of the same depth, and action tokens do not see each other there.
"""

import functools

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.adapters.layers.prepared import join_one
from lorasp_jax.models.config import BackboneConfig, ExpertConfig
from lorasp_jax.models.transformer.attention import attention
from lorasp_jax.models.transformer.depth import scan_depth, stack
from lorasp_jax.models.transformer.experts import ExpertBlock, KeysValues, LanguageExpert
from lorasp_jax.models.transformer.layers import (
    LayerAux,
    RMSNorm,
    positions,
    rope,
    rope_table,
    under,
)


class SelfBlock(ExpertBlock):
    """One layer of SmolLM2: as Gemma's, with SiLU and norms that store their whole factor."""

    make_norm = staticmethod(functools.partial(RMSNorm, eps=1e-5, offset=0.0))
    activation = staticmethod(jax.nn.silu)


class CrossBlock(SelfBlock):
    """A layer of the action expert that attends to the language model's keys and values alone."""

    def __init__(self, size: ExpertConfig, config: BackboneConfig, *, rngs: nnx.Rngs) -> None:
        super().__init__(size, config, context=size.kv_heads * size.head_dim, rngs=rngs)

    def join_layers(self, *, copy_kernels: bool = True) -> None:
        """See `prepared.JoinsLayers`; queries, keys and values each read another input."""
        self.q_proj = join_one(self.q_proj, copy_kernels=copy_kernels)
        self.k_proj = join_one(self.k_proj, copy_kernels=copy_kernels)
        self.v_proj = join_one(self.v_proj, copy_kernels=copy_kernels)
        self.join_rest(copy_kernels=copy_kernels)

    def read(self, cache: KeysValues, valid: jax.Array) -> tuple[KeysValues, LayerAux]:
        """Own keys and values `[B, P, K, H]` from the language model's of the same shape.

        The language model has rotated its keys already; they are not rotated again.
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
        own: KeysValues,
        token_mask: jax.Array,
    ) -> tuple[jax.Array, LayerAux]:
        """x `[B, T, D]` after this layer, given what `read` made; mask `[B, T, P]`."""
        h, *_ = self.input_layernorm.conditioned(x, None)
        q, q_aux = self.q_proj(h, token_mask=token_mask, return_aux=True)
        q = q.reshape(*x.shape[:2], -1, self.head_dim)
        q = rope(q, table, scale=self.head_dim**-0.5)
        x, aux = self.finish(x, attention(q, *own, mask), token_mask)
        return x, {"q_proj": q_aux, **aux}


class Language(LanguageExpert):
    """SmolLM2. Its `lm_head` takes no part in acting; it is kept to be saved as it was loaded."""

    block = SelfBlock

    def __init__(self, size: ExpertConfig, config: BackboneConfig, *, rngs: nnx.Rngs) -> None:
        super().__init__(size, config, rngs=rngs)
        self.lm_head = nnx.Param(jnp.array(self.embedding.get_value()))  # a buffer of its own


class Pair(nnx.Module):
    """Two layers of the action expert, one of each kind."""

    def __init__(self, size: ExpertConfig, config: BackboneConfig, *, rngs: nnx.Rngs) -> None:
        self.self_layer = SelfBlock(size, config, rngs=rngs)
        self.cross_layer = CrossBlock(size, config, rngs=rngs)


class ActionExpert(nnx.Module):
    """Layers with self- and cross-attention in turn, and a final norm."""

    def __init__(self, size: ExpertConfig, config: BackboneConfig, *, rngs: nnx.Rngs) -> None:
        self.config = config
        self.head_dim = size.head_dim
        self.blocks = stack(lambda rngs: Pair(size, config, rngs=rngs), size.depth // 2, rngs)
        self.norm = SelfBlock.make_norm(size.width, param_dtype=config.param_dtype)

    def read(self, cache: KeysValues, valid: jax.Array) -> tuple[KeysValues, KeysValues, LayerAux]:
        """What the layers attend to, once per observation.

        Args:
            cache: keys and values `[L, B, P, K, H]` of the language model.
            valid: `[B, P]` bool.

        Returns:
            Keys and values `[L / 2, B, P, K, H]` for the self-attention and for the cross-attention
            layers, and the adapters' reports.
        """
        even, odd = (jax.tree.map(lambda a, i=i: a[i::2], cache) for i in (0, 1))
        _, (cross, aux) = scan_depth(
            self.blocks.cross_layer,
            lambda block, valid, cache: (valid, block.read(cache, valid)),
            valid,
            odd,
            remat=self.config.remat,
            unroll=self.config.unroll_layers,
        )
        return even, cross, under("cross_layer", aux)

    def __call__(
        self,
        x: jax.Array,
        position: jax.Array,
        mask: jax.Array,
        cache: KeysValues,
        cross: KeysValues,
        *,
        token_mask: jax.Array,
    ) -> tuple[jax.Array, LayerAux]:
        """All layers.

        Args:
            x: `[B, T, D]`.
            position: `[B, T]` int32, counted on from the prefix; cross-attention counts from zero.
            mask: `[B, T, P + T]` bool.
            cache: keys and values for self-attention, from `read`.
            cross: for cross-attention, from `read`.
            token_mask: `[B, T]` bool, what the adapters count.

        Returns:
            `[B, T, D]` after the final norm, and the adapters' reports, stacked over pairs.
        """
        table = rope_table(position, self.head_dim)
        own_table = rope_table(positions(jnp.ones(x.shape[:2], bool)), self.head_dim)
        prefix_mask = mask[:, :, : -x.shape[1]]

        def call(
            pair: Pair, x: jax.Array, read: tuple[KeysValues, KeysValues]
        ) -> tuple[jax.Array, LayerAux]:
            x, (_, own) = pair.self_layer(x, table, mask, read[0], token_mask)
            x, other = pair.cross_layer.attend(x, own_table, prefix_mask, read[1], token_mask)
            return x, under("self_layer", own) | under("cross_layer", other)

        x, aux = scan_depth(
            self.blocks,
            call,
            x.astype(self.config.dtype),
            (cache, cross),
            remat=self.config.remat,
            unroll=self.config.unroll_layers,
        )
        return self.norm(x), aux
