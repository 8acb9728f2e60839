"""Rollouts: what is recorded, restarts."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.reinforce import flow_sde, noise, rollout
from tests.reinforce import rooms

OPTIONS = {"execute_steps": 2, "denoise_steps": 2}


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    return rooms.start(tmp_path_factory.mktemp("run"), rooms.config()).policy


def collect(policy, room, std=0.2, sde=False):
    spread = noise.Spread(std, 0.0)
    return rollout.collect(room, policy, jax.random.key(4), spread, sde=sde, **OPTIONS)


@functools.partial(jax.jit, static_argnums=(3, 4))
def means_of(*arguments):
    return rollout.means(*arguments)[0]


def test_the_recorded_noise_gives_the_mean_of_the_actions(policy):
    found = collect(policy, rooms.Room())
    chunks, processor = found.chunks, policy.processor.shared()
    means = means_of(policy.model, processor, chunks, 2, 0.0)
    slots = noise.action_slots(processor)
    z = ((chunks.actions - means)[:, :2] / 0.2)[..., slots]
    np.testing.assert_allclose(chunks.actions[:, 2:], means[:, 2:], atol=1e-4)
    assert z.shape == (16, 2, 7)
    assert np.abs(z.mean()) < 0.2
    assert 0.8 < z.std() < 1.2
    assert chunks.observation["image"]["side"].dtype == np.uint8


def test_the_recorded_step_gives_the_mean_of_its_end(policy):
    chunks, processor = collect(policy, rooms.Room(), sde=True).chunks, policy.processor.shared()
    means = means_of(policy.model, processor, chunks, 2, 0.2)
    slots = noise.action_slots(processor)
    z = (chunks.actions - means) / flow_sde.spread_of(chunks.step, 2, 0.2).std[..., None]
    z = z[:, :2, slots]
    assert np.abs(z.mean()) < 0.2
    assert 0.8 < z.std() < 1.2
    assert set(chunks.step.tolist()) == {0, 1}


def test_without_noise_both_ways_to_explore_are_the_sampler(policy):
    found, expected = (collect(policy, rooms.Room(), 0.0, sde).steps.state for sde in (True, False))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_steps_follow_the_worlds(policy):
    found = collect(policy, rooms.Room())
    steps = found.steps
    executed = found.chunks.actions[:, :2]
    actions = policy.processor.decode(executed, found.chunks.observation["state"])
    actions = actions.reshape(2, 8, 2, 7).swapaxes(1, 2).reshape(4, 8, 7)
    change = jnp.diff(steps.state[:2, :, :7], axis=0)[0]
    running = ~np.asarray(steps.done[1])
    np.testing.assert_allclose(change[running], 0.3 * actions[0][running], atol=1e-5)
    np.testing.assert_allclose(
        steps.state[:, running, 7][:2], [[0] * running.sum(), [0.25] * running.sum()]
    )
    assert found.last.shape == (8, 8)
    np.testing.assert_array_equal(steps.reward * ~steps.done, steps.success & ~steps.done)


def test_finished_worlds_restart(policy):
    found = collect(policy, rooms.Room(max_steps=8), std=5.0)
    ended = np.asarray(found.steps.ended & ~found.steps.done)
    assert (ended.sum(0) >= 1).all()  # the first episode of every world is complete
    assert ended.sum() > 8


def test_restarts_and_noise_have_keys_of_their_own(policy, monkeypatch):
    drawn = []
    monkeypatch.setattr(noise, "explore", lambda key, mean, *_: drawn.append(key) or mean)
    monkeypatch.setattr(rooms.Room, "reset_done", lambda self, state, key, _: drawn.append(key))
    room, key = rooms.Room(), jax.random.key(3)
    image = np.zeros((8, 32, 32, 3), np.uint8)
    raw = {"image": {"side": image, "wrist": image}, "state": np.zeros((8, 7), "f")}
    sampled = type(policy)(policy.with_sampler().model, policy.processor.shared())
    rollout.explore(sampled, key, raw, np.zeros(8, np.int32), noise.Spread(0.1, 0.5), 1, 2)
    rollout._restart.__wrapped__(room, None, key, None)
    first, second = map(jax.random.key_data, drawn)
    assert not np.array_equal(first, second)
