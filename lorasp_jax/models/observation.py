"""What a vision-language-action model sees, already normalised and tokenised."""

from dataclasses import dataclass

import jax


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Observation:
    """Input of every backbone.

    Attributes:
        images: camera name -> `[B, H, W, 3]` f32 in [-1, 1].
        image_masks: camera name -> `[B]` bool, False where the camera is missing.
        tokens: `[B, T]` int32 ids of the instruction, padded.
        token_mask: `[B, T]` bool, False at padding.
        state: `[B, A]` f32, normalised robot state in the policy's slots.
    """

    images: dict[str, jax.Array]
    image_masks: dict[str, jax.Array]
    tokens: jax.Array
    token_mask: jax.Array
    state: jax.Array
