"""Pictures and videos of recorded episodes."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
from PIL import Image

from envs.env import Env
from envs.rendering.renderer import RayRenderer
from envs.rendering.video import side_by_side, write_video
from envs.state import Poses

__all__ = ["FILM_SIZE", "side_by_side", "write_film", "write_picture", "write_video"]

FILM_SIZE = 192
"""Height and width of each camera in a video [pixels]."""


def write_picture(path: Path, image: np.ndarray) -> None:
    """Write a `[H, W, 3]` uint8 picture."""
    Image.fromarray(image).save(path)


def write_film(env: Env, poses: Poses, path: Path) -> None:
    """Render an episode at film size and write it at the control rate.

    Args:
        env: where it was recorded.
        poses: of geoms and cameras, leading axis `[T]`.
        path: an MP4 file.
    """
    camera = dataclasses.replace(env, renderer=RayRenderer(env.render_model, FILM_SIZE, 1))
    images = jax.jit(camera.render)(poses)
    frames = side_by_side({name: np.asarray(image) for name, image in images.items()})
    write_video(path, frames, fps=1 / env.control_dt)
