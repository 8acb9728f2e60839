"""Base class of VLA backbones: image encoding, flow-matching loss, action sampling."""

import importlib
import pkgutil
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.adapters.layers.prepared import Layer
from lorasp_jax.dense import Dense
from lorasp_jax.kernels.low_rank_matmul import Mask
from lorasp_jax.models import flow_matching
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.observation import Observation
from lorasp_jax.models.sampling import Sampler
from lorasp_jax.models.transformer.layers import (
    LayerAux,
    ModelAux,
    block_mask,
    merge_action_aux,
    positions,
    time_embedding,
)
from lorasp_jax.models.transformer.siglip import SigLIP

_PACKAGE = __name__.rpartition(".")[0]


def names() -> list[str]:
    """List the available backbones: sibling packages that define a `Config`."""
    path = importlib.import_module(_PACKAGE).__path__
    packages = [module.name for module in pkgutil.iter_modules(path) if module.ispkg]
    return sorted(
        n for n in packages if hasattr(importlib.import_module(f"{_PACKAGE}.{n}"), "Config")
    )


def find(name: str) -> type[BackboneConfig]:
    """Return the config class of a backbone.

    Raises:
        ValueError: unknown backbone.
    """
    if name not in names():
        raise ValueError(f"unknown backbone {name!r}: choose one of {', '.join(names())}")
    return importlib.import_module(f"{_PACKAGE}.{name}").Config


class Backbone(nnx.Module):
    """A vision-language model with an action expert.

    Subclasses implement `run_prefix`, which runs once per observation, and `run_suffix`, which runs
    at every flow step. Both also return aux, the adapters' losses and statistics.
    """

    config: BackboneConfig
    vision: SigLIP
    language: Any
    """The language model, with stacked `blocks`."""
    action: Any
    """The action expert, with stacked `blocks`."""
    noise_actor: nnx.Param[Any] | None = None
    """The `NoiseActor` that chooses the initial noise of the flow; None: it is standard normal."""
    flow_layers: ClassVar[str] = "^(state_proj|action|time_mlp)"
    """Pattern of the paths of all layers that `run_suffix` uses."""

    def _make_projections(self, state_width: int, rngs: nnx.Rngs) -> None:
        """Create the layers outside the towers; `state_width` is the width of the state token."""
        width, dim = self.config.action.width, self.config.action_dim
        options: Any = {"dtype": jnp.float32, "param_dtype": self.config.param_dtype, "rngs": rngs}
        self.state_proj: Layer = Dense(dim, state_width, **options)
        self.action_in_proj: Layer = Dense(dim, width, **options)
        self.action_time_mlp_in: Layer = Dense(2 * width, width, **options)
        self.action_time_mlp_out: Layer = Dense(width, width, **options)
        self.action_out_proj: Layer = Dense(width, dim, **options)

    def embed_actions(
        self, x_t: jax.Array, flow_time: jax.Array, action_valid: Mask
    ) -> tuple[jax.Array, LayerAux]:
        """Embed noisy actions and flow time as action tokens.

        Args:
            x_t: `[B, C, A]`.
            flow_time: `[B]`, or `[B, C]` with one time per action.
            action_valid: `[B, C]` bool, False excludes an action from aux.

        Returns:
            `[B, C, D]` f32, and the adapters' aux.
        """
        aux: LayerAux = {}
        x_t, token_mask = x_t.astype(jnp.float32), action_valid
        h, aux["action_in_proj"] = self.action_in_proj(x_t, token_mask=token_mask, return_aux=True)
        time = time_embedding(flow_time, h.shape[-1])
        h = jnp.concatenate([h, jnp.broadcast_to(time, h.shape)], axis=-1)
        h, in_aux = self.action_time_mlp_in(h, token_mask=token_mask, return_aux=True)
        h = jax.nn.silu(h)
        h, out_aux = self.action_time_mlp_out(h, token_mask=token_mask, return_aux=True)
        return h, aux | {"action_time_mlp_in": in_aux, "action_time_mlp_out": out_aux}

    def run_prefix(self, obs: Observation) -> tuple[Any, ModelAux]:
        """Encode the observation for `run_suffix`.

        The result has a method `by_layer`, which splits all that is stacked over layers.
        """
        raise NotImplementedError

    def run_suffix(
        self,
        prefix: Any,
        obs: Observation,
        x_t: jax.Array,
        flow_time: jax.Array,
        action_valid: Mask = None,
    ) -> tuple[jax.Array, LayerAux]:
        """Predict the velocity `[B, C, A]` f32.

        Args:
            prefix: result of `run_prefix` for `obs`.
            obs: the observation.
            x_t: `[B, C, A]`.
            flow_time: `[B]`, or `[B, C]` with one time per action.
            action_valid: `[B, C]` bool, False excludes an action from aux.
        """
        raise NotImplementedError

    def encode_images(self, obs: Observation) -> tuple[jax.Array, jax.Array, ModelAux]:
        """Encode the images as tokens, in the order of `config.cameras`.

        Returns:
            tokens `[B, P, D]`, valid `[B, P]` bool, aux of the vision tower's adapters.

        Raises:
            ValueError: a camera is missing or an image has the wrong size.
        """
        cameras, size = self.config.cameras, self.config.image_size
        for name in cameras:
            if name not in obs.images or obs.images[name].shape[1:] != (size, size, 3):
                shapes = {camera: image.shape[1:] for camera, image in obs.images.items()}
                raise ValueError(f"images of {cameras} must be {(size, size, 3)}, got {shapes}")
        images = jnp.stack([obs.images[name] for name in cameras], axis=1)
        present = jnp.stack([obs.image_masks[name] for name in cameras], axis=1)
        features, aux = self.vision(images.reshape(-1, size, size, 3), present.reshape(-1))
        tokens = features.reshape(images.shape[0], -1, features.shape[-1])
        valid = jnp.repeat(present, self.config.image_tokens, axis=1)
        return tokens, valid, {"vision": aux}

    def velocity(self, obs: Observation, x_t: jax.Array, flow_time: jax.Array) -> jax.Array:
        """Compute v_t `[B, C, A]` at x_t `[B, C, A]` and flow_time (1 = noise, 0 = data).

        `flow_time` is `[B]`, or `[B, C]` with one time per action.
        """
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
        """Compute the flow-matching loss. Do not reuse the key.

        Args:
            key: typed PRNG key to sample `noise` and `flow_time` if they are not given.
            obs: the observation.
            actions: `[B, C, A]` normalized.
            action_mask: `[B, C, A]` bool, True for valid elements. It does not mask the returned
                loss. Slots that are never valid in a chunk are zero in x_t. Actions without valid
                slots are excluded from the adapters' aux.
            noise: `[B, C, A]`.
            flow_time: `[B]`, or `[B, C]` with one time per action; see `flow_matching.draw`.

        Returns:
            `[B, C, A]` f32 per-element squared errors, and the adapters' aux.
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
        return per_element, merge_action_aux(aux, action_aux)

    def run_flow(
        self,
        prefix: Any,
        obs: Observation,
        noise: jax.Array,
        *,
        num_steps: int,
        slots: jax.Array | None = None,
        action_valid: Mask = None,
    ) -> tuple[jax.Array, LayerAux]:
        """Sample chunks as `sample_actions` does up to rounding, but differentiably.

        Args:
            prefix: result of `run_prefix` for `obs`.
            obs: the observation.
            noise: `[B, C, A]` initial noise of the flow.
            num_steps: Euler steps.
            slots: bool broadcastable to `[B, C, A]`; see `flow_matching.sample`.
            action_valid: see `run_suffix`.

        Returns:
            `[B, C, A]` f32 normalized actions, and the adapters' aux of the last step.
        """
        velocity = lambda x_t, t: self.run_suffix(prefix, obs, x_t, t, action_valid)  # noqa: E731
        chunk, aux = flow_matching.sample(velocity, noise, num_steps=num_steps, slots=slots)
        return chunk, jax.tree.map(lambda x: x[-1], aux)

    def sample_actions(self, key: jax.Array, obs: Observation, **options: Any) -> Any:
        """Sample action chunks; see `Sampler.sample_actions` for the arguments."""
        return Sampler.from_model(self, once=True).sample_actions(key, obs, **options)

    def sampler(self) -> Sampler:
        """Create a sampler, which prepares the weights once for repeated sampling."""
        return Sampler.from_model(self)


def suffix_mask_and_positions(
    prefix_valid: jax.Array, prefix_block: np.ndarray, block: np.ndarray
) -> tuple[jax.Array, jax.Array]:
    """Compute the attention mask and positions of the suffix tokens, which are all valid.

    Args:
        prefix_valid: `[B, P]` bool.
        prefix_block: `[P]` int, block number of each prefix token; see `block_mask`.
        block: `[T]` int, block number of each suffix token.

    Returns:
        mask `[B, T, P + T]` bool, and positions `[B, T]` int32 that continue those of the prefix.
    """
    valid = jnp.ones((len(prefix_valid), len(block)), bool)
    key_block = np.concatenate([prefix_block, block])
    mask = block_mask(block, key_block, valid, jnp.concatenate([prefix_valid, valid], axis=1))
    return mask, jnp.sum(prefix_valid, axis=1, dtype=jnp.int32)[:, None] + positions(valid)
