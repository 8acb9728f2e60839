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
    ("arguments", "message"),
    [
        ({"task": "prss"}, "unknown task 'prss': choose from open_pot, pick_place, pour, press"),
        ({"task": 3}, "unknown task 3: choose from open_pot"),
        ({"robot": "pipe"}, "unknown robot 'pipe': choose from panda, piper"),
        (
            {"robot": 5},
            "robot must be one of panda, piper, the path of an MJCF file or a Robot, got 5",
        ),
        ({"robot": b"piper"}, "robot must be one of panda, piper, the path"),
        ({"num_envs": 0}, "num_envs must be at least 1, got 0"),
        ({"num_envs": 10**12}, "num_envs must be at most 1,048,576, got 1,000,000,000,000"),
        ({"image_size": 0}, "image_size must be at least 1, got 0"),
        ({"image_size": 10**6}, "image_size must be at most 4,096, got 1,000,000"),
        ({"antialias": 1000}, "antialias must be at most 16, got 1,000"),
        ({"distractors": -1}, "distractors must be at least 0, got -1"),
        ({"distractors": 5}, "distractors must be at most 4, got 5"),
        *[({n: v}, f"{n} must be an integer, got {v!r}") for n in NUMBER for v in (2.5, True)],
        *[({"num_envs": v}, "num_envs must be an integer") for v in (np.nan, "3", None, [4])],
        ({"control_dt": 0.03}, "control_dt must be a positive multiple of 0.02 s, got 0.03"),
        ({"control_dt": 0.0}, "control_dt must be a positive multiple of 0.02 s, got 0.0"),
        ({"control_dt": 1e12}, "control_dt must be at most the time limit of the task, 8.0 s, got"),
        (
            {"control_dt": 1e308},
            "control_dt must be at most the time limit of the task, 8.0 s, got",
        ),
        ({"control_dt": np.inf}, "control_dt must be finite, got inf"),
        ({"control_dt": "3"}, "control_dt must be a number, got '3'"),
        ({"control_dt": True}, "control_dt must be a number, got True"),
        ({"actions": "voltage"}, "unknown actions 'voltage': choose from joint, delta_joint"),
        ({"discount": True}, "discount must be a number above 0 and at most 1, got True"),
        ({"robot": f"{300 * 'a'}.xml"}, "robot a+.xml: no such file"),
        ({"backend": ""}, "unknown backend '': choose from jax, warp"),
        ({"backend": 7}, "unknown backend 7: choose from jax, warp"),
        ({"renderer": None}, "unknown renderer None: choose from rays, warp"),
    ],
    ids=str,
)
def test_make(arguments, message):
    with pytest.raises((TypeError, ValueError), match=f"^{message}"):
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
        with pytest.raises(TypeError, match=r"^key must be"):
            call()


@pytest.mark.parametrize("raw", [jax.random.PRNGKey(0), np.zeros(2, np.uint32)])
def test_raw_keys_are_accepted(worlds, raw):
    assert jax.eval_shape(worlds[0].reset, raw).done.shape == (2,)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ([[0.0] * 7] * 2, r"action must be a numeric array of shape \[2, 7\], got a list"),
        (None, "action must be a numeric array"),
        (np.full((2, 7), "a"), "action must be a numeric array"),
        (np.zeros((2, 7), bool), "action must be a numeric array .* got an array of bool"),
        (np.zeros((2, 7), complex), "action must be a numeric array"),
        (np.zeros((2, 6)), r"action must have shape \(2, 7\), got \(2, 6\)"),
    ],
)
def test_actions(worlds, action, message):
    env, state = worlds
    with pytest.raises((TypeError, ValueError), match=f"^{message}"):
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
        with pytest.raises(TypeError, match=r"^state must be a state from reset or step, got None"):
            call(None)
    with pytest.raises(ValueError, match=r"^state must have 3 worlds, got 2 worlds"):
        other.observe(state)


def test_policies(worlds):
    with pytest.raises(TypeError, match=r"^policy must be a function \(observation, key\)"):
        worlds[0].rollout("policy", KEY)
    with pytest.raises(ValueError, match=r"^action must have shape \(2, 7\), got \(7,\)"):
        jax.eval_shape(lambda k: worlds[0].rollout(lambda seen, key: jnp.zeros(7), k), KEY)


@pytest.mark.parametrize(
    "bad",
    [5, None, "ab", ("a", "b"), (0, [1]), (True, True), (1, 2, 3), (2, 1), (0, np.nan), (1, 1e300)],
    ids=str,
)
def test_ranges(worlds, bad):
    message = r"^position must be two finite numbers \(low, high\), got"
    with pytest.raises(ValueError, match=message):
        worlds[0].reset(KEY, envs.Randomization(position=bad))
    for wrap in (VectorEnv, BraxEnv):
        with pytest.raises(ValueError, match=message):
            wrap(worlds[0], ranges=envs.Randomization(position=bad))


def test_ranges_of_a_wrong_type(worlds):
    with pytest.raises(TypeError, match=r"^ranges must be an envs.Randomization or None, got"):
        worlds[0].reset(KEY, {"mass": (1, 2)})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_episodes": 2.5}, "num_episodes must be an integer, got 2.5"),
        ({"num_episodes": 10**12}, "num_episodes must be at most"),
        ({"num_envs": 2.5}, "num_envs must be an integer, got 2.5"),
        ({"action_noise": "a"}, "action_noise must be a number, got 'a'"),
        ({"action_noise": -1.0}, "action_noise must be at least 0, got -1.0"),
        ({"ranges": 3}, "ranges must be an envs.Randomization or None, got 3"),
    ],
    ids=str,
)
def test_collect(arguments, message):
    with pytest.raises((TypeError, ValueError), match=f"^{message}"):
        envs.collect("press", **{"num_episodes": 1, "key": KEY} | arguments)


@pytest.mark.parametrize("wrap", [VectorEnv, BraxEnv])
def test_wrappers(wrap):
    with pytest.raises(TypeError, match=r"^env must be an environment from envs.make, got 'press'"):
        wrap("press")
