"""Windows stay in one episode, padded and masked past its end."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from lorasp_jax.data.batches import flatten, sample_batch, windows
from tests.runs import CONFIG, Miniature, make_run, random_episodes


def test_flatten_keeps_valid_steps_in_order():
    first, second = random_episodes("a", 0), random_episodes("b", 1)
    steps = flatten([first, second])
    assert steps.state.shape == (42, 7)
    np.testing.assert_array_equal(steps.state[:5], first.state[0, :5])
    np.testing.assert_array_equal(steps.state[21 + 5 : 21 + 14], second.state[1])
    ends = np.asarray(steps.end)[[0, 4, 5, 13, 14, 20, 21, 41]]
    np.testing.assert_array_equal(ends, [5, 5, 14, 14, 21, 21, 26, 42])
    np.testing.assert_array_equal(np.asarray(steps.instruction)[[0, 5, 21, 26]], [0, 1, 2, 3])
    np.testing.assert_array_equal(steps.image["wrist"][6], first.image["wrist"][1, 1])


def test_windows_repeat_the_last_step_of_their_episode():
    """Computed by hand for episodes of 5, 9 and 7 steps, in NumPy and in JAX."""
    steps = flatten([random_episodes("a", 0)])
    start = np.array([0, 3, 4, 19])
    for begin in (start, jax.numpy.asarray(start)):
        found, inside = windows(steps, begin, 3)
        assert found.tolist() == [[0, 1, 2], [3, 4, 4], [4, 4, 4], [19, 20, 20]]
        assert inside.sum(axis=1).tolist() == [3, 2, 1, 2]


@pytest.mark.slow
def test_chunks_stay_in_their_episode(tmp_path):
    run = make_run(tmp_path / "run")
    steps, table = flatten(list(run.episodes.values())), run.policy.processor
    batch = sample_batch(jax.random.key(5), steps, table, batch_size=64, chunk=4, state_noise=0.0)
    assert batch.actions.shape == batch.action_mask.shape == (64, 4, 8)
    assert not batch.action_mask[..., 6].any()  # PiPER leaves slot 6 empty
    assert not batch.actions[..., 6].any()
    normal = np.asarray(table.normalize_actions(steps.action))
    ends = np.asarray(steps.end)
    for state, actions, mask in zip(
        np.asarray(batch.observation.state),
        np.asarray(batch.actions),
        np.asarray(batch.action_mask[..., 0]),
        strict=True,
    ):
        start = np.abs(np.asarray(table.encode(_raw(steps), steps.instruction).state) - state)
        n = int(start.sum(-1).argmin())
        count = min(4, int(ends[n]) - n)
        assert mask.sum() == count
        np.testing.assert_array_equal(actions[:count], normal[n : n + count])
        np.testing.assert_array_equal(actions[count:], normal[[ends[n] - 1] * (4 - count)])


@pytest.mark.slow
def test_noise_is_added_to_the_robots_slots_only(tmp_path):
    run = make_run(tmp_path / "run", CONFIG)
    steps = flatten(list(run.episodes.values()))
    batch = sample_batch(
        jax.random.key(0), steps, run.policy.processor, batch_size=8, chunk=4, state_noise=0.5
    )
    assert not batch.observation.state[:, 6].any()
    assert batch.observation.state[:, :6].any()


def test_published_weights_train_unused_slots(tmp_path):
    """And relative actions are relative to the window's first state."""
    run = make_run(tmp_path / "run", dataclasses.replace(CONFIG, targets=("inp",)), Miniature())
    steps, own = flatten(list(run.episodes.values())), run.policy.processor
    inputs = dataclasses.replace(own.inputs, quiet_slots=False, delta=(True, False))
    sizes = {"batch_size": 16, "chunk": 4, "state_noise": 0.0}
    sample = jax.jit(functools.partial(sample_batch, **sizes))
    plain = sample(jax.random.key(1), steps, own)
    other = dataclasses.replace(own, inputs=inputs)
    batch = sample(jax.random.key(1), steps, other)
    assert (batch.action_mask == plain.action_mask[..., :1]).all()
    assert not batch.actions[..., 6].any()
    std, known = own.statistics.action["std"][0], own.statistics.state
    start = batch.observation.state[:, 0] * known["std"][0] + known["mean"][0]
    moved = (plain.actions - batch.actions) * std
    np.testing.assert_allclose(moved[..., 0], start[:, None] * np.ones(4), atol=1e-4)
    np.testing.assert_array_equal(batch.actions[..., 1:], plain.actions[..., 1:])


def _raw(steps):
    return {"image": steps.image, "state": steps.state}
