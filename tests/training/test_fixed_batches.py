"""Fixed batches: prompts by the policy's table, no state noise, the same for the same key."""

import dataclasses
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from lorasp_jax.data.batches import flatten
from lorasp_jax.training import activations, fixed_batches
from tests.runs import CONFIG, make_run, random_episodes


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("run") / "run")


def same(a, b):
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y) for x, y in pairs)


@pytest.mark.slow
def test_windows_of_the_episodes_with_the_policys_prompts(run):
    """The order of instructions in the episodes differs from that in the policy's table."""
    group = random_episodes("press", 0)
    other = dataclasses.replace(
        group, instructions=group.instructions[::-1], instruction=1 - group.instruction
    )
    key, policy = jax.random.key(0), run.policy
    batch = fixed_batches.sampler(policy, group, 5)(key)
    assert batch.actions.shape == (5, policy.model.config.chunk, policy.model.config.action_dim)
    assert same(batch, fixed_batches.sampler(policy, other, 5)(key))
    assert not same(batch, fixed_batches.sampler(policy, group, 5)(jax.random.key(1)))
    steps = flatten([group])
    states = np.asarray(policy.processor.encode(vars(steps), steps.instruction).state)
    for row in np.asarray(batch.observation.state):  # without noise
        assert np.isclose(states, row, atol=1e-5).all(-1).any()


@pytest.mark.slow
def test_an_unknown_instruction_is_refused(run):
    group = dataclasses.replace(random_episodes("press", 0), instructions=("jump", "sit"))
    with pytest.raises(ValueError, match="no prompt for 'jump'"):
        fixed_batches.sampler(run.policy, group, 5)


@pytest.mark.slow
def test_all_tasks_have_the_same_keys(run):
    found = fixed_batches.keyed_batches(run.policy, run.episodes, 4, 3)
    keys = [[jax.random.key_data(key) for key, _ in pairs] for pairs in found.values()]
    assert len(keys) == 2
    np.testing.assert_array_equal(*keys)
    assert len(np.unique(keys[0], axis=0)) == 3
    assert not same(found["press"][0][1], found["pick_place"][0][1])


def test_a_batch_and_its_loss_share_no_key(monkeypatch):
    """Otherwise the flow times would follow the noise of the states."""
    monkeypatch.setattr(activations, "batch_sampler", lambda *_: lambda key: key)
    pairs = activations.sampled(SimpleNamespace(config=CONFIG), None, 4)
    keys = [jax.random.key_data(key) for pair in pairs for key in pair]
    assert len(np.unique(keys, axis=0)) == 2 * activations.BATCHES
