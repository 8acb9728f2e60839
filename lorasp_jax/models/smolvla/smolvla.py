"""SmolVLA (Shukor et al., arXiv 2506.01844): a small VLM with flow matching on actions.

Tokens form blocks: [images, instruction], [state], and one block per noisy action. Each block
attends to itself and to earlier blocks. Images, instruction and state are the prefix, processed by
the language model; the actions are the suffix, processed by the action expert.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.kernels.low_rank_matmul import Mask
from lorasp_jax.models.backbone import Backbone, suffix_mask_and_positions
from lorasp_jax.models.config import BackboneConfig, ExpertConfig, VisionConfig
from lorasp_jax.models.inputs import LEROBOT_SMOLVLA
from lorasp_jax.models.observation import Observation
from lorasp_jax.models.smolvla.experts import ActionExpert, SmolLM2
from lorasp_jax.models.transformer.depth import ByLayer
from lorasp_jax.models.transformer.experts import KeysValues
from lorasp_jax.models.transformer.layers import (
    LayerAux,
    ModelAux,
    block_mask,
    merge_action_aux,
    positions,
)
from lorasp_jax.models.transformer.siglip import SigLIP


@dataclasses.dataclass(frozen=True)
class SmolVLAConfig(BackboneConfig):
    """Sizes and runtime options of a SmolVLA model.

    Raises:
        ValueError: inconsistent sizes.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.action.depth % 2:
            raise ValueError("depth must be even, because self- and cross-attention alternate")

    def create(self, rngs: nnx.Rngs) -> SmolVLA:
        """Create a model with random weights; works under `nnx.eval_shape`."""
        return SmolVLA(self, rngs=rngs)

    @classmethod
    def base(cls) -> SmolVLAConfig:
        """The published SmolVLA, 450,046,176 parameters (LeRobot, policies/smolvla).

        The action expert's width is 3/4 of the language model's. Its MLP has width
        256 ceil(4 int(2 * 720 / 3) / 256) = 2048 (smolvlm_with_expert.py).
        """
        return cls(
            vision=VisionConfig(width=768, depth=12, mlp=3072, heads=12, patch=16, shuffle=4),
            language=ExpertConfig(960, 16, 2560, heads=15, kv_heads=5, head_dim=64),
            action=ExpertConfig(720, 16, 2048, heads=15, kv_heads=5, head_dim=64),
            cameras=("camera1", "camera2", "camera3"),
            image_size=512,
            vocabulary=49_280,
            max_tokens=48,
            chunk=50,
            action_dim=32,
            inputs=LEROBOT_SMOLVLA,
            dtype="bfloat16",
        )

    @classmethod
    def medium(cls) -> SmolVLAConfig:
        """Sizes between small and base: about 66 M parameters, 16 tokens per camera."""
        return cls.miniature(
            vision=VisionConfig(width=512, depth=8, mlp=1536, heads=8, patch=8, shuffle=2),
            language=ExpertConfig(512, 10, 1280, heads=8, kv_heads=2, head_dim=64),
            action=ExpertConfig(384, 10, 1024, heads=8, kv_heads=2, head_dim=64),
        )

    @classmethod
    def small(cls) -> SmolVLAConfig:
        """Sizes for one accelerator: about 9 M parameters, 64 patches and 16 tokens per camera."""
        return cls.miniature(
            vision=VisionConfig(width=256, depth=4, mlp=768, heads=4, patch=8, shuffle=2),
            language=ExpertConfig(256, 6, 640, heads=6, kv_heads=2, head_dim=32),
            action=ExpertConfig(192, 6, 512, heads=6, kv_heads=2, head_dim=32),
        )

    @classmethod
    def nano(cls) -> SmolVLAConfig:
        """Sizes for a CPU: about 1 M parameters, 16 tokens per camera."""
        return cls.miniature(
            vision=VisionConfig(width=96, depth=2, mlp=256, heads=3, patch=8, shuffle=2),
            language=ExpertConfig(96, 4, 192, heads=3, kv_heads=1, head_dim=32),
            action=ExpertConfig(96, 4, 256, heads=3, kv_heads=1, head_dim=32),
        )

    @classmethod
    def dummy(cls) -> SmolVLAConfig:
        """Sizes for tests: the model compiles and runs in seconds."""
        return cls.miniature(
            vision=VisionConfig(width=32, depth=2, mlp=48, heads=2, patch=8, shuffle=2),
            language=ExpertConfig(48, 4, 64, heads=4, kv_heads=2, head_dim=16),
            action=ExpertConfig(32, 4, 64, heads=4, kv_heads=2, head_dim=16),
            image_size=32,
            max_tokens=6,
            chunk=4,
            unroll=False,
        )


class SmolVLAPrefix(NamedTuple):
    """Encoded images, instruction and state.

    Attributes:
        cache: keys and values `[L / 2, B, P, K, H]` of the language model's even layers.
        cross: the same for the odd layers, projected by the action expert.
        valid: `[B, P]` bool, False for padding and missing cameras.
    """

    cache: KeysValues | ByLayer
    cross: KeysValues | ByLayer
    valid: jax.Array

    def by_layer(self) -> SmolVLAPrefix:
        """Split cache and cross into layers, so that a loop of flow steps slices nothing."""
        return self._replace(cache=ByLayer.of(self.cache), cross=ByLayer.of(self.cross))


class SmolVLA(Backbone):
    """SmolVLA of any size."""

    config: SmolVLAConfig
    flow_layers = "^action(_|/(?!.*cross_layer/[kv]_proj))"

    def __init__(self, config: SmolVLAConfig, *, rngs: nnx.Rngs) -> None:
        self.config = config
        self.vision = SigLIP(config, head_bias=False, rngs=rngs)
        self.language = SmolLM2(config.language, config, rngs=rngs)
        self.action = ActionExpert(config.action, config, rngs=rngs)
        self._make_projections(config.language.width, rngs)

    def embed_prefix(self, obs: Observation) -> tuple[jax.Array, jax.Array, ModelAux]:
        """Embed images, instruction and state as `encode_images` does images."""
        image_tokens, image_valid, aux = self.encode_images(obs)
        state_valid = jnp.ones((obs.state.shape[0], 1), bool)
        state = obs.state[:, None].astype(jnp.float32)
        state, state_aux = self.state_proj(state, token_mask=state_valid, return_aux=True)
        # Unlike pi0, SmolVLA scales image tokens like language tokens.
        image_tokens = image_tokens * math.sqrt(image_tokens.shape[-1])
        text = self.language.embed(obs.tokens)
        tokens = jnp.concatenate([image_tokens, text, state.astype(text.dtype)], axis=1)
        valid = jnp.concatenate([image_valid, obs.token_mask, state_valid], axis=1)
        return tokens, valid, {**aux, "action": {"state_proj": state_aux}}

    def embed_suffix(
        self, obs: Observation, x_t: jax.Array, flow_time: jax.Array, action_valid: Mask = None
    ) -> tuple[jax.Array, LayerAux]:
        """See `embed_actions`; `obs` is unused, because the state is in the prefix."""
        del obs
        return self.embed_actions(x_t, flow_time, action_valid)

    def run_prefix(self, obs: Observation) -> tuple[SmolVLAPrefix, ModelAux]:
        """Encode images, instruction and state."""
        tokens, valid, aux = self.embed_prefix(obs)
        block = _prefix_block(valid.shape[1])
        mask = block_mask(block, block, valid, valid)
        _, cache, language_aux = self.language(tokens, positions(valid), mask, token_mask=valid)
        even, cross, action_aux = self.action.project_cache(cache, valid)
        prefix = SmolVLAPrefix(even, cross, valid)
        return prefix, merge_action_aux({**aux, "language": language_aux}, action_aux)

    def run_suffix(
        self,
        prefix: SmolVLAPrefix,
        obs: Observation,
        x_t: jax.Array,
        flow_time: jax.Array,
        action_valid: Mask = None,
    ) -> tuple[jax.Array, LayerAux]:
        """Predict the velocity `[B, C, A]` f32; see `Backbone.run_suffix`."""
        if action_valid is None:
            action_valid = jnp.ones(x_t.shape[:2], bool)
        tokens, aux = self.embed_suffix(obs, x_t, flow_time, action_valid)
        block = 2 + np.arange(tokens.shape[1])
        prefix_block = _prefix_block(prefix.valid.shape[1])
        mask, position = suffix_mask_and_positions(prefix.valid, prefix_block, block)
        out, expert_aux = self.action(
            tokens, position, mask, prefix.cache, prefix.cross, token_mask=action_valid
        )
        out = out.astype(jnp.float32)
        v_t, out_aux = self.action_out_proj(out, token_mask=action_valid, return_aux=True)
        return v_t, {**expert_aux, **aux, "action_out_proj": out_aux}


def _prefix_block(tokens: int) -> np.ndarray:
    """Block numbers `[P]` of the prefix tokens: images and instruction, then the state."""
    return np.array([0] * (tokens - 1) + [1])
