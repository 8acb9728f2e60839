"""The order of training data: every step once per epoch, for any number of processes."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.data.batches import encode, flatten, gather, sample_batch
from lorasp_jax.data.stream import Stream
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.policies import tokenizer
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.training.setup import processor
from tests.runs import random_episodes


@pytest.fixture(scope="module")
def steps():
    """42 steps in NumPy; the first state dimension is the index of the step."""
    found = flatten([random_episodes("a", 0), random_episodes("b", 1)])
    state = np.array(found.state)
    state[:, 0] = np.arange(42)
    return found.__class__(found.image, state, found.action, found.end, found.instruction)


def make(steps, start=0, process=(0, 1), seed=3):
    return Stream(steps, batch_size=6, chunk=4, seed=seed, start=start, process=process)


def drawn(stream, batches):
    return np.stack([next(stream).state[:, 0] for _ in range(batches)])


def test_every_step_once_per_epoch(steps):
    found = drawn(make(steps), 14).reshape(2, 42)
    for epoch in found:
        np.testing.assert_array_equal(np.sort(epoch), np.arange(42))
    assert (found[0] != found[1]).any()
    assert (found[0] != np.arange(42)).any()
    assert (found != drawn(make(steps, seed=4), 14).reshape(2, 42)).any()


def test_resuming_at_any_position(steps):
    whole = drawn(make(steps), 17)
    for start in (1, 6, 7, 13):  # within an epoch, at its end and in the next one
        np.testing.assert_array_equal(drawn(make(steps, start=start), 17 - start), whole[start:])


def test_processes_share_the_same_batches(steps):
    """So a run can resume with another number of processes."""
    whole = drawn(make(steps), 10)
    for count in (2, 3):
        parts = [drawn(make(steps, process=(index, count)), 10) for index in range(count)]
        np.testing.assert_array_equal(np.concatenate(parts, -1), whole)
    later = [drawn(make(steps, start=4, process=(index, 2)), 6) for index in range(2)]
    np.testing.assert_array_equal(np.concatenate(later, -1), whole[4:])


def test_windows_stay_in_their_episode(steps):
    windows = next(make(steps))
    for row, start in enumerate(windows.state[:, 0].astype(int)):
        end = steps.end[start]
        wanted = np.minimum(start + np.arange(4), end - 1)
        np.testing.assert_array_equal(windows.actions[row], steps.action[wanted])
        np.testing.assert_array_equal(windows.inside[row], start + np.arange(4) < end)
        np.testing.assert_array_equal(windows.image["side"][row], steps.image["side"][start])
        assert windows.instruction[row] == steps.instruction[start]


def test_demonstrations_are_concatenated_in_host_memory():
    episodes = random_episodes("a", 0)
    on_device = dataclasses.replace(episodes, image=jax.tree.map(jnp.asarray, episodes.image))
    for leaf in jax.tree.leaves(flatten([on_device, episodes])):
        assert type(leaf) is np.ndarray


def test_a_streamed_window_trains_as_one_on_the_device():
    parts = [random_episodes("a", 0), random_episodes("b", 1)]
    phrases = [phrase for part in parts for phrase in part.instructions]
    prompts = PromptTable.of(tokenizer.Offline(), phrases, Pi0Config.dummy(), num_joints=6)
    steps, table = flatten(parts), processor(parts, Pi0Config.dummy(), prompts)
    key = jax.random.key(0)
    sizes = {"batch_size": 6, "chunk": 4, "state_noise": 0.1}
    batch = jax.jit(functools.partial(sample_batch, **sizes))(key, steps, table)
    start_key, noise_key = jax.random.split(key)
    start = np.asarray(jax.random.randint(start_key, (6,), 0, 42))
    windows = gather(steps, start, 4)
    found = jax.jit(lambda key, w: encode(key, w, table, state_noise=0.1))(noise_key, windows)
    jax.tree.map(np.testing.assert_array_equal, found, batch)
