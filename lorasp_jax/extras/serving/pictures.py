"""Camera pictures of any client as the square uint8 images that a policy was compiled for."""

from typing import Any

import numpy as np
from PIL import Image

MAX_SIDE = 8192
"""Maximum height and width of a picture [pixels]."""


def to_square(
    name: str, picture: Any, size: int, *, centred: bool = True, antialias: bool = True
) -> np.ndarray:
    """Resize a picture, keeping its aspect ratio, and pad it with black.

    The same as `policies.images.resize_with_pad` up to the rounding of uint8, but on the host, so
    that a new picture size compiles nothing.

    Args:
        name: of the picture, for error messages.
        picture: `[H, W, 3]` or `[3, H, W]`, uint8 or floating point in [0, 1].
        size: height and width of the result [pixels].
        centred: center the picture; False aligns it to the bottom right.
        antialias: smooth before downsampling.

    Returns:
        uint8 `[size, size, 3]`.

    Raises:
        ValueError: wrong dtype, shape or values; the message names the picture.
    """
    picture = to_uint8(name, picture)
    height, width = picture.shape[:2]
    if height == width == size:
        return picture
    # As in `resize_with_pad`, which follows openpi.
    ratio = max(width / size, height / size)
    inner = (max(1, int(height / ratio)), max(1, int(width / ratio)))
    top, left = ((size - length) // (2 if centred else 1) for length in inner)
    result = np.zeros((size, size, 3), np.uint8)
    result[top : top + inner[0], left : left + inner[1]] = _resize(picture, inner, antialias)
    return result


def to_uint8(name: str, picture: Any) -> np.ndarray:
    """Return a picture as uint8 `[H, W, 3]`; arguments and errors are those of `to_square`."""
    picture = _to_height_width_channels(name, picture)
    if picture.dtype == np.uint8:
        return picture
    if picture.dtype.kind != "f":
        raise ValueError(f"{name} must be uint8, or float in [0, 1], got {picture.dtype}")
    if not (picture.min() >= 0 and picture.max() <= 1):  # also false if a value is NaN
        raise ValueError(f"the values of {name} must be finite and in [0, 1]")
    return (picture * 255).astype(np.uint8)  # truncates, as openpi does (policies/libero_policy.py)


def _to_height_width_channels(name: str, picture: Any) -> np.ndarray:
    if not isinstance(picture, np.ndarray) or picture.ndim != 3 or 3 not in picture.shape[::2]:
        is_array = isinstance(picture, np.ndarray)
        got = f"shape {picture.shape}" if is_array else type(picture).__name__
        raise ValueError(f"{name} must be a picture [H, W, 3] or [3, H, W], got {got}")
    if picture.shape[2] != 3:
        picture = picture.transpose(1, 2, 0)
    if not all(0 < side <= MAX_SIDE for side in picture.shape[:2]):
        raise ValueError(
            f"the sides of {name} must be 1 to {MAX_SIDE} pixels, got {picture.shape[:2]}"
        )
    return picture


def _resize(picture: np.ndarray, shape: tuple[int, int], antialias: bool) -> np.ndarray:
    image = Image.fromarray(np.ascontiguousarray(picture))
    height, width = shape
    if antialias:
        return np.asarray(image.resize((width, height), Image.Resampling.BILINEAR))
    scale = (image.width / width, 0, 0, 0, image.height / height, 0)
    return np.asarray(
        image.transform((width, height), Image.Transform.AFFINE, scale, Image.Resampling.BILINEAR)
    )
