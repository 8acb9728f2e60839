"""Test that the reinforcement learning example runs and learns."""

import dataclasses
import functools
import importlib.util
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs import rewards
from envs.state import State, where
from tests import ROOT

PATH = ROOT / "examples" / "ppo.py"


@pytest.fixture(scope="module")
def ppo():
    spec = importlib.util.spec_from_file_location("ppo", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules["ppo"] = module  # dataclasses look up their module here
    spec.loader.exec_module(module)
    yield module
    del sys.modules["ppo"]


def test_advantages_do_not_cross_episodes(ppo):
    config = ppo.Config(num_envs=1, discount=0.5, trace=0.5)
    error, done = jnp.array([[1.0], [2.0], [4.0]]), jnp.array([[False], [True], [False]])
    batch = ppo.Batch(*[None] * 4, error, done, None)
    assert ppo.advantages(config, batch)[:, 0].tolist() == [1 + 0.25 * 2, 2, 4]


def test_running_moments_equal_those_of_all_observations(ppo):
    observations = np.random.default_rng(0).normal(3, 2, (40, 5)).astype(np.float32)
    moments = {"count": jnp.float32(0), "mean": jnp.zeros(5), "variance": jnp.ones(5)}
    for batch in np.split(observations, [7, 20]):
        moments = ppo.update_moments(moments, batch)
    np.testing.assert_allclose(moments["mean"], observations.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(moments["variance"], observations.var(axis=0), rtol=1e-4)


@dataclasses.dataclass(frozen=True, eq=False)
class PointEnv:
    """Stand-in for an environment, which takes a minute to compile: points on a line, goal 0."""

    num_envs: int
    action_low, action_high, max_steps = np.array([-0.2]), np.array([0.2]), 20

    def reset(self, key):
        zero = jnp.zeros(self.num_envs)
        at = jax.random.uniform(key, zero.shape, minval=-2.0, maxval=2.0)
        state = State(at, zero, zero > 0, {}, {"success": zero > 0, "steps": zero})
        return jax.vmap(rewards.at_reset)(state, {"reach": jnp.exp(-jnp.abs(at))})

    def full_state(self, state):
        return jnp.stack([state.data, jnp.ones(self.num_envs)], axis=1)

    def step(self, state, action):
        at = jnp.where(state.done, state.data, state.data + action[:, 0])
        steps = state.info["steps"] + ~state.done
        success = jnp.abs(at) < 0.1
        info, done = {"success": success, "steps": steps}, success | (steps >= self.max_steps)
        after = State(at, state.reward, done, {}, info)
        shares = {"reach": jnp.exp(-jnp.abs(at))}
        after_step = functools.partial(rewards.after_step, discount=0.97)
        return jax.vmap(after_step)(state, after, shares)

    def reset_done(self, state, key):
        return where(state.done, self.reset(key), state)


def test_it_learns_to_move_a_point(ppo, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(ppo, "make", lambda config, num_envs, **_: PointEnv(num_envs))
    monkeypatch.setattr(ppo.messages, "PATIENCE", 0.0)
    config = ppo.Config(num_envs=32, updates=15, learning_rate=3e-3, episodes=64, out=tmp_path)
    before = ppo.update._cache_size()
    assert ppo.main(config) >= 0.95
    assert ppo.update._cache_size() - before == 1  # later updates do not recompile
    printed, messages = capsys.readouterr()
    assert "compiling an update of press" in messages
    assert "compiling the evaluation of press" in messages
    lines = printed.splitlines()
    assert lines[14].startswith("   15,360 steps")
    assert " of 64 unseen layouts" in lines[15]
    assert (tmp_path / "curve.png").stat().st_size > 1000


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_it_learns_to_press(ppo, tmp_path):
    assert ppo.main(ppo.Config(out=tmp_path)) >= 0.9
