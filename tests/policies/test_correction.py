"""The correction of an action: zero at first, and in the units of the policy's actions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from lorasp_jax.policies.correction import CorrectionHead, correct, residual
from tests.evaluation.test_programs import policy

CAMERAS, ACTION_DIM, CHUNK = ("side", "wrist"), 8, 4


def head():
    return CorrectionHead(CAMERAS, ACTION_DIM, CHUNK, nnx.Rngs(0))


def trained():
    """A head with a random last layer."""
    new = head()
    new.out.kernel[...] = jax.random.normal(jax.random.key(1), new.out.kernel.shape)
    return new


@pytest.fixture(scope="module")
def processor():
    return policy().processor


@pytest.fixture(scope="module")
def inputs():
    """Observation, action and index of five robots."""
    rng = np.random.default_rng(0)
    images = {name: rng.integers(0, 256, (5, 48, 64, 3)).astype(np.uint8) for name in CAMERAS}
    observation = {"image": images, "state": jnp.asarray(rng.normal(size=(5, 7)))}
    return observation, jnp.asarray(rng.normal(size=(5, 7))), jnp.arange(5) % CHUNK


def test_a_new_head_changes_no_bit(processor, inputs):
    np.testing.assert_array_equal(correct(head(), processor, *inputs), inputs[1])
    assert (correct(trained(), processor, *inputs) != inputs[1]).all()


def test_the_residual_has_the_units_of_normalized_actions(processor, inputs):
    """A residual of 1 in one joint adds one standard deviation to it."""
    new = head()
    new.out.bias[2] = 1.0
    change = correct(new, processor, *inputs) - inputs[1]
    expected = np.zeros((5, 7))
    expected[:, 2] = processor.statistics.action["std"][2]
    np.testing.assert_allclose(change, expected, atol=1e-5)


@pytest.mark.parametrize("changed", ["side", "wrist", "state", "action", "index"])
def test_the_residual_depends_on_every_input(processor, inputs, changed):
    observation, action, index = inputs
    before = residual(trained(), processor, *inputs)
    if changed in CAMERAS:
        images = observation["image"]
        observation = observation | {"image": images | {changed: 255 - images[changed]}}
    elif changed == "state":
        observation = observation | {"state": observation["state"] + 1}
    action = action + (changed == "action")
    index = index + (changed == "index")
    after = residual(trained(), processor, observation, action, index)
    assert (jnp.abs(after - before).max(axis=1) > 1e-4).all()
