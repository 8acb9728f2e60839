"""SigLIP vision tower (Zhai et al., arXiv 2303.15343) with its projection to language tokens."""

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.adapters.layers.prepared import Layer, join, join_one
from lorasp_jax.dense import Dense
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.transformer.attention import attention
from lorasp_jax.models.transformer.depth import scan_depth, stack
from lorasp_jax.models.transformer.layers import LayerAux, LayerNorm, together


class VisionBlock(nnx.Module):
    """Pre-norm transformer layer: x + attention(norm(x)), x + mlp(norm(x)), tanh-GELU, biases."""

    def __init__(self, config: BackboneConfig, *, rngs: nnx.Rngs) -> None:
        width, mlp = config.vision.width, config.vision.mlp
        kinds = {"dtype": config.dtype, "param_dtype": config.param_dtype, "rngs": rngs}
        self.heads = config.vision.heads
        self.layer_norm1 = LayerNorm(width, param_dtype=config.param_dtype)
        self.q_proj: Layer = Dense(width, width, **kinds)
        self.k_proj: Layer = Dense(width, width, **kinds)
        self.v_proj: Layer = Dense(width, width, **kinds)
        self.out_proj: Layer = Dense(width, width, **kinds)
        self.layer_norm2 = LayerNorm(width, param_dtype=config.param_dtype)
        self.fc1: Layer = Dense(width, mlp, **kinds)
        self.fc2: Layer = Dense(mlp, width, **kinds)

    def join_layers(self, *, copy_kernels: bool = True) -> None:
        """See `prepared.JoinsLayers`."""
        qkv = self.q_proj, self.k_proj, self.v_proj
        self.q_proj, self.k_proj, self.v_proj = join(qkv, copy_kernels=copy_kernels)
        self.out_proj = join_one(self.out_proj, copy_kernels=copy_kernels)
        self.fc1 = join_one(self.fc1, copy_kernels=copy_kernels)
        self.fc2 = join_one(self.fc2, copy_kernels=copy_kernels)

    def __call__(self, x: jax.Array, token_mask: jax.Array) -> tuple[jax.Array, LayerAux]:
        """x `[B, T, D]` -> x `[B, T, D]` and the adapters' reports."""
        qkv = {"q_proj": self.q_proj, "k_proj": self.k_proj, "v_proj": self.v_proj}
        read, aux = together(self.layer_norm1(x), token_mask, **qkv)
        q, k, v = (y.reshape(*x.shape[:2], self.heads, -1) for y in read)
        h = attention(q * q.shape[-1] ** -0.5, k, v, None)
        y, aux["out_proj"] = self.out_proj(h, token_mask=token_mask, return_aux=True)
        x = x + y
        h, aux["fc1"] = self.fc1(self.layer_norm2(x), token_mask=token_mask, return_aux=True)
        h = jax.nn.gelu(h, approximate=True)
        y, aux["fc2"] = self.fc2(h, token_mask=token_mask, return_aux=True)
        return x + y, aux


class SigLIP(nnx.Module):
    """Pictures to language tokens.

    The patch embedding, a dense layer over flattened patches, equals the usual strided convolution.
    The head reads `config.vision.shuffle` by as many neighbouring tokens as one (pixel shuffle).
    """

    def __init__(self, config: BackboneConfig, *, head_bias: bool = True, rngs: nnx.Rngs) -> None:
        vision, kinds = config.vision, {"param_dtype": config.param_dtype, "rngs": rngs}
        self.config = config
        self.patch_embed = Dense(3 * vision.patch**2, vision.width, dtype=jnp.float32, **kinds)
        shape = (config.patches, vision.width)
        draw = jax.random.normal(rngs.params(), shape, config.param_dtype)
        self.position_embedding = nnx.Param(draw * vision.width**-0.5)
        self.blocks = stack(lambda rngs: VisionBlock(config, rngs=rngs), vision.depth, rngs)
        self.norm = LayerNorm(vision.width, param_dtype=config.param_dtype)
        self.head = Dense(
            vision.shuffle**2 * vision.width,
            config.language.width,
            use_bias=head_bias,
            dtype=config.dtype,
            **kinds,
        )

    def __call__(self, images: jax.Array, present: jax.Array) -> tuple[jax.Array, LayerAux]:
        """Encode pictures.

        Args:
            images: `[B, H, W, 3]` f32 in [-1, 1].
            present: `[B]` bool, False for a missing camera's placeholder.

        Returns:
            `[B, T, D]` tokens of the language width, and the adapters' reports.
        """
        mask = jnp.broadcast_to(present[:, None], (images.shape[0], self.config.patches))
        own: LayerAux = {}
        x = patches(images, self.config.vision.patch)
        x, own["patch_embed"] = self.patch_embed(x, token_mask=mask, return_aux=True)
        x = x + self.position_embedding.get_value().astype(x.dtype)
        x, aux = scan_depth(
            self.blocks,
            lambda block, x, _: block(x, mask),
            x.astype(self.config.dtype),
            remat=self.config.remat,
            unroll=self.config.unroll_layers,
        )
        side = self.config.image_size // self.config.vision.patch
        norm = self.norm if self.config.remat == "none" else jax.checkpoint(self.norm)
        grid = norm(x).reshape(x.shape[0], side, side, -1)
        x, mask = patches(grid, self.config.vision.shuffle), mask[:, : self.config.image_tokens]
        x, own["head"] = self.head(x, token_mask=mask, return_aux=True)
        return x, aux | own


def patches(images: jax.Array, size: int) -> jax.Array:
    """`[B, H, W, C]` -> `[B, T, C size^2]`: patches row by row, each flattened as (y, x, c)."""
    batch, height, width, channels = images.shape
    grid = images.reshape(batch, height // size, size, width // size, size, channels)
    return grid.swapaxes(2, 3).reshape(batch, -1, size * size * channels)
