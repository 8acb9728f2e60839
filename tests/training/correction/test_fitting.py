"""A head learns what a policy's chunks lack, from the observation at the step of the action."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.data.batches import Steps
from lorasp_jax.policies.correction import correct
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training.correction import fitting
from tests.evaluation.test_programs import policy

EPISODES, LENGTH, CHUNK = 20, 6, 4
PROCESSOR = policy().processor


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Ramp:
    """Samples chunks whose action k has the normalized state at their start plus k / 2."""

    weight: jax.Array
    config: object = dataclasses.field(default=policy().model.config, metadata={"static": True})

    def sampler(self):
        return self

    def sample_actions(self, key, obs, *, num_steps, slots, return_aux):
        assert num_steps == 3
        ramp = self.weight * jnp.arange(CHUNK)[:, None] / 2
        return jnp.where(slots, obs.state[:, None] + ramp, 0), {}


POLICY = Policy(Ramp(jnp.ones(())), PROCESSOR)


@pytest.fixture(scope="module")
def steps():
    """Demonstrations of twice the normalized state; all states are independent."""
    rng = np.random.default_rng(0)
    number = EPISODES * LENGTH
    state = rng.normal(size=(number, 7)).astype(np.float32)
    normalized = 2 * np.asarray(PROCESSOR.normalize_state(state))
    picture = np.full((number, 8, 8, 3), 100, np.uint8)
    return Steps(
        image={"side": picture, "wrist": picture},
        state=state,
        action=np.asarray(PROCESSOR.decode(normalized[:, None]))[:, 0],
        end=np.repeat(np.arange(1, EPISODES + 1) * LENGTH, LENGTH).astype(np.int32),
        instruction=np.zeros(number, np.int32),
    )


def fit(steps, monkeypatch, **settings):
    for name, value in settings.items():
        monkeypatch.setattr(fitting, name, value)
    return fitting.fit(POLICY, steps, jax.random.key(0), denoise_steps=3, progress=lambda *_: None)


@pytest.mark.slow
def test_a_known_residual_is_learned(steps, monkeypatch):
    """Twice the state at the action's step; the chunk knows only the state at its start."""
    head, error = fit(steps, monkeypatch, STEPS=300, BATCH=64, HELD_OUT_BATCHES=8)
    assert head.cameras == ("side", "wrist")
    assert error["naive"] > 2
    assert error["corrected"] < 0.2 * error["naive"]
    chunk, index = np.roll(steps.action, 7, axis=0), np.zeros(len(steps.end), np.int32)
    observation = {"image": steps.image, "state": steps.state}
    corrected = correct(head, PROCESSOR, observation, chunk, index)
    before, after = (np.std(actions - steps.action) for actions in (chunk, corrected))
    assert after < 0.5 * before


def test_the_error_is_that_of_held_out_episodes(steps, monkeypatch):
    """Their demonstrations are far off, which training on the other episodes does not show."""
    own = np.arange(len(steps.end)) // LENGTH % fitting.HELD_OUT == 0
    shifted = dataclasses.replace(
        steps, action=steps.action + 100 * own[:, None].astype(np.float32)
    )
    _, error = fit(shifted, monkeypatch, STEPS=1, HELD_OUT_BATCHES=1)
    std = PROCESSOR.statistics.action["std"][:6]
    assert min(error.values()) > 50 / np.max(std)
    _, error = fit(steps, monkeypatch, STEPS=1, HELD_OUT_BATCHES=1)
    assert max(error.values()) < 50 / np.max(std)


def test_examples_pair_an_action_with_the_step_at_which_it_is_executed(steps):
    examples = fitting._examples(POLICY, steps, jax.random.key(0), 3, lambda *_: None)
    per_episode = sum(min(CHUNK, LENGTH - first) for first in range(LENGTH))
    assert len(examples.step) == EPISODES * per_episode
    start = examples.step - examples.index
    assert (start >= 0).all()
    assert (steps.end[start] == steps.end[examples.step]).all()
    state = np.asarray(PROCESSOR.normalize_state(steps.state))[start]
    chunk = state + PROCESSOR.slot_mask * examples.index[:, None] / 2
    expected = np.asarray(PROCESSOR.decode(chunk[:, None]))[:, 0]
    np.testing.assert_allclose(examples.action, expected, rtol=1e-4, atol=1e-4)


def test_large_datasets_are_sampled(steps, monkeypatch):
    monkeypatch.setattr(fitting, "MAX_CHUNKS", 10)
    examples = fitting._examples(POLICY, steps, jax.random.key(0), 3, lambda *_: None)
    assert len(set((examples.step - examples.index).tolist())) == 10


def test_one_episode_is_too_few(steps, monkeypatch):
    one = jax.tree.map(lambda array: array[:LENGTH], steps)
    with pytest.raises(ValueError, match=r"needs at least 2 demonstrated episodes, got 1$"):
        fit(one, monkeypatch)
