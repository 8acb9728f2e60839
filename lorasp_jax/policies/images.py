"""Convert camera images of any size to square backbone inputs in [-1, 1], padded with black."""

import jax
import jax.numpy as jnp


def to_unit(name: str, image: jax.Array) -> jax.Array:
    """Scale a camera image, uint8 `[B, H, W, 3]`, to f32 in [-1, 1].

    Raises:
        ValueError: wrong dtype or shape; the message names the camera.
    """
    if image.dtype != jnp.uint8 or image.ndim != 4 or image.shape[-1] != 3:
        got = f"{image.dtype} {image.shape}"
        raise ValueError(f"images of {name!r} must be uint8 [B, H, W, 3], got {got}")
    return image.astype(jnp.float32) / 127.5 - 1


def resize_with_pad(
    images: jax.Array, size: int, *, centred: bool = True, antialias: bool = True
) -> jax.Array:
    """Resize `[B, H, W, 3]` to `[B, size, size, 3]`, bilinearly, keeping the aspect ratio.

    The remaining area is padded with black (-1).

    Args:
        images: values in [-1, 1]; images already of this size are returned unchanged.
        size: height and width [pixels].
        centred: center the image, as in openpi (shared/image_tools.py) and LeRobot's pi0. False
            aligns it to the bottom right, as in LeRobot's SmolVLA.
        antialias: smooth before downsampling, as in openpi. PyTorch and LeRobot do not.
    """
    batch, height, width, channels = images.shape
    if height == width == size:
        return images
    # Rounded down as in openpi and LeRobot: 116 pixels scaled to 224 come out as 223.
    ratio = max(width / size, height / size)
    inner = (max(1, int(height / ratio)), max(1, int(width / ratio)))
    shape = (batch, *inner, channels)
    images = jax.image.resize(images, shape, method="linear", antialias=antialias)
    before = [(size - length) // (2 if centred else 1) for length in inner]
    after = [size - length - b for length, b in zip(inner, before, strict=True)]
    pad = [(0, 0), (before[0], after[0]), (before[1], after[1]), (0, 0)]
    return jnp.pad(jnp.clip(images, -1, 1), pad, constant_values=-1)
