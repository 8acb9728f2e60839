"""The film of a rollout."""

import av
import jax
import pytest

import envs
from envs.state import Poses
from lorasp_jax.evaluation import video


@pytest.mark.slow
def test_a_film_has_its_own_size(tmp_path):
    env = envs.make("press", num_envs=2, image_size=16, backend="jax")
    data = env.reset(jax.random.key(0)).data
    video.write_film(env, Poses.of(data), tmp_path / "film.mp4")
    with av.open(str(tmp_path / "film.mp4")) as film:
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert [frame.shape for frame in frames] == [(video.FILM_SIZE, 2 * video.FILM_SIZE, 3)] * 2
