"""Invalid arguments raise errors of one sentence before anything is compiled."""

import dataclasses

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
        *[({"robot": bad}, "panda, piper") for bad in ("pipe", 5, b"piper")],
        ({"robot": f"{300 * 'a'}.xml"}, "no such file"),
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


@pytest.mark.parametrize("key", [None, 0, "a", np.zeros(3), jax.random.split(KEY)], ids=str)
def test_keys(worlds, key):
    env, state = worlds
    calls = [
        lambda: env.reset(key),
        lambda: env.reset_done(state, key),
        lambda: env.rollout(lambda seen, key: 0, key),
        lambda: envs.expert_success("press", num_episodes=1, key=key),
        lambda: envs.collect("press", num_episodes=1, key=key),
    ]
    for call in calls:
        with pytest.raises(TypeError, match="key"):
            call()


@pytest.mark.parametrize("raw", [jax.random.PRNGKey(0), np.zeros(2, np.uint32)])
def test_raw_keys_are_accepted(worlds, raw):
    assert jax.eval_shape(worlds[0].reset, raw).done.shape == (2,)


@pytest.mark.parametrize(
    "action",
    [[[0.0] * 7] * 2, None, np.full((2, 7), "a"), np.zeros((2, 7), bool), np.zeros((2, 6))],
)
def test_actions(worlds, action):
    env, state = worlds
    with pytest.raises((TypeError, ValueError), match=r"action .*2, 7"):
        env.step(state, action)


def test_states(worlds):
    env, state = worlds
    other = dataclasses.replace(env, num_envs=3)
    for call in (
        env.observe,
        env.proprio,
        env.full_state,
        lambda s: env.step(s, np.zeros((2, 7))),
        lambda s: env.reset_done(s, KEY),
    ):
        with pytest.raises(TypeError, match="state from reset"):
            call(None)
    with pytest.raises(ValueError, match="3 worlds, got 2"):
        other.observe(state)


def test_policies(worlds):
    with pytest.raises(TypeError, match="policy"):
        worlds[0].rollout("policy", KEY)
    with pytest.raises(ValueError, match=r"\(2, 7\), got \(7,\)"):
        jax.eval_shape(lambda k: worlds[0].rollout(lambda seen, key: jnp.zeros(7), k), KEY)


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


def test_ranges_of_a_wrong_type(worlds):
    with pytest.raises(TypeError, match="Randomization"):
        worlds[0].reset(KEY, {"mass": (1, 2)})


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        *[("num_episodes", 2.5), ("num_episodes", 10**12), ("num_envs", 2.5)],
        *[("action_noise", "a"), ("action_noise", -1.0), ("ranges", 3)],
    ],
)
def test_collect(name, bad):
    with pytest.raises((TypeError, ValueError), match=name):
        envs.collect("press", **{"num_episodes": 1, "key": KEY, name: bad})


@pytest.mark.parametrize("wrap", [VectorEnv, BraxEnv])
def test_wrappers(wrap):
    with pytest.raises(TypeError, match="environment"):
        wrap("press")
