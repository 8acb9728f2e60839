"""Pictures as JPEG, for links that are slower than the policy.

In a request, bytes in place of an array are a JPEG file. A server says in its metadata's
`encodings` that it reads them; openpi's servers do not.
"""

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from PIL import Image
from PIL.JpegImagePlugin import JpegImageFile

from lorasp_jax.extras.serving.pictures import to_uint8

MAX_BYTES = 8 * 2**20
"""Maximum size of a file [bytes]."""
MAX_PIXELS = 2**23
"""Maximum number of pixels, enough for 3840 x 2160."""
MAX_SCANS = 4
"""Maximum number of scans, of which cameras write 1. Each costs the time of decoding all pixels,
however few bytes it has."""
_SCAN = b"\xff\xda"  # occurs nowhere else: within a scan, ff is followed by 0 or a restart marker


def compress(observation: Mapping[str, Any], quality: int) -> dict[str, Any]:
    """Return an observation with JPEG in place of its pictures, the arrays with three axes.

    Args:
        observation: one of the request forms of `lorasp_jax.extras.serving.requests`.
        quality: 1 to 100, libjpeg's.

    Raises:
        ValueError: such an array is no picture, or has values outside of [0, 1].
    """
    compressed = {}
    for key, value in observation.items():
        if isinstance(value, Mapping):
            value = compress(value, quality)
        elif isinstance(value, np.ndarray) and value.ndim == 3:
            value = encode(key, value, quality)
        compressed[key] = value
    return compressed


def encode(name: str, picture: np.ndarray, quality: int) -> bytes:
    """Return a picture, of any form that `pictures.to_uint8` accepts, as a JPEG file."""
    file = io.BytesIO()
    image = Image.fromarray(np.ascontiguousarray(to_uint8(name, picture)))
    image.save(file, "JPEG", quality=quality)
    return file.getvalue()


def decode(name: str, data: bytes) -> np.ndarray:
    """Return the picture of a JPEG file from outside, uint8 `[H, W, 3]`.

    Raises:
        ValueError: it is too large, judged before anything is decoded, or damaged; the message
            names the picture.
    """
    if len(data) > MAX_BYTES:
        raise ValueError(f"{name} must have at most {MAX_BYTES} bytes as JPEG, got {len(data)}")
    if (scans := data.count(_SCAN)) > MAX_SCANS:
        raise ValueError(f"{name} must be a JPEG of at most {MAX_SCANS} scans, got {scans}")
    try:
        image = JpegImageFile(io.BytesIO(data))  # reads the headers only
        if image.width * image.height > MAX_PIXELS:
            got = f"{image.height} x {image.width}"
            raise ValueError(f"{name} must have at most {MAX_PIXELS} pixels as JPEG, got {got}")
        return np.asarray(image.convert("RGB"))
    except (OSError, SyntaxError) as error:
        raise ValueError(f"{name} must be an array or an undamaged JPEG file") from error
