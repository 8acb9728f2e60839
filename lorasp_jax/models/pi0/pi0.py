"""pi0 (Black et al., arXiv 2410.24164): a vision-language model with flow matching on actions.

Tokens form three blocks: [images, instruction], [state], [noisy actions]. Each block attends to
itself and to earlier blocks. The first block is the prefix, processed by the language expert; the
other two are the suffix, processed by the action expert.

pi0.5 (arXiv 2504.16054) has no [state] block: the state is part of the prompt. The flow time
conditions the action expert's norms instead of being mixed into the action tokens.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.adapters.layers.prepared import Layer
from lorasp_jax.dense import Dense
from lorasp_jax.kernels.low_rank_matmul import Mask
from lorasp_jax.models.backbone import Backbone, suffix_mask_and_positions
from lorasp_jax.models.config import BackboneConfig, ExpertConfig, VisionConfig
from lorasp_jax.models.inputs import OPENPI, OPENPI_PI05, OURS_PI05
from lorasp_jax.models.observation import Observation
from lorasp_jax.models.transformer.depth import ByLayer
from lorasp_jax.models.transformer.experts import AdaptiveExpert, Expert, KeysValues, LanguageExpert
from lorasp_jax.models.transformer.layers import (
    LayerAux,
    ModelAux,
    positions,
    time_embedding,
    valid_first,
)
from lorasp_jax.models.transformer.siglip import SigLIP


@dataclasses.dataclass(frozen=True)
class Pi0Config(BackboneConfig):
    """Sizes and runtime options of a pi0 or pi0.5 model."""

    pi05: bool = False
    """Build pi0.5 instead of pi0; see the module docstring."""

    def create(self, rngs: nnx.Rngs) -> Pi0:
        """Create a model with random weights; works under `nnx.eval_shape`."""
        return (Pi05 if self.pi05 else Pi0)(self, rngs=rngs)

    @classmethod
    def base(cls) -> Pi0Config:
        """The published pi0, 3,238,048,528 parameters (openpi, models/{gemma,siglip}.py)."""
        return cls(
            vision=VisionConfig(width=1152, depth=27, mlp=4304, heads=16, patch=14),
            language=ExpertConfig(2048, 18, 16384, heads=8, kv_heads=1, head_dim=256),
            action=ExpertConfig(1024, 18, 4096, heads=8, kv_heads=1, head_dim=256),
            cameras=("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb"),
            image_size=224,
            vocabulary=257_152,
            max_tokens=48,
            chunk=50,
            action_dim=32,
            inputs=OPENPI,
            dtype="bfloat16",
        )

    @classmethod
    def base_pi05(cls) -> Pi0Config:
        """The published pi0.5, 3,353,433,872 parameters (openpi, models/pi0_config.py)."""
        return dataclasses.replace(cls.base(), pi05=True, max_tokens=200, inputs=OPENPI_PI05)

    @classmethod
    def medium(cls) -> Pi0Config:
        """Sizes between small and base: about 70 M parameters, 64 tokens per camera."""
        return cls.miniature(
            vision=VisionConfig(width=512, depth=8, mlp=1536, heads=8, patch=8),
            language=ExpertConfig(512, 8, 1536, heads=8, kv_heads=1, head_dim=64),
            action=ExpertConfig(512, 8, 1536, heads=8, kv_heads=1, head_dim=64),
        )

    @classmethod
    def small(cls) -> Pi0Config:
        """Sizes for one accelerator: about 9.5 M parameters, 64 tokens per camera."""
        return cls.miniature(
            vision=VisionConfig(width=256, depth=4, mlp=768, heads=4, patch=8),
            language=ExpertConfig(192, 6, 512, heads=8, kv_heads=1, head_dim=32),
            action=ExpertConfig(256, 6, 768, heads=8, kv_heads=1, head_dim=32),
        )

    @classmethod
    def nano(cls) -> Pi0Config:
        """Sizes for a CPU: about 1 M parameters, 16 tokens per camera."""
        return cls.miniature(
            vision=VisionConfig(width=96, depth=2, mlp=256, heads=3, patch=16),
            language=ExpertConfig(96, 3, 192, heads=4, kv_heads=1, head_dim=32),
            action=ExpertConfig(128, 3, 256, heads=4, kv_heads=1, head_dim=32),
        )

    @classmethod
    def nano_pi05(cls) -> Pi0Config:
        """pi0.5 for a CPU; `max_tokens` fits the offline tokenizer's prompts with state."""
        return dataclasses.replace(cls.nano(), pi05=True, max_tokens=64, inputs=OURS_PI05)

    @classmethod
    def dummy(cls) -> Pi0Config:
        """Sizes for tests: the model compiles and runs in seconds."""
        return cls.miniature(
            vision=VisionConfig(width=32, depth=2, mlp=48, heads=2, patch=16),
            language=ExpertConfig(48, 2, 64, heads=4, kv_heads=2, head_dim=16),
            action=ExpertConfig(32, 2, 64, heads=4, kv_heads=2, head_dim=16),
            image_size=32,
            max_tokens=6,
            chunk=4,
            unroll=False,
        )


class Pi0Prefix(NamedTuple):
    """Encoded images and instruction, valid tokens first.

    Attributes:
        cache: keys and values `[L, B, P, K, H]` of the language expert's L layers, for P
            prefix tokens and K key-value heads of width H.
        valid: `[B, P]` bool, False for padding and missing cameras.
        out: `[B, P, D]` output of the language expert.
    """

    cache: KeysValues | ByLayer
    valid: jax.Array
    out: jax.Array

    def by_layer(self) -> Pi0Prefix:
        """Split the cache into layers, so that a loop of flow steps slices nothing."""
        return self._replace(cache=ByLayer.of(self.cache))


class Pi0(Backbone):
    """pi0 of any size."""

    config: Pi0Config
    make_expert = Expert

    def __init__(self, config: Pi0Config, *, rngs: nnx.Rngs) -> None:
        self.config = config
        self.vision = SigLIP(config, rngs=rngs)
        self.language = LanguageExpert(config.language, config, rngs=rngs)
        self.action = self.make_expert(config.action, config, rngs=rngs)
        self._make_projections(config.action.width, rngs)

    def embed_prefix(self, obs: Observation) -> tuple[jax.Array, jax.Array, ModelAux]:
        """Embed images and instruction as tokens; for results and errors see `encode_images`."""
        image_tokens, image_valid, aux = self.encode_images(obs)
        tokens = jnp.concatenate([image_tokens, self.language.embed(obs.tokens)], axis=1)
        return tokens, jnp.concatenate([image_valid, obs.token_mask], axis=1), aux

    def embed_suffix(
        self, obs: Observation, x_t: jax.Array, flow_time: jax.Array, action_valid: Mask = None
    ) -> tuple[jax.Array, LayerAux]:
        """Embed state and noisy actions as tokens `[B, 1 + C, D]` f32; see `embed_actions`."""
        valid, state = jnp.ones((x_t.shape[0], 1), bool), obs.state[:, None].astype(jnp.float32)
        state_token, state_aux = self.state_proj(state, token_mask=valid, return_aux=True)
        h, aux = self.embed_actions(x_t, flow_time, action_valid)
        return jnp.concatenate([state_token, h], axis=1), {"state_proj": state_aux, **aux}

    def run_prefix(self, obs: Observation) -> tuple[Pi0Prefix, ModelAux]:
        """Encode images and instruction."""
        tokens, valid, vision_aux = self.embed_prefix(obs)
        # All tokens attend to the valid ones. With these first, attention needs only their number.
        tokens, valid = valid_first(tokens, valid)
        count = jnp.sum(valid, axis=1, dtype=jnp.int32)
        out, cache, aux = self.language(tokens, positions(valid), count, token_mask=valid)
        return Pi0Prefix(cache, valid, out), {**vision_aux, "language": aux}

    def run_suffix(
        self,
        prefix: Pi0Prefix,
        obs: Observation,
        x_t: jax.Array,
        flow_time: jax.Array,
        action_valid: Mask = None,
    ) -> tuple[jax.Array, LayerAux]:
        """Predict the velocity `[B, C, A]` f32; see `Backbone.run_suffix`."""
        batch, chunk = x_t.shape[:2]
        if action_valid is None:
            action_valid = jnp.ones((batch, chunk), bool)
        tokens, aux = self.embed_suffix(obs, x_t, flow_time, action_valid)
        condition, time_aux = self.norm_condition(flow_time)
        states = tokens.shape[1] - chunk
        prefix_block = np.zeros(prefix.valid.shape[1], int)
        block = np.array([1] * states + [2] * chunk)
        mask, position = suffix_mask_and_positions(prefix.valid, prefix_block, block)
        token_mask = jnp.concatenate([jnp.ones((batch, states), bool), action_valid], axis=1)
        out, _, expert_aux = self.action(
            tokens, position, mask, prefix.cache, token_mask=token_mask, condition=condition
        )
        out = out[:, -chunk:].astype(jnp.float32)
        v_t, out_aux = self.action_out_proj(out, token_mask=action_valid, return_aux=True)
        return v_t, {**expert_aux, **aux, **time_aux, "action_out_proj": out_aux}

    def norm_condition(self, flow_time: jax.Array) -> tuple[jax.Array | None, LayerAux]:
        """Return the condition for adaptive norms and the adapters' aux; pi0 has neither."""
        del flow_time
        return None, {}


class Pi05(Pi0):
    """pi0.5 of any size."""

    make_expert = AdaptiveExpert

    def _make_projections(self, state_width: int, rngs: nnx.Rngs) -> None:
        """Create the layers outside the towers; the state needs none."""
        del state_width
        width, dim = self.config.action.width, self.config.action_dim
        options: Any = {"dtype": jnp.float32, "param_dtype": self.config.param_dtype, "rngs": rngs}
        self.action_in_proj: Layer = Dense(dim, width, **options)
        self.time_mlp_in: Layer = Dense(width, width, **options)
        self.time_mlp_out: Layer = Dense(width, width, **options)
        self.action_out_proj: Layer = Dense(width, dim, **options)

    def embed_suffix(
        self, obs: Observation, x_t: jax.Array, flow_time: jax.Array, action_valid: Mask = None
    ) -> tuple[jax.Array, LayerAux]:
        """Embed noisy actions as tokens `[B, C, D]` f32.

        `obs` and `flow_time` are unused: the state is in the prompt, and the time conditions norms.
        """
        del obs, flow_time
        x_t = x_t.astype(jnp.float32)
        h, aux = self.action_in_proj(x_t, token_mask=action_valid, return_aux=True)
        return h, {"action_in_proj": aux}

    def norm_condition(self, flow_time: jax.Array) -> tuple[jax.Array, LayerAux]:
        """Embed flow times as the condition for adaptive norms.

        Returns:
            `[B, 1, D]` f32 for times `[B]`, `[B, C, D]` for times `[B, C]`, and the adapters' aux.
        """
        aux: LayerAux = {}
        h = time_embedding(flow_time, self.config.action.width)
        valid = jnp.ones(h.shape[:2], bool)
        h, aux["time_mlp_in"] = self.time_mlp_in(h, token_mask=valid, return_aux=True)
        h = jax.nn.silu(h)
        h, aux["time_mlp_out"] = self.time_mlp_out(h, token_mask=valid, return_aux=True)
        return jax.nn.silu(h), aux
