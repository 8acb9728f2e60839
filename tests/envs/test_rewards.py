"""Dense rewards: properties of every task's potential, and the reward made from it."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs import rewards
from envs.rewards import potential
from envs.state import State
from envs.tasks import View
from tests.envs import expert_in_c
from tests.envs.demonstrations import demonstration

EPISODES = 4


def potentials(scene, key) -> np.ndarray:
    """Return the potential [T + 1] along an expert's episode."""
    every = [expert_in_c.measure(scene, data)[1] for data in expert_in_c.episode(scene, key)]
    padded = np.pad(every, ((0, scene.expert_steps + 1 - len(every)), (0, 0)))  # one shape per task
    return np.asarray(potential(dict(enumerate(padded.T))))[: len(every)]


@pytest.mark.parametrize(
    ("shares", "expected"),
    [
        ([0.0, 0.0, 0.0], 0.0),
        ([0.6, 0.0, 0.0], 0.2),
        ([0.6, 0.9, 0.9], 0.2),  # later stages have not started
        ([1.0, 0.5, 0.0], 0.5),
        ([0.1, 1.0, 0.5], 2.5 / 3),  # a passed stage counts for those before it
        ([0.0, 0.0, 1.0], 1.0),
        ([1.0, 1.0, 1.0], 1.0),
    ],
)
def test_potential(shares, expected):
    found = potential({str(i): jnp.array([share]) for i, share in enumerate(shares)})
    np.testing.assert_allclose(found, [expected], rtol=1e-6)


def test_stages_have_names(scene):
    names = [*scene.task.stages(View(scene.model, expert_in_c.world(scene)))]
    assert len(names) >= 2
    assert all(name.isidentifier() for name in names)


@pytest.mark.parametrize("robot_name", ["piper", pytest.param("panda", marks=pytest.mark.slow)])
def test_potential_rises_along_expert_episodes(scene):
    """It rises from near 0 to 1; a slip may cost one stage, in a minority of episodes."""
    count = len(expert_in_c.measure(scene, expert_in_c.world(scene))[1])
    falls = []
    for key in range(EPISODES):
        found = potentials(scene, key)
        assert found[0] < 0.25
        assert found[-1] == 1
        assert len(np.unique(found.round(3))) > 10  # no long plateaus
        falls.append(-np.minimum(np.diff(found), 0).sum())
    assert max(falls) < 1 / count
    assert np.median(falls) < 0.03


def test_stages_are_bounded_for_random_poses(scene):
    rng = np.random.default_rng(0)
    data = expert_in_c.world(scene)
    for _ in range(50):
        data.qpos[:] += rng.normal(0, 0.3, scene.model.nq)
        mujoco.mj_kinematics(scene.model, data)
        _, found = expert_in_c.measure(scene, data, rng.uniform(0.8, 1.25))
        assert np.all((found >= 0) & (found <= 1))


def world(shares, *, success=False, done=False, before=None, discount=0.9) -> State:
    """Return one world at these stages, one step after `before`."""
    info = {"success": jnp.array(success)}
    state = State(None, jnp.float32(0), jnp.array(done or success), {"depth": 1.0}, info)
    named = {f"s{i}": jnp.float32(share) for i, share in enumerate(shares)}
    if before is None:
        return rewards.at_reset(state, named)
    return rewards.after_step(before, state, named, discount)


PATH = [[0.2, 0.0], [0.7, 0.0], [1.0, 0.4], [0.5, 0.3], [1.0, 0.9]]


def episode(*, discount, **last):
    """Return the states of a walk through PATH, the last one with this info."""
    states = [world(PATH[0])]
    for shares in PATH[1:-1]:
        states.append(world(shares, before=states[-1], discount=discount))
    return [*states, world(PATH[-1], before=states[-1], discount=discount, **last)]


def discounted(states, discount) -> float:
    return sum(discount**i * float(state.reward) for i, state in enumerate(states[1:]))


@pytest.mark.parametrize("discount", [0.9, 1.0])
def test_rewards_telescope(discount):
    """The return differs from the sparse one by a constant that no action changes."""
    start = 0.1  # potential
    length = len(PATH) - 1
    won = episode(discount=discount, success=True)
    sparse = discount ** (length - 1)
    assert discounted(won, discount) == pytest.approx(sparse - start, abs=1e-5)
    # After a time limit the learner bootstraps from the last state, so its potential stays.
    late = episode(discount=discount, done=True)
    assert discounted(late, discount) == pytest.approx(discount**length * 0.95 - start, abs=1e-5)


def test_closed_loops_get_no_reward():
    states = [world(PATH[0])]
    for shares in [*PATH[1:], PATH[0]]:
        states.append(world(shares, before=states[-1], discount=1.0))
    assert discounted(states, 1.0) == pytest.approx(0.0, abs=1e-5)


def test_metrics_are_the_terms():
    before, after = episode(discount=0.9, success=True)[-2:]
    found = {name: float(value) for name, value in after.metrics.items()}
    shaping = -float(before.metrics["potential"])
    assert found == pytest.approx(
        {"depth": 1, "stage_s0": 1, "stage_s1": 0.9, "potential": 0.95}
        | {"reward_success": 1, "reward_shaping": shaping}
    )
    assert float(after.reward) == pytest.approx(1 + shaping)


@pytest.mark.parametrize("success", [True, False])
def test_done_worlds_get_no_reward(success):
    end = world([1.0, 1.0], success=success, done=True)
    again = world([1.0, 1.0], success=success, done=True, before=end)
    assert float(again.reward) == 0
    assert float(again.metrics["reward_shaping"]) == float(again.metrics["reward_success"]) == 0


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"reward": "shaped"}, "sparse, dense"),
        *[({"reward": "dense", "discount": bad}, "discount") for bad in (0.0, "0.9", float("nan"))],
    ],
)
def test_bad_arguments(options, name):
    with pytest.raises((TypeError, ValueError), match=name):
        envs.make("press", **options)


@pytest.mark.slow
def test_an_environment_with_dense_rewards(task_name):
    """The expert's rewards in randomized worlds are finite, and telescope."""
    env = envs.make(task_name, num_envs=4, image_size=16, reward="dense", discount=0.95)
    ranges = envs.Randomization.typical()
    first = env.reset(jax.random.key(0), ranges)
    start, returns = np.asarray(first.metrics["potential"]), np.zeros(4)
    for step, (before, _, state) in enumerate(demonstration(env, first)):
        returns += 0.95**step * np.asarray(state.reward)
        assert np.all(np.isfinite(state.reward))
        assert not np.any(np.asarray(state.reward)[before.done])
        if np.all(state.done):
            break
    won = np.asarray(state.info["success"])
    assert won.any()
    sparse = 0.95 ** (np.asarray(state.info["steps"]) - 1.0)
    np.testing.assert_allclose(returns[won], (sparse - start)[won], atol=1e-5)
    again = env.reset_done(state, jax.random.key(2), ranges)
    assert not np.any(np.asarray(again.reward)[state.done])


@pytest.mark.slow
def test_broken_worlds_stay_frozen():
    env = envs.make("press", num_envs=2, reward="dense", discount=0.9)
    start = env.reset(jax.random.key(0))
    after = env.step(start, start.info["command"].at[1].set(jnp.nan))
    assert after.done.tolist() == [False, True]
    np.testing.assert_allclose(after.reward[1], -0.1 * start.metrics["potential"][1], rtol=1e-5)
    again = env.step(after, start.info["command"])
    assert again.reward[1] == 0
    assert env.reset_done(again, jax.random.key(1)).reward[1] == 0
