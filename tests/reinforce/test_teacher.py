"""The teacher, and what the policy learns from it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.reinforce import critic, noise, rollout, setting, student, teacher
from lorasp_jax.reinforce.config import Learning
from lorasp_jax.reinforce.teacher import Teacher
from tests.reinforce import rooms

LENGTH, SLOTS, SIZE = 2, 8, 8
LEARNING = Learning(worlds=64, teacher_worlds=64, std=0.3, max_kl=0.2)


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    return rooms.start(tmp_path_factory.mktemp("run"), rooms.config()).policy


def new(seed=0):
    return Teacher.init(jax.random.key(seed), SIZE, LENGTH, SLOTS)


def idle():
    """Return a teacher that does nothing."""
    network = dataclasses.replace(new().network, std=jnp.ones(SIZE))
    weight, bias = network.layers[-1]
    layers = [*network.layers[:-1], (0 * weight, bias)]
    return dataclasses.replace(new(), network=dataclasses.replace(network, layers=layers))


def practise(state, judge, policy, step=0, learning=LEARNING, goal=0.15):
    room = rooms.Room(num_envs=64, goal=goal)
    return teacher.practise(state, judge, room, policy, jax.random.key(step), learning)


def judge():
    return critic.Critic.init(jax.random.key(0), SIZE, 1e-3)


def test_a_clone_acts_like_the_policy(policy, monkeypatch):
    monkeypatch.setattr(teacher, "_CLONE_STEPS", 1000)
    monkeypatch.setattr(teacher, "_CLONE_BATCH", 128)
    state = 3 + 2 * jax.random.normal(jax.random.key(1), (2048, SIZE))
    target = jnp.sin(state[:, :LENGTH, None] + jnp.arange(SLOTS))
    slots = policy.processor.action_slots
    found = teacher.clone(new(), state, target, jax.random.key(2), slots)
    error = (found.network(state) - target)[..., np.array(slots)]
    assert jnp.sqrt(jnp.mean(jnp.square(error))) < 0.1
    np.testing.assert_allclose(found.network.mean, state.mean(0), rtol=1e-4)


def test_a_teacher_learns_from_success(policy):
    state, value = idle(), judge()
    rates = []
    for step in range(12):
        state, value, _ = practise(state, value, policy, step)
        rates.append(float(state.success))
    assert np.mean(rates[:2]) < 0.2
    assert np.mean(rates[-2:]) > 0.9


def test_a_new_critic_learns_alone(policy):
    first = idle()
    second, value, metrics = practise(first, judge(), policy)
    assert metrics["steps"] > 0
    for x, y in zip(jax.tree.leaves(first.network), jax.tree.leaves(second.network), strict=True):
        np.testing.assert_array_equal(x, y)
    third, _, _ = practise(second, value, policy, 1)
    assert not np.array_equal(third.network.layers[0][0], second.network.layers[0][0])


def test_a_good_teacher_stays_as_it_was_measured(policy):
    first = idle()
    _, value, _ = practise(first, judge(), policy)
    second, _, _ = practise(first, value, policy, 1, goal=-9.0)  # every episode succeeds at once
    assert second.success == 1
    for x, y in zip(jax.tree.leaves(first.network), jax.tree.leaves(second.network), strict=True):
        np.testing.assert_array_equal(x, y)


def test_success_is_measured_without_noise(policy):
    """A teacher that does nothing reaches no goal."""
    wild = dataclasses.replace(LEARNING, std=5.0)
    found, _, _ = practise(idle(), judge(), policy, learning=wild, goal=0.3)
    assert found.success < 0.1
    room = rooms.Room(num_envs=64, goal=0.3)
    spread = noise.Spread(5.0, 0.0)
    options = {"execute_steps": LENGTH, "denoise_steps": 2}
    noisy = rollout.collect(room, policy, jax.random.key(0), spread, **options)
    assert jnp.mean(noisy.success) > 0.3


@pytest.fixture(scope="module")
def seen(policy):
    """Episodes of the policy without noise."""
    options = {"execute_steps": LENGTH, "denoise_steps": 2}
    spread = noise.Spread(0.0, 0.9)
    return rollout.collect(rooms.Room(), policy, jax.random.key(4), spread, **options)


def test_lessons_are_the_actions_that_the_robot_would_execute(policy, seen):
    wise = idle()
    layers = [*wise.network.layers[:-1], (0 * wise.network.layers[-1][0], jnp.ones((LENGTH, 8)))]
    wise = dataclasses.replace(wise, network=dataclasses.replace(wise.network, layers=layers))
    given = student.lessons(seen, wise, policy.processor)
    own, slots = seen.chunks.actions, noise.action_slots(policy.processor)
    assert (given.actions[:, :LENGTH][..., slots] == 1).all()
    np.testing.assert_array_equal(given.actions[:, LENGTH:], own[:, LENGTH:])
    np.testing.assert_array_equal(given.actions[..., ~slots], own[..., ~slots])
    same = student.lessons(seen, None, policy.processor)
    np.testing.assert_array_equal(same.actions, own)


def test_states_belong_to_their_calls(seen):
    state = seen.at_calls(seen.steps.state)
    np.testing.assert_array_equal(state[:, :7], seen.chunks.observation["state"])


def test_all_lessons_are_learned_in_turn():
    found = student.order(30, 15, 4, jax.random.key(0))
    assert np.bincount(found.ravel()).tolist() == [2] * 30


def test_only_judged_actions_are_imitated(tmp_path, policy, seen, monkeypatch):
    monkeypatch.setattr(setting, "environment", lambda *_: rooms.Room())
    learn = dataclasses.replace(rooms.config().online, method="teacher")
    config = rooms.config(online=learn)
    fixed, state, _ = setting.prepare(rooms.start(tmp_path, config))
    index = np.arange(8).reshape(1, 8)

    def loss(actions):
        start = jax.tree.map(jnp.copy, state)
        given = seen.chunks._replace(actions=actions)
        _, metrics = fixed.imitate(start, fixed.frozen, given, index, jax.random.key(0))
        return metrics["task"][0]

    actions = seen.chunks.actions
    assert loss(actions.at[:, 0, 0].add(1.0)) > loss(actions)


@pytest.mark.parametrize(("devices", "backend"), [(1, "mujoco"), (2, "jax")])
def test_teachers_practise_in_the_c_engine_on_one_cpu(tmp_path, devices, backend):
    learn = dataclasses.replace(rooms.config().online, method="teacher")
    run = rooms.start(tmp_path, rooms.config(online=learn), devices)
    fixed, _, _ = setting.prepare(run)
    assert {env.physics.backend for env in fixed.gyms.values()} == {backend}
    assert {env.physics.backend for env in fixed.environments.values()} == {"jax"}
