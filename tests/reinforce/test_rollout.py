"""Rollouts: what is recorded, layouts of groups, restarts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.reinforce import noise, rollout
from tests.reinforce import rooms

OPTIONS = {"execute_steps": 2, "denoise_steps": 2}


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    return rooms.start(tmp_path_factory.mktemp("run"), rooms.config()).policy


def collect(policy, room, **options):
    return rollout.collect(room, policy, jax.random.key(4), 0.2, **OPTIONS, **options)


def test_the_recorded_noise_gives_the_mean_of_the_actions(policy):
    found = collect(policy, rooms.Room())
    chunks, processor = found.chunks, policy.processor.shared()
    inputs = chunks.observation, chunks.prompts, chunks.noise
    means, _ = noise.means(policy.model, processor, *inputs, 2)
    slots = noise.action_slots(processor)
    z = ((chunks.actions - means[:, :2]) / 0.2)[..., slots]
    assert z.shape == (16, 2, 7)
    assert np.abs(z.mean()) < 0.2
    assert 0.8 < z.std() < 1.2
    assert chunks.observation["image"]["side"].dtype == np.uint8


def test_steps_follow_the_worlds(policy):
    found = collect(policy, rooms.Room())
    steps = found.steps
    actions = policy.processor.decode(found.chunks.actions, found.chunks.observation["state"])
    actions = actions.reshape(2, 8, 2, 7).swapaxes(1, 2).reshape(4, 8, 7)
    change = jnp.diff(steps.state[:2, :, :7], axis=0)[0]
    running = ~np.asarray(steps.done[1])
    np.testing.assert_allclose(change[running], 0.3 * actions[0][running], atol=1e-5)
    np.testing.assert_allclose(
        steps.state[:, running, 7][:2], [[0] * running.sum(), [0.25] * running.sum()]
    )
    assert found.last.shape == (8, 8)
    np.testing.assert_array_equal(steps.reward * ~steps.done, steps.success & ~steps.done)


def test_groups_start_alike_and_act_differently(policy):
    found = collect(policy, rooms.Room(), group=4)
    first = found.steps.state[0].reshape(2, 4, 8)
    np.testing.assert_array_equal(first[:, :1] + 0 * first, first)
    assert not np.array_equal(first[0], first[1])
    actions = found.chunks.actions[:8].reshape(2, 4, -1)
    assert len(np.unique(np.asarray(actions[0]), axis=0)) == 4


def test_finished_worlds_restart_unless_they_are_a_group(policy):
    room = rooms.Room(max_steps=2)
    object.__setattr__(room, "max_steps", 2)
    long = rooms.Room(max_steps=8)
    found = collect(policy, long)
    ended = np.asarray(found.steps.ended & ~found.steps.done)
    assert (ended.sum(0) >= 1).all()  # the first episode of every world is complete
    again = collect(policy, long, group=2)
    assert (np.asarray(again.steps.ended & ~again.steps.done).sum(0) == 1).all()
