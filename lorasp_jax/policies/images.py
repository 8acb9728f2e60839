"""Pictures of any size as a backbone sees them: square, in [-1, 1], black around."""

import jax
import jax.numpy as jnp


def to_unit(name: str, image: jax.Array) -> jax.Array:
    """A camera's uint8 `[B, H, W, 3]` as f32 in [-1, 1].

    Raises:
        ValueError: another type or shape; names the camera.
    """
    if image.dtype != jnp.uint8 or image.ndim != 4 or image.shape[-1] != 3:
        raise ValueError(
            f"camera {name!r} needs uint8 [B, H, W, 3], got {image.dtype} {image.shape}."
        )
    return image.astype(jnp.float32) / 127.5 - 1


def resize_with_pad(
    images: jax.Array, size: int, *, centred: bool = True, antialias: bool = True
) -> jax.Array:
    """`[B, H, W, 3]` in [-1, 1] -> `[B, size, size, 3]`: bilinear, aspect kept, black (-1) around.

    Args:
        images: pictures; those of the right size come back as they are.
        size: height and width [pixels].
        centred: the picture is in the middle, as in openpi (shared/image_tools.py) and LeRobot's
            pi0; False: at the right and the bottom, as in LeRobot's SmolVLA.
        antialias: smooth before shrinking, as openpi does and PyTorch, hence LeRobot, does not.
    """
    batch, height, width, channels = images.shape
    if height == width == size:
        return images
    # In floats as both projects have it, where 116 pixels become 223 of 224.
    ratio = max(width / size, height / size)
    inner = (max(1, int(height / ratio)), max(1, int(width / ratio)))
    shape = (batch, *inner, channels)
    images = jax.image.resize(images, shape, method="linear", antialias=antialias)
    before = [(size - length) // (2 if centred else 1) for length in inner]
    after = [size - length - b for length, b in zip(inner, before, strict=True)]
    pad = [(0, 0), (before[0], after[0]), (before[1], after[1]), (0, 0)]
    return jnp.pad(jnp.clip(images, -1, 1), pad, constant_values=-1)
