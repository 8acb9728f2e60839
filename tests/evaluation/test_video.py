"""The video of a rollout."""

import av
import jax
import numpy as np
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


@pytest.mark.slow
def test_a_randomized_episode_looks_as_the_policy_saw_it():
    env = envs.make("press", num_envs=1, image_size=32, backend="jax")
    ranges = envs.Randomization(brightness=(0.5, 0.5), colour=(-0.2, 0.2), size=(1.2, 1.2))
    state = env.reset(jax.random.key(0), ranges)
    draw = jax.tree.map(lambda x: x[0], state.info["draw"])
    images = video.render_episode(env, Poses.of(state.data), draw, 32)
    for name, seen in env.observe(state)["image"].items():
        np.testing.assert_allclose(images[name], seen, atol=1)
    plain = video.render_episode(env, Poses.of(state.data), None, 32)
    assert plain["side"].mean() > 1.5 * images["side"].mean()
