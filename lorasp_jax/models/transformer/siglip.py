"""SigLIP vision tower (Zhai et al., arXiv 2303.15343) with a projection to the language model."""

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.adapters.layers.prepared import Layer
from lorasp_jax.dense import Dense
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.transformer.attention import attention
from lorasp_jax.models.transformer.depth import scan_depth, stack
from lorasp_jax.models.transformer.layers import LayerAux, LayerNorm, apply_to_shared_input


class VisionBlock(nnx.Module):
    """Pre-norm transformer layer with biases: attention, then an MLP with tanh-GELU."""

    shared_inputs = (("q_proj", "k_proj", "v_proj"),)

    def __init__(self, config: BackboneConfig, *, rngs: nnx.Rngs) -> None:
        width, mlp = config.vision.width, config.vision.mlp
        options = {"dtype": config.dtype, "param_dtype": config.param_dtype, "rngs": rngs}
        self.heads: int = config.vision.heads
        self.layer_norm1: LayerNorm = LayerNorm(width, param_dtype=config.param_dtype)
        self.q_proj: Layer = Dense(width, width, **options)
        self.k_proj: Layer = Dense(width, width, **options)
        self.v_proj: Layer = Dense(width, width, **options)
        self.out_proj: Layer = Dense(width, width, **options)
        self.layer_norm2: LayerNorm = LayerNorm(width, param_dtype=config.param_dtype)
        self.fc1: Layer = Dense(width, mlp, **options)
        self.fc2: Layer = Dense(mlp, width, **options)

    def __call__(self, x: jax.Array, token_mask: jax.Array) -> tuple[jax.Array, LayerAux]:
        """Apply the layer to x `[B, T, D]`; also return the adapters' aux."""
        qkv = {"q_proj": self.q_proj, "k_proj": self.k_proj, "v_proj": self.v_proj}
        projected, aux = apply_to_shared_input(self.layer_norm1(x), token_mask, **qkv)
        q, k, v = (y.reshape(*x.shape[:2], self.heads, -1) for y in projected)
        h = attention(q * q.shape[-1] ** -0.5, k, v, None)
        y, aux["out_proj"] = self.out_proj(h, token_mask=token_mask, return_aux=True)
        x = x + y
        h, aux["fc1"] = self.fc1(self.layer_norm2(x), token_mask=token_mask, return_aux=True)
        h = jax.nn.gelu(h, approximate=True)
        y, aux["fc2"] = self.fc2(h, token_mask=token_mask, return_aux=True)
        return x + y, aux


class SigLIP(nnx.Module):
    """Encodes images as tokens for the language model.

    The patch embedding is a dense layer over flattened patches, equivalent to the usual strided
    convolution. The head maps each `shuffle` x `shuffle` square of tokens to one token (pixel
    shuffle).
    """

    def __init__(self, config: BackboneConfig, *, head_bias: bool = True, rngs: nnx.Rngs) -> None:
        vision, options = config.vision, {"param_dtype": config.param_dtype, "rngs": rngs}
        self.config = config
        self.patch_embed = Dense(3 * vision.patch**2, vision.width, dtype=jnp.float32, **options)
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
            **options,
        )

    def __call__(self, images: jax.Array, present: jax.Array) -> tuple[jax.Array, LayerAux]:
        """Encode images.

        Args:
            images: `[B, H, W, 3]` f32 in [-1, 1].
            present: `[B]` bool, False for missing cameras.

        Returns:
            Tokens `[B, T, D]`, with the language model's width D, and the adapters' aux.
        """
        mask = jnp.broadcast_to(present[:, None], (images.shape[0], self.config.patches))
        aux: LayerAux = {}
        x = patches(images, self.config.vision.patch)
        x, aux["patch_embed"] = self.patch_embed(x, token_mask=mask, return_aux=True)
        x = x + self.position_embedding.get_value().astype(x.dtype)
        x, block_aux = scan_depth(
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
        x, aux["head"] = self.head(x, token_mask=mask, return_aux=True)
        return x, block_aux | aux


def patches(images: jax.Array, size: int) -> jax.Array:
    """Split images `[B, H, W, C]` into patches `[B, T, C size^2]`.

    Patches are in row-major order, each flattened in the order (y, x, channel).
    """
    batch, height, width, channels = images.shape
    grid = images.reshape(batch, height // size, size, width // size, size, channels)
    return grid.swapaxes(2, 3).reshape(batch, -1, size * size * channels)
