"""Observations as backbones expect them: normalized and tokenized."""

from dataclasses import dataclass
from typing import Any

import jax

from lorasp_jax.models.config import BackboneConfig


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Observation:
    """Input of every backbone.

    Attributes:
        images: camera name -> `[B, H, W, 3]` f32 in [-1, 1].
        image_masks: camera name -> `[B]` bool, False where the camera is missing.
        tokens: `[B, T]` int32 ids of the instruction, padded.
        token_mask: `[B, T]` bool, False at padding.
        state: `[B, A]` f32, normalized robot state in the backbone's slots.
    """

    images: dict[str, jax.Array]
    image_masks: dict[str, jax.Array]
    tokens: jax.Array
    token_mask: jax.Array
    state: jax.Array


def abstract_observation(config: BackboneConfig, batch: int) -> Observation:
    """Create an observation of ShapeDtypeStructs with the shapes of a backbone's inputs."""

    def abstract(dtype: str, *shape: int) -> Any:
        return jax.ShapeDtypeStruct((batch, *shape), dtype)

    size = config.image_size
    return Observation(
        images={name: abstract("float32", size, size, 3) for name in config.cameras},
        image_masks={name: abstract("bool") for name in config.cameras},
        tokens=abstract("int32", config.max_tokens),
        token_mask=abstract("bool", config.max_tokens),
        state=abstract("float32", config.action_dim),
    )
