"""What the objectives are zero for, what they train, and what is learned of two ways to act."""

import dataclasses
import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.data.batches import Batch
from lorasp_jax.distill_flow.objectives import Endpoint, SnapFlow
from lorasp_jax.models import flow_matching
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.observation import Observation
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.smolvla import SmolVLAConfig
from lorasp_jax.peft import LoRA
from lorasp_jax.training.step import loss_fn
from tests.models.random_models import observation, random_backbone, with_noise

CONFIGS = {
    "pi0": Pi0Config.dummy(),
    "pi05": dataclasses.replace(Pi0Config.dummy(), pi05=True),
    "smolvla": SmolVLAConfig.dummy(),
}
WEIGHTS = {name: jnp.zeros(()) for name in ("spectral", "balance", "z", "orthogonality")}


def make(name):
    """Return graphdef, adapters, frozen parameters, and a batch with a chunk that ends early."""
    config = CONFIGS[name]
    model = adaptation.adapt(random_backbone(config), [(".*", LoRA(rank=1))], rngs=nnx.Rngs(0))
    graphdef, adapters, frozen = adaptation.split(model)
    shape = (2, config.chunk, config.action_dim)
    mask = np.ones(shape, bool)
    mask[:, :, 3] = mask[1, 2:] = False
    actions = jax.random.normal(jax.random.key(0), shape)
    batch = Batch(observation(config, 2), actions, jnp.asarray(mask))
    return graphdef, with_noise(adapters, 0.1), frozen, batch


def loss(student, objective, adapters):
    graphdef, start, frozen, batch = student
    teacher = nnx.merge(graphdef, start, frozen)
    learned = lambda model, *drawn: objective(model, teacher, *drawn)  # noqa: E731
    inputs = adapters, frozen, graphdef, batch, jax.random.key(1), WEIGHTS
    return loss_fn(*inputs, objective=learned)[0]


def test_a_student_with_the_steps_of_its_teacher_has_nothing_to_learn():
    student = make("pi0")
    found = [
        jax.jit(functools.partial(loss, student, objective))(student[1])
        for objective in (Endpoint(10), Endpoint(2))
    ]
    assert found[0] < 1e-10
    assert found[1] > 1e-4


@pytest.mark.parametrize("name", CONFIGS)
def test_gradients_reach_all_layers_of_the_flow_steps_and_no_others(name):
    """They agree with finite differences."""
    student = graphdef, adapters, frozen, _ = make(name)
    pattern = type(nnx.merge(graphdef, adapters, frozen)).flow_layers
    both = jax.jit(jax.value_and_grad(functools.partial(loss, student, Endpoint(2))))
    gradient = both(adapters)[1]
    reached, others = set(), set()
    for path, variable in nnx.to_flat_state(gradient):
        layer = "/".join(map(str, path))
        (reached if re.search(pattern, layer) else others).add(layer)
        size = optax.tree.norm(variable.get_value())
        assert (size > 0) == (layer in reached), layer
    assert {name.split("/")[0] for name in others} >= {"vision", "language"}
    assert {name.split("/")[0] for name in reached} >= {"action", "action_out_proj"}
    direction = with_noise(jax.tree.map(jnp.zeros_like, gradient), 1.0)
    move = lambda h: jax.tree.map(lambda x, d: x + h * d, adapters, direction)  # noqa: E731
    expected = (both(move(1e-3))[0] - both(move(-1e-3))[0]) / 2e-3
    assert optax.tree.vdot(gradient, direction) == pytest.approx(float(expected), rel=0.02)


def test_snapflow_learns_the_two_step_sample():
    graphdef, adapters, frozen, batch = make("pi0")
    model = nnx.merge(graphdef, adapters, frozen)
    noise = jax.random.normal(jax.random.key(2), batch.actions.shape)
    slots = batch.action_mask.any(axis=1, keepdims=True)
    noise = jnp.where(slots, noise, 0)
    velocity = jax.jit(lambda x, t: model.velocity(batch.observation, x, jnp.full(2, t)))
    first = jnp.where(slots, velocity(noise, 1.0), 0)
    second = jnp.where(slots, velocity(noise - first / 2, 0.5), 0)
    expected = (first - (first + second) / 2) ** 2
    snapflow = jax.jit(SnapFlow(share=0, weight=1))
    found = snapflow(model, model, batch, noise, jnp.ones(2))[0]
    np.testing.assert_allclose(found, expected, atol=1e-4)


SEEN = Observation({}, {}, *(3 * [jnp.zeros(())]))


class TwoWays(nnx.Module):
    """The optimal velocity where half of the demonstrated actions are 1 and half -1."""

    run_flow = Backbone.run_flow

    def run_prefix(self, obs):
        return jnp.zeros(()), {}

    def run_suffix(self, prefix, obs, x_t, flow_time, action_valid=None):
        t = flow_time[:, None, None]
        return (x_t - jnp.tanh((1 - t) * x_t / t**2)) / t, {}


class Net(TwoWays):
    def __init__(self, rngs):
        self.inp, self.out = nnx.Linear(2, 32, rngs=rngs), nnx.Linear(32, 1, rngs=rngs)

    def run_suffix(self, prefix, obs, x_t, flow_time, action_valid=None):
        t = jnp.broadcast_to(flow_time[:, None, None], x_t.shape)
        return self.out(jnp.tanh(self.inp(jnp.concatenate([3 * x_t, t], axis=-1)))), {}


class Plain:
    """Flow matching."""

    def __call__(self, student, teacher, batch, noise, flow_time):
        velocity = lambda x, t: student.run_suffix(None, None, x, t)  # noqa: E731
        options = {"noise": noise, "flow_time": flow_time}
        return flow_matching.loss(velocity, jax.random.key(0), batch.actions, **options)


@pytest.mark.parametrize(("objective", "size"), [(Endpoint(1), 1.0), (Plain(), 0.0)])
def test_one_step_acts_in_either_way_and_not_in_between(objective, size):
    """Plain flow matching acts in the mean of both ways, 0."""
    graphdef, params = nnx.split(Net(nnx.Rngs(0)))
    optimizer = optax.adam(1e-2)

    def draw(key):
        keys = jax.random.split(key, 3)
        actions = jax.random.rademacher(keys[0], (512, 1, 1), jnp.float32)
        noise = jax.random.normal(keys[1], actions.shape)
        return actions, noise, flow_matching.sample_time(keys[2], 512)

    def step(carry, key):
        params, state = carry
        actions, noise, time = draw(key)
        batch = Batch(SEEN, actions, jnp.ones(actions.shape, bool))

        def loss(params):
            student = nnx.merge(graphdef, params)
            return objective(student, TwoWays(), batch, noise, time)[0].mean()

        updates, state = optimizer.update(jax.grad(loss)(params), state)
        return (optax.apply_updates(params, updates), state), None

    keys = jax.random.split(jax.random.key(0), 1500)
    train = jax.jit(lambda carry: jax.lax.scan(step, carry, keys)[0])
    params, _ = train((params, optimizer.init(params)))
    noise = draw(jax.random.key(1))[1]
    chunk, _ = nnx.merge(graphdef, params).run_flow(None, SEEN, noise, num_steps=1)
    clear = jnp.abs(noise) > 0.2
    assert jnp.abs(jnp.abs(chunk)[clear] - size).mean() < 0.15
    if size:
        assert jnp.all((chunk * noise)[clear] > 0)
