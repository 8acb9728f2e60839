"""A small Gemma model with the layers of Flax's example (examples/gemma), which is no package."""

import jax
import jax.numpy as jnp
from flax import nnx

VOCABULARY, WIDTH, HEADS, KV_HEADS, HEAD, MLP = 40, 16, 4, 2, 8, 24


class Attention(nnx.Module):
    """Like Flax's example: einsums over heads, fused keys and values, sizes read from kernels."""

    def __init__(self, rngs):
        self.q_einsum = nnx.Einsum("BTD,NDH->BTNH", (HEADS, WIDTH, HEAD), rngs=rngs)
        self.kv_einsum = nnx.Einsum("BSD,CKDH->CBSKH", (2, KV_HEADS, WIDTH, HEAD), rngs=rngs)
        self.attn_vec_einsum = nnx.Einsum("BTNH,NHD->BTD", (HEADS, HEAD, WIDTH), rngs=rngs)

    def __call__(self, x, mask):
        query = self.q_einsum(x, out_sharding=None)
        key, value = self.kv_einsum(x, out_sharding=None)
        groups = self.q_einsum.kernel.shape[0] // self.kv_einsum.kernel.shape[1]
        key, value = (jnp.repeat(v, groups, axis=2) for v in (key, value))
        logits = jnp.einsum("BTNH,BSNH->BNTS", query, key) * HEAD**-0.5
        weights = jax.nn.softmax(jnp.where(mask[:, None], logits, -1e9))
        return self.attn_vec_einsum(jnp.einsum("BNTS,BSNH->BTNH", weights, value))


class Block(nnx.Module):
    def __init__(self, rngs):
        self.attn = Attention(rngs)
        self.pre_attention_norm = nnx.RMSNorm(WIDTH, rngs=rngs)
        self.pre_ffw_norm = nnx.RMSNorm(WIDTH, rngs=rngs)
        self.mlp = nnx.Dict(
            gate_proj=nnx.Linear(WIDTH, MLP, use_bias=False, rngs=rngs),
            up_proj=nnx.Linear(WIDTH, MLP, use_bias=False, rngs=rngs),
            down_proj=nnx.Linear(MLP, WIDTH, use_bias=False, rngs=rngs),
        )

    def __call__(self, x, mask):
        x = x + self.attn(self.pre_attention_norm(x), mask)
        y, mlp = self.pre_ffw_norm(x), self.mlp
        gate = nnx.gelu(mlp.gate_proj(y, out_sharding=None))
        return x + mlp.down_proj(gate * mlp.up_proj(y, out_sharding=None))


class Gemma(nnx.Module):
    def __init__(self, rngs):
        self.embedder = nnx.Embed(VOCABULARY, WIDTH, rngs=rngs)
        self.layers = nnx.List([Block(rngs) for _ in range(2)])
        self.final_norm = nnx.RMSNorm(WIDTH, rngs=rngs)

    def __call__(self, tokens, positions, cache, mask):
        x = self.embedder(tokens) * WIDTH**0.5
        for layer in self.layers:
            x = layer(x, mask)
        return self.embedder.attend(self.final_norm(x)), cache
