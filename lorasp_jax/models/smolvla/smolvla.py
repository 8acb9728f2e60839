"""SmolVLA (Shukor et al., arXiv 2506.01844): flow matching on a small vision-language model.

Tokens fall into blocks: [pictures, instruction], [state], and each noisy action by itself; each
block sees itself and those before it. Pictures, instruction and state are the prefix of the
language model, the actions the suffix of the action expert.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.models.backbone import Backbone, suffix_view
from lorasp_jax.models.config import BackboneConfig, ExpertConfig, VisionConfig
from lorasp_jax.models.inputs import LEROBOT
from lorasp_jax.models.observation import Observation
from lorasp_jax.models.smolvla.experts import ActionExpert, Language
from lorasp_jax.models.transformer.experts import KeysValues
from lorasp_jax.models.transformer.layers import LayerAux, ModelAux, block_mask, positions
from lorasp_jax.models.transformer.siglip import SigLIP


@dataclasses.dataclass(frozen=True)
class SmolVLAConfig(BackboneConfig):
    """Every size of a SmolVLA.

    Raises:
        ValueError: sizes that do not fit together.
    """

    def __post_init__(self) -> None:
        """Checks that the parts fit."""
        super().__post_init__()
        if self.action.depth % 2:
            raise ValueError(
                "self- and cross-attention alternate, so the depth must be even, "
                f"not {self.action.depth}."
            )

    def create(self, rngs: nnx.Rngs) -> SmolVLA:
        """A model with random weights; works under `nnx.eval_shape`."""
        return SmolVLA(self, rngs=rngs)

    @classmethod
    def base(cls) -> SmolVLAConfig:
        """The published SmolVLA, 450,046,176 parameters (LeRobot, policies/smolvla).

        The action expert has 3/4 of the language model's width, 720, and an MLP of
        256 ceil(int(4 int(2 * 720 / 3)) / 256) = 2048 (its smolvlm_with_expert.py).
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
            inputs=LEROBOT,
            dtype="bfloat16",
        )

    @classmethod
    def small(cls) -> SmolVLAConfig:
        """For one accelerator: about 9 M parameters, 16 tokens a camera of 64 patches."""
        return cls.miniature(
            vision=VisionConfig(width=256, depth=4, mlp=768, heads=4, patch=8, shuffle=2),
            language=ExpertConfig(256, 6, 640, heads=6, kv_heads=2, head_dim=32),
            action=ExpertConfig(192, 6, 512, heads=6, kv_heads=2, head_dim=32),
        )

    @classmethod
    def nano(cls) -> SmolVLAConfig:
        """For a CPU: about 1 M parameters, 16 tokens a camera."""
        return cls.miniature(
            vision=VisionConfig(width=96, depth=2, mlp=256, heads=3, patch=8, shuffle=2),
            language=ExpertConfig(96, 4, 192, heads=3, kv_heads=1, head_dim=32),
            action=ExpertConfig(96, 4, 256, heads=3, kv_heads=1, head_dim=32),
        )

    @classmethod
    def dummy(cls) -> SmolVLAConfig:
        """For tests: compiles and runs in seconds."""
        return cls.miniature(
            vision=VisionConfig(width=32, depth=2, mlp=48, heads=2, patch=8, shuffle=2),
            language=ExpertConfig(48, 4, 64, heads=4, kv_heads=2, head_dim=16),
            action=ExpertConfig(32, 4, 64, heads=4, kv_heads=2, head_dim=16),
            image_size=32,
            max_tokens=6,
            chunk=4,
            unroll=False,
        )


class Prefix(NamedTuple):
    """Pictures, instruction and state as the action expert needs them.

    Attributes:
        cache: keys and values `[L / 2, B, P, K, H]` of the language model's even layers.
        cross: what the expert's odd layers made of the odd ones, in the same shape.
        valid: `[B, P]` bool.
    """

    cache: KeysValues
    cross: KeysValues
    valid: jax.Array


class SmolVLA(Backbone):
    """SmolVLA of any size."""

    config: SmolVLAConfig

    def __init__(self, config: SmolVLAConfig, *, rngs: nnx.Rngs) -> None:
        self.config = config
        self.vision = SigLIP(config, head_bias=False, rngs=rngs)
        self.language = Language(config.language, config, rngs=rngs)
        self.action = ActionExpert(config.action, config, rngs=rngs)
        self._make_projections(config.language.width, rngs)

    def embed_prefix(self, obs: Observation) -> tuple[jax.Array, jax.Array, ModelAux]:
        """Tokens of pictures, instruction and state.

        Returns:
            tokens `[B, P, D]`, valid `[B, P]` bool, reports of the adapters.

        Raises:
            ValueError: a camera is missing or a picture has the wrong size.
        """
        seen, image_valid, aux = self.look(obs)
        one = jnp.ones((obs.state.shape[0], 1), bool)
        state = obs.state[:, None].astype(jnp.float32)
        state, state_aux = self.state_proj(state, token_mask=one, return_aux=True)
        # Unlike pi0's, the pictures' tokens have the scale of the language's.
        seen = seen * math.sqrt(seen.shape[-1])
        text = self.language.embed(obs.tokens)
        tokens = jnp.concatenate([seen, text, state.astype(text.dtype)], axis=1)
        valid = jnp.concatenate([image_valid, obs.token_mask, one], axis=1)
        return tokens, valid, {**aux, "action": {"state_proj": state_aux}}

    def embed_suffix(
        self,
        obs: Observation,
        x_t: jax.Array,
        flow_time: jax.Array,
        action_valid: jax.Array | None = None,
    ) -> tuple[jax.Array, LayerAux]:
        """Tokens of the noisy actions.

        Args:
            obs: not read, the state is in the prefix.
            x_t: `[B, C, A]`.
            flow_time: `[B]`.
            action_valid: `[B, C]` bool, what the adapters count; None counts all.

        Returns:
            `[B, C, D]` f32, and the adapters' reports.
        """
        del obs
        return self.action_tokens(x_t, flow_time, action_valid)

    def run_prefix(self, obs: Observation) -> tuple[Prefix, ModelAux]:
        """Everything that does not depend on the actions, once per observation."""
        tokens, valid, aux = self.embed_prefix(obs)
        block = _prefix_blocks(valid.shape[1])
        mask = block_mask(block, block, valid, valid)
        _, cache, language = self.language(tokens, positions(valid), mask, token_mask=valid)
        own, cross, read = self.action.read(cache, valid)
        prefix = Prefix(own, cross, valid)
        return prefix, {**aux, "language": language, "action": {**aux["action"], **read}}

    def run_suffix(
        self,
        prefix: Prefix,
        obs: Observation,
        x_t: jax.Array,
        flow_time: jax.Array,
        action_valid: jax.Array | None = None,
    ) -> tuple[jax.Array, LayerAux]:
        """Velocity `[B, C, A]` f32 given the prefix; arguments as in `embed_suffix`."""
        if action_valid is None:
            action_valid = jnp.ones(x_t.shape[:2], bool)
        tokens, aux = self.embed_suffix(obs, x_t, flow_time, action_valid)
        block = 2 + np.arange(tokens.shape[1])
        before = _prefix_blocks(prefix.valid.shape[1])
        mask, position = suffix_view(prefix.valid, before, block)
        out, expert_aux = self.action(
            tokens, position, mask, prefix.cache, prefix.cross, token_mask=action_valid
        )
        out = out.astype(jnp.float32)
        v_t, out_aux = self.action_out_proj(out, token_mask=action_valid, return_aux=True)
        return v_t, {**expert_aux, **aux, "action_out_proj": out_aux}


def _prefix_blocks(tokens: int) -> np.ndarray:
    """`[P]` blocks of the prefix: pictures and instruction, then the state."""
    return np.array([0] * (tokens - 1) + [1])
