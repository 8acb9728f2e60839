"""What every backbone does: look at pictures, match flows, draw action chunks."""

import importlib
import pkgutil
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.adapters.layers.prepared import Layer, join_one
from lorasp_jax.dense import Dense
from lorasp_jax.models import flow_matching
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.observation import Observation
from lorasp_jax.models.sampling import Sampler
from lorasp_jax.models.transformer.layers import (
    LayerAux,
    ModelAux,
    block_mask,
    positions,
    time_embedding,
    with_action,
)
from lorasp_jax.models.transformer.siglip import SigLIP

_PACKAGE = __name__.rpartition(".")[0]


def names() -> list[str]:
    """Names of the backbones: the folders beside this file that define a `Config`."""
    here = importlib.import_module(_PACKAGE).__path__
    folders = [module.name for module in pkgutil.iter_modules(here) if module.ispkg]
    return sorted(
        n for n in folders if hasattr(importlib.import_module(f"{_PACKAGE}.{n}"), "Config")
    )


def find(name: str) -> type[BackboneConfig]:
    """The class of configs of a backbone.

    Raises:
        ValueError: there is no such backbone; lists what exists.
    """
    if name not in names():
        raise ValueError(f"unknown backbone {name!r}: it is one of {', '.join(names())}.")
    return importlib.import_module(f"{_PACKAGE}.{name}").Config


class Backbone(nnx.Module):
    """A vision-language model with an action expert.

    A backbone says what is computed once per observation, `run_prefix`, and what in every step of
    the flow, `run_suffix`.
    """

    config: BackboneConfig
    vision: SigLIP
    language: Any
    """The language model, with stacked `blocks`."""
    action: Any
    """The action expert, with stacked `blocks`."""

    def _make_projections(self, state_width: int, rngs: nnx.Rngs) -> None:
        """The linear maps around the towers: of state, noisy actions, their time and velocity."""
        width, dim = self.config.action.width, self.config.action_dim
        kinds: Any = {"dtype": jnp.float32, "param_dtype": self.config.param_dtype, "rngs": rngs}
        self.state_proj: Layer = Dense(dim, state_width, **kinds)
        self.action_in_proj: Layer = Dense(dim, width, **kinds)
        self.action_time_mlp_in: Layer = Dense(2 * width, width, **kinds)
        self.action_time_mlp_out: Layer = Dense(width, width, **kinds)
        self.action_out_proj: Layer = Dense(width, dim, **kinds)

    def join_layers(self, *, copy_kernels: bool = True) -> None:
        """See `prepared.JoinsLayers`: the linear maps around the towers, each by itself."""
        self.state_proj = join_one(self.state_proj, copy_kernels=copy_kernels)
        self.action_in_proj = join_one(self.action_in_proj, copy_kernels=copy_kernels)
        self.action_time_mlp_in = join_one(self.action_time_mlp_in, copy_kernels=copy_kernels)
        self.action_time_mlp_out = join_one(self.action_time_mlp_out, copy_kernels=copy_kernels)
        self.action_out_proj = join_one(self.action_out_proj, copy_kernels=copy_kernels)

    def action_tokens(
        self, x_t: jax.Array, flow_time: jax.Array, action_valid: jax.Array | None
    ) -> tuple[jax.Array, LayerAux]:
        """Tokens of noisy actions that carry their time.

        Args:
            x_t: `[B, C, A]`.
            flow_time: `[B]`.
            action_valid: `[B, C]` bool, what the adapters count; None counts all.

        Returns:
            `[B, C, D]` f32, and the adapters' reports.
        """
        aux: LayerAux = {}
        x_t, counted = x_t.astype(jnp.float32), action_valid
        h, aux["action_in_proj"] = self.action_in_proj(x_t, token_mask=counted, return_aux=True)
        time = time_embedding(flow_time, h.shape[-1])[:, None]
        h = jnp.concatenate([h, jnp.broadcast_to(time, h.shape)], axis=-1)
        h, mixed = self.action_time_mlp_in(h, token_mask=counted, return_aux=True)
        h, out = self.action_time_mlp_out(jax.nn.silu(h), token_mask=counted, return_aux=True)
        return h, aux | {"action_time_mlp_in": mixed, "action_time_mlp_out": out}

    def run_prefix(self, obs: Observation) -> tuple[Any, ModelAux]:
        """Everything that does not depend on the actions, once per observation."""
        raise NotImplementedError

    def run_suffix(
        self,
        prefix: Any,
        obs: Observation,
        x_t: jax.Array,
        flow_time: jax.Array,
        action_valid: jax.Array | None = None,
    ) -> tuple[jax.Array, LayerAux]:
        """Velocity `[B, C, A]` f32 given the prefix.

        Args:
            prefix: from `run_prefix`.
            obs: what the prefix was made of.
            x_t: `[B, C, A]`.
            flow_time: `[B]`.
            action_valid: `[B, C]` bool, what the adapters count; None counts all.
        """
        raise NotImplementedError

    def look(self, obs: Observation) -> tuple[jax.Array, jax.Array, ModelAux]:
        """Tokens of the pictures, camera by camera.

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
        seen, aux = self.vision(images.reshape(-1, size, size, 3), present.reshape(-1))
        tokens = seen.reshape(images.shape[0], -1, seen.shape[-1])
        valid = jnp.repeat(present, self.config.image_tokens, axis=1)
        return tokens, valid, {"vision": aux}

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
        return per_element, with_action(aux, action_aux)

    def sample_actions(self, key: jax.Array, obs: Observation, **options: Any) -> Any:
        """Draw action chunks: `Sampler.sample_actions`, whose options it takes."""
        return self.sampler().sample_actions(key, obs, **options)

    def sampler(self) -> Sampler:
        """Itself for many calls of `sample_actions`."""
        return Sampler.of(self)


def suffix_view(
    prefix_valid: jax.Array, prefix_block: np.ndarray, block: np.ndarray
) -> tuple[jax.Array, jax.Array]:
    """What tokens behind the prefix see, and where they are.

    Args:
        prefix_valid: `[B, P]` bool.
        prefix_block: `[P]` int, number of the block each prefix token belongs to.
        block: `[T]` int, of the tokens behind it, all of them valid.

    Returns:
        mask `[B, T, P + T]` bool, positions `[B, T]` int32, counted on from the prefix.
    """
    valid = jnp.ones((len(prefix_valid), len(block)), bool)
    seen = np.concatenate([prefix_block, block])
    mask = block_mask(block, seen, valid, jnp.concatenate([prefix_valid, valid], axis=1))
    return mask, jnp.sum(prefix_valid, axis=1, dtype=jnp.int32)[:, None] + positions(valid)
