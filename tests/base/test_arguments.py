"""Invalid arguments raise errors of one sentence before anything is compiled."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.interop.brax import BraxEnv
from envs.interop.gymnasium import VectorEnv

KEY = jax.random.key(0)
NUMBER = ("num_envs", "image_size", "antialias", "distractors")


@pytest.fixture(scope="module")
def worlds():
    """Return an environment that is never compiled, and the shapes of its state."""
    env = envs.make("press", num_envs=2, image_size=8)
    shapes = jax.eval_shape(env.reset, KEY)
    return env, jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)


@pytest.mark.parametrize(
    ("arguments", "valid"),
    [
        *[({"task": bad}, "open_pot, pick_place") for bad in ("prss", 3)],
        ({"robot": "pipe"}, "panda, piper"),
        ({"robot": f"{300 * 'a'}.xml"}, "damaged"),
        *[({name: bad}, name) for name in NUMBER for bad in (2.5, True, -1, 10**12)],
        *[({"num_envs": bad}, "num_envs") for bad in (np.nan, "3", None, [4])],
        *[({"control_dt": bad}, "control_dt") for bad in (0.03, 0.0, 1e308, np.inf, "3", True)],
        ({"actions": "voltage"}, "joint, delta_joint"),
        ({"discount": True}, "discount"),
        *[({"backend": bad}, "jax, warp") for bad in ("", 7)],
        ({"renderer": None}, "rays, warp"),
    ],
    ids=str,
)
def test_make(arguments, valid):
    with pytest.raises((TypeError, ValueError), match=valid):
        envs.make(**{"task": "press", **arguments})


def test_numpy_numbers_are_accepted():
    env = envs.make("press", num_envs=np.int64(2), control_dt=np.float32(0.5))
    assert (env.num_envs, env.max_steps) == (2, 16)


@pytest.mark.parametrize("raw", [jax.random.PRNGKey(0), np.zeros(2, np.uint32)])
def test_raw_keys_are_accepted(worlds, raw):
    assert jax.eval_shape(worlds[0].reset, raw).done.shape == (2,)


@pytest.mark.parametrize("action", [np.zeros((2, 6)), np.zeros(7), [[0.0] * 7]])
def test_actions_of_another_shape(worlds, action):
    """They would be broadcast."""
    env, state = worlds
    with pytest.raises(ValueError, match=r"action .*2, 7"):
        env.step(state, action)
    with pytest.raises(ValueError, match=r"action .*2, 7"):
        jax.eval_shape(lambda k: env.rollout(lambda seen, key: jnp.zeros(7), k), KEY)


@pytest.mark.parametrize(
    "bad",
    [5, None, "ab", ("a", "b"), (0, [1]), (True, True), (1, 2, 3), (2, 1), (0, np.nan), (1, 1e300)],
    ids=str,
)
def test_ranges(worlds, bad):
    with pytest.raises(ValueError, match="position"):
        worlds[0].reset(KEY, envs.Randomization(position=bad))
    for wrap in (VectorEnv, BraxEnv):
        with pytest.raises(ValueError, match="position"):
            wrap(worlds[0], ranges=envs.Randomization(position=bad))


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        *[("num_episodes", 2.5), ("num_episodes", 10**12), ("num_envs", 2.5)],
        *[("action_noise", "a"), ("action_noise", -1.0)],
    ],
)
def test_collect(name, bad):
    with pytest.raises((TypeError, ValueError), match=name):
        envs.collect("press", **{"num_episodes": 1, "key": KEY, name: bad})
