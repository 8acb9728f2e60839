"""The video of a rollout."""

import av
import jax
import pytest

import envs
from envs.state import Poses
from lorasp_jax.evaluation import video


@pytest.mark.slow
def test_video_size_is_independent_of_the_policy(tmp_path):
    env = envs.make("press", num_envs=2, image_size=16, backend="jax")
    data = env.reset(jax.random.key(0)).data
    video.write_episode(env, Poses.of(data), tmp_path / "video.mp4")
    with av.open(str(tmp_path / "video.mp4")) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert [frame.shape for frame in frames] == [(video.VIDEO_SIZE, 2 * video.VIDEO_SIZE, 3)] * 2
