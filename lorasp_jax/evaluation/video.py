"""Pictures and videos of recorded episodes."""

from pathlib import Path

import numpy as np
from PIL import Image

from envs.rendering.video import side_by_side, write_video

__all__ = ["FILM_SIZE", "side_by_side", "write_picture", "write_video"]

FILM_SIZE = 192
"""Height and width of each camera in a video [pixels]."""


def write_picture(path: Path, image: np.ndarray) -> None:
    """Write a `[H, W, 3]` uint8 picture."""
    Image.fromarray(image).save(path)
