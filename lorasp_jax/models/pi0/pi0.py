"""pi0 (Black et al., arXiv 2410.24164): flow matching over actions on a vision-language model.

Tokens fall into three blocks: [pictures, instruction], [state], [noisy actions]; each sees itself
and the blocks before it. The first is the prefix, the other two the suffix of the action expert.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.dense import Dense
from lorasp_jax.models import flow_matching
from lorasp_jax.models.layers import LayerAux, Linears, block_mask, positions, time_embedding
from lorasp_jax.models.observation import Observation
from lorasp_jax.models.pi0.config import Pi0Config
from lorasp_jax.models.pi0.gemma import Expert, KeysValues, LanguageExpert
from lorasp_jax.models.pi0.siglip import SigLIP

ModelAux = dict[str, LayerAux]
"""Adapters' reports by tower ("vision", "language", "action") and layer name."""


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


class Pi0(nnx.Module):
    """pi0 of any size."""

    def __init__(self, config: Pi0Config, *, rngs: nnx.Rngs) -> None:
        width, dim = config.action.width, config.action_dim
        kinds: dict[str, Any] = {
            "dtype": jnp.float32,
            "param_dtype": config.param_dtype,
            "rngs": rngs,
        }
        self.config = config
        self.vision = SigLIP(config, rngs=rngs)
        self.language = LanguageExpert(config.language, config, rngs=rngs)
        self.action = Expert(config.action, config, rngs=rngs)
        self.state_proj = Dense(dim, width, **kinds)
        self.action_in_proj = Dense(dim, width, **kinds)
        self.action_time_mlp_in = Dense(2 * width, width, **kinds)
        self.action_time_mlp_out = Dense(width, width, **kinds)
        self.action_out_proj = Dense(width, dim, **kinds)

    def embed_prefix(self, obs: Observation) -> tuple[jax.Array, jax.Array, LayerAux]:
        """Tokens of pictures and instruction.

        Returns:
            tokens `[B, P, D]`, valid `[B, P]` bool, reports of the vision tower's adapters.

        Raises:
            ValueError: a camera is missing or a picture has the wrong size.
        """
        cameras, size = self.config.cameras, self.config.image_size
        for name in cameras:
            if name not in obs.images or obs.images[name].shape[1:] != (size, size, 3):
                found = {camera: image.shape[1:] for camera, image in obs.images.items()}
                raise ValueError(f"need pictures {(size, size, 3)} of {cameras}, got {found}.")
        images = jnp.stack([obs.images[name] for name in cameras], axis=1)
        present = jnp.stack([obs.image_masks[name] for name in cameras], axis=1)
        batch = images.shape[0]
        seen, aux = self.vision(images.reshape(-1, size, size, 3), present.reshape(-1))
        text = self.language.embed(obs.tokens)
        tokens = jnp.concatenate([seen.reshape(batch, -1, seen.shape[-1]), text], axis=1)
        image_valid = jnp.repeat(present, self.config.image_tokens, axis=1)
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
        state = Linears(self, jnp.ones((x_t.shape[0], 1), bool))
        actions = Linears(self, action_valid)
        state_token = state("state_proj", obs.state[:, None].astype(jnp.float32))
        h = actions("action_in_proj", x_t.astype(jnp.float32))
        time = time_embedding(flow_time, h.shape[-1])[:, None]
        h = jnp.concatenate([h, jnp.broadcast_to(time, h.shape)], axis=-1)
        h = jax.nn.silu(actions("action_time_mlp_in", h))
        h = actions("action_time_mlp_out", h)
        return jnp.concatenate([state_token, h], axis=1), {**state.aux, **actions.aux}

    def run_prefix(self, obs: Observation) -> tuple[Prefix, ModelAux]:
        """Everything that does not depend on the actions, once per observation."""
        tokens, valid, vision_aux = self.embed_prefix(obs)
        block = np.zeros(valid.shape[1], int)
        mask = block_mask(block, block, valid, valid)
        out, cache, aux = self.language(tokens, positions(valid), mask, token_mask=valid)
        return Prefix(cache, valid, out), {"vision": vision_aux, "language": aux}

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
        valid = jnp.ones(tokens.shape[:2], bool)
        block = np.array([1] + [2] * chunk)
        seen = np.concatenate([np.zeros(prefix.valid.shape[1], int), block])
        mask = block_mask(block, seen, valid, jnp.concatenate([prefix.valid, valid], axis=1))
        position = jnp.sum(prefix.valid, axis=1, dtype=jnp.int32)[:, None] + positions(valid)
        counted = jnp.concatenate([valid[:, :1], action_valid], axis=1)
        out, _, expert_aux = self.action(tokens, position, mask, prefix.cache, token_mask=counted)
        linear = Linears(self, action_valid)
        v_t = linear("action_out_proj", out[:, -chunk:].astype(jnp.float32))
        return v_t, {**expert_aux, **aux, **linear.aux}

    def velocity(self, obs: Observation, x_t: jax.Array, flow_time: jax.Array) -> jax.Array:
        """Velocity v_t `[B, C, A]` at x_t `[B, C, A]` and flow_time `[B]` (1 noise, 0 data)."""
        prefix, _ = self.run_prefix(obs)
        return self.run_suffix(prefix, obs, x_t, flow_time)[0]

    def loss(
        self,
        key: jax.Array,
        obs: Observation,
        actions: jax.Array,
        *,
        action_mask: jax.Array | None = None,
        noise: jax.Array | None = None,
        flow_time: jax.Array | None = None,
    ) -> tuple[jax.Array, ModelAux]:
        """Flow-matching error; the key is consumed.

        Args:
            key: typed random key for what of `noise`, `flow_time` is not given.
            obs: what the policy sees.
            actions: `[B, C, A]` normalised.
            action_mask: `[B, C, A]` bool. Slots without any valid step are held at zero in x_t, and
                adapters do not count steps without any valid slot. The error itself is not masked.
            noise: `[B, C, A]`.
            flow_time: `[B]`.

        Returns:
            `[B, C, A]` f32 squared errors, not reduced, and the adapters' reports.
        """
        slots = None if action_mask is None else action_mask.any(axis=1, keepdims=True)
        valid = None if action_mask is None else action_mask.any(axis=2)
        prefix, aux = self.run_prefix(obs)
        per_element, action_aux = flow_matching.loss(
            lambda x_t, t: self.run_suffix(prefix, obs, x_t, t, valid),
            key,
            actions,
            slots=slots,
            noise=noise,
            flow_time=flow_time,
        )
        return per_element, {**aux, "action": action_aux}

    def sample_actions(
        self,
        key: jax.Array,
        obs: Observation,
        *,
        num_steps: int = 10,
        noise: jax.Array | None = None,
        slots: jax.Array | None = None,
        return_aux: bool = False,
    ) -> Any:
        """Draw action chunks; the key is consumed for `noise` if that is not given.

        Args:
            key: typed random key.
            obs: what the policy sees.
            num_steps: Euler steps.
            noise: `[B, C, A]` start of the flow.
            slots: `[A]` bool, the robot's slots; the others stay zero. None: all.
            return_aux: also return the adapters' reports; those of "action" get a leading axis of
                steps, before the layers'.

        Returns:
            `[B, C, A]` f32 normalised actions, or (actions, aux).
        """
        if noise is None:
            shape = (obs.state.shape[0], self.config.chunk, self.config.action_dim)
            noise = jax.random.normal(key, shape)
        prefix, aux = self.run_prefix(obs)
        actions, action_aux = flow_matching.sample(
            lambda x_t, t: self.run_suffix(prefix, obs, x_t, t),
            noise,
            num_steps=num_steps,
            slots=slots,
        )
        return (actions, {**aux, "action": action_aux}) if return_aux else actions
