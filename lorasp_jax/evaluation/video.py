"""Images and videos of recorded episodes."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
from PIL import Image

from envs.env import Env
from envs.rendering.renderer import RayRenderer
from envs.rendering.video import side_by_side, write_video
from envs.state import Poses

__all__ = ["VIDEO_SIZE", "side_by_side", "write_episode", "write_image", "write_video"]

VIDEO_SIZE = 192
"""Height and width of each camera in a video [pixels]."""


def write_image(path: Path, image: np.ndarray) -> None:
    """Write an image, `[H, W, 3]` uint8."""
    Image.fromarray(image).save(path)


def write_episode(env: Env, poses: Poses, path: Path) -> None:
    """Render a recorded episode and write it as a video at the control rate.

    Args:
        env: the environment in which the episode was recorded.
        poses: the leading axis is time.
        path: MP4 file to write.
    """
    renderer = dataclasses.replace(env, renderer=RayRenderer(env.render_model, VIDEO_SIZE, 1))
    images = jax.jit(renderer.render)(poses)
    frames = side_by_side({name: np.asarray(image) for name, image in images.items()})
    write_video(path, frames, fps=1 / env.control_dt)
