"""Environments behind Gymnasium's and Brax's interfaces, and in their wrappers."""

import dataclasses

import brax.envs
import gymnasium
import gymnasium.wrappers.vector as wrappers
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import envs
from envs.interop.brax import BraxEnv
from envs.interop.gymnasium import OBSERVATIONS, SingleEnv, VectorEnv
from envs.names import names
from tests.envs.demonstrations import demonstration
from tests.jaxprs import primitives

W = 4
B = 2


@pytest.fixture
def vector(env):
    return VectorEnv(env, observation="state")


@pytest.fixture(scope="module")
def pressed(env):
    """Run an expert through Gymnasium; return the first success, and the worlds before it."""
    vector = VectorEnv(env, observation="state")
    vector.reset(seed=0)
    walk = demonstration(env, vector.state)
    before, action, _ = next(step for step in walk if np.any(step[2].info["success"]))
    vector.state = before
    return before, np.asarray(action), vector.step(np.asarray(action)), vector


@pytest.fixture(scope="module")
def wrapped(env):
    """Wrap two worlds in Brax's usual wrappers, with episodes of three steps, jitted."""
    training = brax.envs.training
    found = training.EvalWrapper(training.wrap(BraxEnv(env), episode_length=3, action_repeat=1))
    return found, jax.jit(found.reset), jax.jit(found.step)


@pytest.fixture(scope="module")
def first(wrapped):
    return wrapped[1](jax.random.split(jax.random.PRNGKey(0), B))


def at_step(vector, *steps):
    """Set the clocks of the vector environment's worlds."""
    info = vector.state.info | {"steps": jnp.array(steps, jnp.int32)}
    vector.state = dataclasses.replace(vector.state, info=info)


def commands(vector):
    return np.array(vector.state.info["command"])


def scaled(env, targets):
    """Convert targets to actions in [-1, 1], as Brax's agents produce."""
    return 2 * (targets - env.action_low) / (env.action_high - env.action_low) - 1


@pytest.mark.parametrize("observation", OBSERVATIONS)
def test_spaces_contain_observations(env, observation):
    vector = VectorEnv(env, observation=observation)
    assert (vector.num_envs, vector.action_space.shape) == (W, (W, 7))
    assert vector.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    np.testing.assert_array_equal(vector.single_action_space.high, env.action_high)
    np.testing.assert_array_equal(vector.single_action_space.low, env.action_low)
    seen, info = vector.reset(seed=0)
    assert vector.observation_space.contains(seen)
    assert ("image" in seen) == (observation == "pictures")
    known = {"state": env.proprio(vector.state)}
    if observation == "full_state":
        seen, known = {"state": seen}, {"state": env.full_state(vector.state)}
    np.testing.assert_array_equal(seen["state"], known["state"])
    assert all(leaf.flags.writeable for leaf in jax.tree.leaves(seen))
    numbers = np.asarray(vector.state.info["instruction"])
    assert info["instruction"].tolist() == [env.instructions[i] for i in numbers]
    assert info["success"].tolist() == [False] * W
    assert np.all([info["_success"], info["_instruction"]])


def test_steps_match_the_environment(env, vector):
    vector.reset(seed=0)
    before, action = vector.state, commands(vector) + 0.05
    seen, reward, terminated, truncated, _ = vector.step(action)
    np.testing.assert_array_equal(seen["state"], env.proprio(env.step(before, action)))
    assert reward.dtype == np.float32
    for values in (reward, terminated, truncated):
        assert values.tolist() == [0] * W


def test_worlds_restart_at_the_next_step(vector):
    start, _ = vector.reset(seed=0)
    at_step(vector, 79, 78, 0, 5)
    action = commands(vector) + 0.05
    assert vector.step(action)[3].tolist() == [True, False, False, False]
    seen, reward, terminated, truncated, _ = vector.step(action)
    assert truncated.tolist() == [False, True, False, False]  # ended while another one restarted
    assert not np.any(reward)
    assert not np.any(terminated)
    assert vector.state.info["steps"].tolist() == [0, 80, 2, 7]
    np.testing.assert_allclose(seen["state"][0], commands(vector)[0], atol=1e-6)  # at rest
    assert np.any(seen["state"][0] != start["state"][0])
    vector.step(action)
    assert vector.state.info["steps"].tolist() == [1, 0, 3, 8]


def test_the_seed_determines_everything(vector):
    def episode(seed):
        vector.reset(seed=seed)
        at_step(vector, 79, 0, 0, 0)
        action = np.tile(vector.env.action_low, (W, 1))
        return np.stack([vector.step(action)[0]["state"] for _ in range(3)])

    once = episode(3)
    np.testing.assert_array_equal(once, episode(3))
    assert np.all(np.any(once != episode(4), axis=(0, 2)))
    vector.reset(seed=3)
    before = commands(vector)
    vector.reset()
    assert np.any(commands(vector) != before)


def test_broken_worlds_are_truncated(vector):
    vector.reset(seed=0)
    action = commands(vector)
    action[2] = np.nan
    _, _, terminated, truncated, _ = vector.step(action)
    assert truncated.tolist() == [False, False, True, False]
    assert not np.any(terminated)


def test_success_terminates(pressed):
    _, action, (_, reward, terminated, truncated, info), vector = pressed
    np.testing.assert_array_equal(reward, terminated)
    np.testing.assert_array_equal(info["success"], terminated)
    assert not np.any(truncated)
    _, reward, again, _, info = vector.step(action)
    for values in (reward, again, info["success"]):
        assert not np.any(values[terminated])


def test_misuse(vector):
    with pytest.raises(ResetNeeded, match="call reset"):
        vector.step(np.zeros((W, 7)))
    with pytest.raises(ValueError, match="reset_mask"):
        vector.reset(options={"reset_mask": np.ones(W, bool)})
    vector.reset(seed=0)
    with pytest.raises(ValueError, match=r"\(4, 7\), got \(7,\)"):
        vector.step(np.zeros(7))


def test_gymnasium_wrappers(vector):
    recorder = wrappers.RecordEpisodeStatistics(vector)
    recorder.reset(seed=0)
    at_step(vector, 78, 0, 0, 0)
    action = commands(vector)
    infos = [recorder.step(action)[4] for _ in range(2)]
    assert "episode" not in infos[0]
    assert infos[1]["episode"]["l"].tolist() == [2, 0, 0, 0]
    for info in wrappers.DictInfoToList(vector).step(action)[4]:
        assert info["instruction"] in vector.env.instructions


def test_brax_observation(env, wrapped, first):
    found = wrapped[0]
    assert (found.observation_size, found.action_size, found.backend) == (41, 7, "mjx")
    worlds = jax.tree.map(lambda x: x[:, 0], first.pipeline_state)
    np.testing.assert_allclose(first.obs, env.full_state(worlds), atol=1e-6)
    assert np.any(first.obs[0] != first.obs[1])


def test_brax_compiles_little_more_than_the_bare_environment(env):
    """A batch of batches would be a fifteenth larger, and take twice as long to trace."""
    keys = jax.random.split(jax.random.PRNGKey(0), W)
    state = jax.eval_shape(env.reset, keys[0])
    bare = primitives(env.reset, keys[0]) + primitives(env.full_state, state)
    wrapped = primitives(jax.vmap(BraxEnv(env).reset), keys)
    assert len(wrapped) < 1.03 * len(bare)


@pytest.mark.slow
def test_brax_misuse(env):
    world = BraxEnv(env)
    state = world.reset(jax.random.key(0))
    with pytest.raises(ValueError, match=r"\(7,\), got \(6,\)"):
        world.step(state, jnp.zeros(6))


@pytest.mark.slow
def test_brax_episodes_end_and_restart(env, wrapped, first):
    state, targets = first, first.pipeline_state.info["command"][:, 0] + 0.008
    for count in (1, 2, 3, 1):
        state = wrapped[2](state, scaled(env, targets))
        assert state.info["steps"].tolist() == [count] * B
        assert state.info["truncation"].tolist() == state.done.tolist() == [count == 3] * B
        assert state.pipeline_state.info["steps"].tolist() == [[0]] * B
        assert state.metrics["button_depth"].shape == (B,)
        assert not np.any(state.reward)
        # The wrapper puts the very first observation back after the end.
        assert np.array_equal(state.obs, first.obs) == (count == 3)
    np.testing.assert_allclose(state.pipeline_state.info["command"][:, 0], targets, atol=1e-5)


@pytest.mark.slow
def test_brax_actions_are_clipped(env, wrapped, first):
    command = np.asarray(first.pipeline_state.info["command"])[:, 0]
    state = wrapped[2](first, np.full((B, 7), 9.0, np.float32))
    reach = command + env.robot.action_speed * env.control_dt
    found = state.pipeline_state.info["command"][:, 0]
    np.testing.assert_allclose(found, np.minimum(reach, env.action_high), atol=1e-5)


@pytest.mark.slow
def test_brax_success_is_rewarded_once(env, wrapped, first, pressed):
    before, action, (_, reward, *_), _ = pressed
    worlds = [int(np.argmax(reward)), int(np.argmin(reward))]
    assert reward[worlds].tolist() == [1, 0]
    near = jax.tree.map(lambda x: np.asarray(x)[worlds, None], before)
    state = wrapped[2](first.replace(pipeline_state=near), scaled(env, action[worlds]))
    assert state.reward.tolist() == state.done.tolist() == [1, 0]
    assert state.info["eval_metrics"].episode_metrics["reward"].tolist() == [1, 0]
    assert not np.any(state.info["truncation"])
    np.testing.assert_array_equal(state.obs[0], first.obs[0])
    late = np.array([[True], [False]])
    ended = dataclasses.replace(near, done=late, reward=late.astype(np.float32))
    state = wrapped[2](first.replace(pipeline_state=ended), scaled(env, action[worlds]))
    assert (state.reward.tolist(), state.done.tolist()) == ([0, 0], [1, 0])


@pytest.mark.slow
def test_brax_broken_worlds_are_done(wrapped, first):
    action = jnp.zeros((B, 7)).at[1].set(jnp.nan)
    state = wrapped[2](first, action)
    assert (state.done.tolist(), state.reward.tolist()) == ([0, 1], [0, 0])
    assert np.all(np.isfinite(state.obs))


def test_import_registers_every_task_and_robot():
    registered = {name for name in gymnasium.registry if name.startswith("lorasp_jax/")}
    assert registered == {
        f"lorasp_jax/{task}-{robot}-v0" for task in names("task") for robot in names("robot")
    }
    with pytest.raises(gymnasium.error.NameNotFound, match="prss"):
        gymnasium.make_vec("lorasp_jax/prss-piper-v0")


def test_make_vec_takes_the_options_of_both():
    ranges = envs.Randomization.typical()
    options = {"reward": "dense", "discount": 0.9, "actions": "end_effector", "ranges": ranges}
    vector = gymnasium.make_vec("lorasp_jax/pour-panda-v0", num_envs=3, **options)
    env = vector.env
    assert (env.task.name, env.robot.name, env.num_envs) == ("pour", "panda", 3)
    assert (env.reward, env.discount, env.actions) == ("dense", 0.9, "end_effector")
    assert vector.ranges is ranges
    assert vector.single_observation_space.shape == (72,)
    seen = gymnasium.make_vec("lorasp_jax/press-piper-v0", observation="pictures")
    assert seen.observation_space["image"]["wrist"].shape == (1, 64, 64, 3)
    with pytest.raises(ValueError, match="pictures, state, full_state"):
        gymnasium.make_vec("lorasp_jax/press-piper-v0", observation="image")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*Box observation space (min|max)imum value is")
@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space")
def test_gymnasiums_own_checker_passes():
    env = gymnasium.make("lorasp_jax/press-piper-v0", image_size=16, reward="dense")
    check_env(env.unwrapped)
    env.reset(seed=0)
    world = env.unwrapped.vector
    at_step(world, 79)
    assert env.step(commands(world)[0])[2:4] == (False, True)
    with pytest.raises(ResetNeeded, match="call reset"):
        env.step(commands(world)[0])
    with pytest.raises(ValueError, match="'human'"):
        SingleEnv(world.env, render_mode="human")
