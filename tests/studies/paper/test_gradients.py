"""Cosines of gradients that are known in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.data.batches import Batch
from lorasp_jax.dense import Dense
from lorasp_jax.peft import FullFineTuning
from studies.paper.measures import gradients

TASKS = {"one": [1.0, 0.0, 2.0], "two": [1.0, 1.0, 0.0], "three": [-1.0, 0.0, -2.0]}


class Linear(nnx.Module):
    """Loss Σ a (v · actions + w · actions²): the gradients are means of actions and actions²."""

    def __init__(self):
        options = {"use_bias": False, "rngs": nnx.Rngs(0)}
        self.vision, self.state_proj = Dense(1, 3, **options), Dense(1, 3, **options)

    def loss(self, key, observation, actions, **_):
        v, w = self.vision.kernel.get_value(), self.state_proj.kernel.get_value()
        return v * actions + w * actions**2, {}


@pytest.fixture(scope="module")
def model():
    return lorasp_jax.adapt(Linear(), [(".*", FullFineTuning())], rngs=nnx.Rngs(0))


def sample(mean, noise=0.0):
    """Batches of two windows of two actions around `mean`."""

    def draw(key):
        actions = jnp.array(mean) + noise * jax.random.normal(key, (2, 2, 3))
        return Batch(None, actions, jnp.ones((2, 2, 3), bool))

    return draw


def cosine(x, y):
    return np.dot(x, y) / np.linalg.norm(x) / np.linalg.norm(y)


def test_cosines_by_tower_and_in_total(model):
    samples = {task: sample(mean) for task, mean in TASKS.items()}
    found = gradients.gradient_cosines(model, samples, jax.random.key(0), 2)
    assert [*found] == [
        *[("one", "one"), ("one", "two"), ("one", "three")],
        *[("two", "two"), ("two", "three"), ("three", "three")],
    ]
    for (a, b), towers in found.items():
        x, y = np.array(TASKS[a]), np.array(TASKS[b])
        assert towers["vision"] == pytest.approx(cosine(x, y), abs=1e-5)
        assert towers["action"] == pytest.approx(cosine(x**2, y**2), abs=1e-5)
        both = cosine(np.concatenate([x, x**2]), np.concatenate([y, y**2]))
        assert towers["all"] == pytest.approx(both, abs=1e-5)
    assert found["one", "three"]["vision"] == pytest.approx(-1, abs=1e-5)


def test_batches_of_a_pair_are_independent_and_the_key_decides(model):
    samples = {"one": sample([1.0, 1.0, 1.0], noise=2.0)}
    first, again, other = (
        gradients.gradient_cosines(model, samples, jax.random.key(seed), 3) for seed in (0, 0, 1)
    )
    assert first == again != other
    assert first["one", "one"]["vision"] < 0.99


def test_the_mean_over_batches(model):
    """The mean over three pairs of batches is that of the cosines, not of the gradients."""
    draws, seen = sample([0.5, 1.0, 0.0], noise=1.0), []

    def record(key):
        seen.append(np.asarray(draws(key).actions.mean((0, 1))))
        return draws(key)

    found = gradients.gradient_cosines(model, {"one": record}, jax.random.key(0), 3)
    expected = np.mean([cosine(*seen[i : i + 2]) for i in (0, 2, 4)])
    assert found["one", "one"]["vision"] == pytest.approx(expected, abs=1e-5)


def test_a_gradient_of_zero_has_no_direction(model):
    found = gradients.gradient_cosines(
        model,
        {"one": sample([0.0, 0.0, 0.0]), "two": sample([1.0, 1.0, 1.0])},
        jax.random.key(0),
        1,
    )
    assert found["one", "two"] == {"vision": 0, "action": 0, "all": 0}
