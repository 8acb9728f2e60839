"""Images and videos of recorded episodes."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from envs.env import Env
from envs.rendering.renderer import RayRenderer
from envs.rendering.video import side_by_side, write_video
from envs.scene.randomization import Draw
from envs.state import Poses

VIDEO_SIZE = 192
"""Height and width of each camera in a video [pixels]."""


def write_episode(env: Env, poses: Poses, path: Path, draw: Draw | None = None) -> None:
    """Render a recorded episode and write it as a video at the control rate.

    Args:
        env: the environment in which the episode was recorded.
        poses: the leading axis is time.
        path: MP4 file to write.
        draw: randomized values of the episode's world, if any.
    """
    frames = side_by_side(render_episode(env, poses, draw, VIDEO_SIZE))
    write_video(path, frames, fps=1 / env.control_dt)


def render_episode(env: Env, poses: Poses, draw: Draw | None, size: int) -> dict[str, np.ndarray]:
    """Render a recorded episode of T frames: camera name -> uint8 `[T, size, size, 3]`.

    Arguments are as in `write_episode`, except `size` [pixels].
    """
    camera = dataclasses.replace(env, renderer=RayRenderer(env.render_model, size, 1))
    each = len(poses.geom_xpos)
    draws = jax.tree.map(lambda x: jnp.broadcast_to(x, (each, *x.shape)), draw)
    images = jax.jit(camera.render)(poses, draw=draws)
    return {name: np.asarray(image) for name, image in images.items()}
