"""pi0 (Black et al., arXiv 2410.24164): flow matching over actions on a vision-language model.

Tokens fall into three blocks: [pictures, instruction], [state], [noisy actions]; each sees itself
and the blocks before it. The first is the prefix, the other two the suffix of the action expert.

pi0.5 (arXiv 2504.16054) has no block [state], its prompt tells the state; and the flow time is not
mixed into the actions' tokens but conditions the action expert's norms.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.adapters.layers.prepared import Layer, join_one
from lorasp_jax.dense import Dense
from lorasp_jax.models.backbone import Backbone, suffix_view
from lorasp_jax.models.config import BackboneConfig, ExpertConfig, VisionConfig
from lorasp_jax.models.inputs import OPENPI, OPENPI_PI05, OURS_PI05
from lorasp_jax.models.observation import Observation
from lorasp_jax.models.transformer.experts import AdaptiveExpert, Expert, KeysValues, LanguageExpert
from lorasp_jax.models.transformer.layers import (
    LayerAux,
    ModelAux,
    block_mask,
    positions,
    time_embedding,
)
from lorasp_jax.models.transformer.siglip import SigLIP


@dataclasses.dataclass(frozen=True)
class Pi0Config(BackboneConfig):
    """Every size of a pi0, or of a pi0.5."""

    pi05: bool = False
    """pi0.5: the flow time reaches the action expert through its norms, not through the tokens, and
    there is no token of the state, which the prompt tells instead."""

    def create(self, rngs: nnx.Rngs) -> Pi0:
        """A model with random weights; works under `nnx.eval_shape`."""
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
    def small(cls) -> Pi0Config:
        """For one accelerator: about 9.5 M parameters, 64 tokens a camera."""
        return cls.miniature(
            vision=VisionConfig(width=256, depth=4, mlp=768, heads=4, patch=8),
            language=ExpertConfig(192, 6, 512, heads=8, kv_heads=1, head_dim=32),
            action=ExpertConfig(256, 6, 768, heads=8, kv_heads=1, head_dim=32),
        )

    @classmethod
    def nano(cls) -> Pi0Config:
        """For a CPU: about 1 M parameters, 16 tokens a camera."""
        return cls.miniature(
            vision=VisionConfig(width=96, depth=2, mlp=256, heads=3, patch=16),
            language=ExpertConfig(96, 3, 192, heads=4, kv_heads=1, head_dim=32),
            action=ExpertConfig(128, 3, 256, heads=4, kv_heads=1, head_dim=32),
        )

    @classmethod
    def nano_pi05(cls) -> Pi0Config:
        """pi0.5 for a CPU; the offline tokenizer's prompts with a robot's state fit."""
        return dataclasses.replace(cls.nano(), pi05=True, max_tokens=64, inputs=OURS_PI05)

    @classmethod
    def dummy(cls) -> Pi0Config:
        """For tests: compiles and runs in seconds."""
        return cls.miniature(
            vision=VisionConfig(width=32, depth=2, mlp=48, heads=2, patch=16),
            language=ExpertConfig(48, 2, 64, heads=4, kv_heads=2, head_dim=16),
            action=ExpertConfig(32, 2, 64, heads=4, kv_heads=2, head_dim=16),
            image_size=32,
            max_tokens=6,
            chunk=4,
            unroll=False,
        )


class Prefix(NamedTuple):
    """Pictures and instruction as the action expert needs them.

    Attributes:
        cache: keys and values `[L, B, P, K, H]` of every layer.
        valid: `[B, P]` bool.
        out: `[B, P, D]` output of the language expert.
    """

    cache: KeysValues
    valid: jax.Array
    out: jax.Array


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
        """Tokens of pictures and instruction.

        Returns:
            tokens `[B, P, D]`, valid `[B, P]` bool, reports of the vision tower's adapters.

        Raises:
            ValueError: a camera is missing or a picture has the wrong size.
        """
        seen, image_valid, aux = self.look(obs)
        tokens = jnp.concatenate([seen, self.language.embed(obs.tokens)], axis=1)
        return tokens, jnp.concatenate([image_valid, obs.token_mask], axis=1), aux

    def embed_suffix(
        self,
        obs: Observation,
        x_t: jax.Array,
        flow_time: jax.Array,
        action_valid: jax.Array | None = None,
    ) -> tuple[jax.Array, LayerAux]:
        """Tokens of the state and the noisy actions.

        Args:
            obs: the state is read.
            x_t: `[B, C, A]`.
            flow_time: `[B]`.
            action_valid: `[B, C]` bool, what the adapters count; None counts all.

        Returns:
            `[B, 1 + C, D]` f32, and the adapters' reports.
        """
        one, state = jnp.ones((x_t.shape[0], 1), bool), obs.state[:, None].astype(jnp.float32)
        state_token, state_aux = self.state_proj(state, token_mask=one, return_aux=True)
        h, aux = self.action_tokens(x_t, flow_time, action_valid)
        return jnp.concatenate([state_token, h], axis=1), {"state_proj": state_aux, **aux}

    def run_prefix(self, obs: Observation) -> tuple[Prefix, ModelAux]:
        """Everything that does not depend on the actions, once per observation."""
        tokens, valid, vision_aux = self.embed_prefix(obs)
        block = np.zeros(valid.shape[1], int)
        mask = block_mask(block, block, valid, valid)
        out, cache, aux = self.language(tokens, positions(valid), mask, token_mask=valid)
        return Prefix(cache, valid, out), {**vision_aux, "language": aux}

    def run_suffix(
        self,
        prefix: Prefix,
        obs: Observation,
        x_t: jax.Array,
        flow_time: jax.Array,
        action_valid: jax.Array | None = None,
    ) -> tuple[jax.Array, LayerAux]:
        """Velocity `[B, C, A]` f32 given the prefix; arguments as in `embed_suffix`."""
        batch, chunk = x_t.shape[:2]
        if action_valid is None:
            action_valid = jnp.ones((batch, chunk), bool)
        tokens, aux = self.embed_suffix(obs, x_t, flow_time, action_valid)
        condition, time_aux = self.condition(flow_time)
        states = tokens.shape[1] - chunk
        block = np.array([1] * states + [2] * chunk)
        mask, position = suffix_view(prefix.valid, np.zeros(prefix.valid.shape[1], int), block)
        counted = jnp.concatenate([jnp.ones((batch, states), bool), action_valid], axis=1)
        out, _, expert_aux = self.action(
            tokens, position, mask, prefix.cache, token_mask=counted, condition=condition
        )
        out = out[:, -chunk:].astype(jnp.float32)
        v_t, out_aux = self.action_out_proj(out, token_mask=action_valid, return_aux=True)
        return v_t, {**expert_aux, **aux, **time_aux, "action_out_proj": out_aux}

    def condition(self, flow_time: jax.Array) -> tuple[jax.Array | None, LayerAux]:
        """What the action expert's norms follow at `[B]` times, none here; adapters' reports."""
        del flow_time
        return None, {}


class Pi05(Pi0):
    """pi0.5 of any size."""

    make_expert = AdaptiveExpert

    def _make_projections(self, state_width: int, rngs: nnx.Rngs) -> None:
        """The linear maps around the towers: of noisy actions, their time and velocity."""
        del state_width
        width, dim = self.config.action.width, self.config.action_dim
        kinds: Any = {"dtype": jnp.float32, "param_dtype": self.config.param_dtype, "rngs": rngs}
        self.action_in_proj: Layer = Dense(dim, width, **kinds)
        self.time_mlp_in: Layer = Dense(width, width, **kinds)
        self.time_mlp_out: Layer = Dense(width, width, **kinds)
        self.action_out_proj: Layer = Dense(width, dim, **kinds)

    def join_layers(self, *, copy_kernels: bool = True) -> None:
        """See `prepared.JoinsLayers`: the linear maps around the towers, each by itself."""
        self.action_in_proj = join_one(self.action_in_proj, copy_kernels=copy_kernels)
        self.time_mlp_in = join_one(self.time_mlp_in, copy_kernels=copy_kernels)
        self.time_mlp_out = join_one(self.time_mlp_out, copy_kernels=copy_kernels)
        self.action_out_proj = join_one(self.action_out_proj, copy_kernels=copy_kernels)

    def embed_suffix(
        self,
        obs: Observation,
        x_t: jax.Array,
        flow_time: jax.Array,
        action_valid: jax.Array | None = None,
    ) -> tuple[jax.Array, LayerAux]:
        """Tokens `[B, C, D]` f32 of the noisy actions, as in `Pi0`, and the adapters' reports.

        The state is in the prompt and the time in the norms, so `obs` and `flow_time` are not read.
        """
        del obs, flow_time
        x_t = x_t.astype(jnp.float32)
        h, aux = self.action_in_proj(x_t, token_mask=action_valid, return_aux=True)
        return h, {"action_in_proj": aux}

    def condition(self, flow_time: jax.Array) -> tuple[jax.Array, LayerAux]:
        """What the action expert's norms follow at `[B]` times, `[B, 1, D]` f32, and reports."""
        aux: LayerAux = {}
        one = jnp.ones((flow_time.shape[0], 1), bool)
        h = time_embedding(flow_time, self.config.action.width)[:, None]
        h, aux["time_mlp_in"] = self.time_mlp_in(h, token_mask=one, return_aux=True)
        h = jax.nn.silu(h)
        h, aux["time_mlp_out"] = self.time_mlp_out(h, token_mask=one, return_aux=True)
        return jax.nn.silu(h), aux
