"""The update on problems with known answers."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.config import AuxiliaryConfig
from lorasp_jax.dense import AdapterParam
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.reinforce import flow_sde, noise, update
from lorasp_jax.reinforce.config import Learning
from lorasp_jax.reinforce.learner import Learner
from lorasp_jax.reinforce.rollout import Chunks
from lorasp_jax.reinforce.update import WeightedChunks
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.guard import Guard
from lorasp_jax.training.program import Frozen
from tests.reinforce import rooms

STD = 0.1
CHUNKS, EXECUTED = 64, 2
KEY = jax.random.key(9)
LEVEL = 0.2
SDE = {"method": "ppo", "exploration": "sde", "noise_level": LEVEL}
both = pytest.mark.parametrize("changes", [{}, SDE], ids=["actions", "sde"])


def settings(size=32, epochs=4, **changes):
    learn = Learning(std=STD, correlation=0.0, epochs=epochs, max_kl=0.1)
    learn = dataclasses.replace(learn, **changes)
    optim = dataclasses.replace(rooms.config().optim, batch_size=size)
    auxiliary = AuxiliaryConfig(0, 0, 0, 0)
    return rooms.config(online=learn, optim=optim, auxiliary=auxiliary)


class Bandit(nnx.Module):
    """A flow whose chunk is a parameter, whatever it sees."""

    run_flow = Backbone.run_flow

    def __init__(self):
        self.config = Pi0Config.dummy()
        self.chunk = AdapterParam(jnp.zeros((self.config.chunk, self.config.action_dim)))

    def run_prefix(self, obs):
        return None, {}

    def run_suffix(self, prefix, obs, x_t, flow_time, action_valid=None):
        return (x_t - self.chunk) / flow_time[:, None, None], {}


@pytest.fixture(scope="module")
def processor(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return rooms.start(folder, rooms.config()).policy.processor.shared()


def make(model, processor, config=None, rate=3e-2):
    graphdef, adapters, parameters = adaptation.split(model)
    optimizer = optax.adam(rate)
    zero = jnp.zeros((), jnp.int32)
    adapters = jax.tree.map(jnp.copy, adapters)
    state = Learner(zero, adapters, optimizer.init(adapters), Guard.initial(), {}, jnp.ones(()))
    shardings = meshes.shardings(state, meshes.make_mesh(devices=jax.devices()[:1]))
    programs = update.Programs(config or settings(), graphdef, optimizer, shardings)
    return programs, jax.device_put(state, shardings), Frozen(parameters, processor)


explore = jax.jit(noise.explore)


@jax.jit
def from_noise(key, target, *inputs):
    """Sample with the velocity whose flow ends at `target`."""
    velocity = lambda x, t: ((x - target) / t[:, None, None], None)  # noqa: E731
    return flow_sde.sample(key, velocity, *inputs, num_steps=2)


def explored(processor, means, key, changes=(), std=STD, count=CHUNKS):
    """Return executed actions that are drawn around `means`, `[S, A]`, and their chunks."""
    rng, config = np.random.default_rng(0), Pi0Config.dummy()
    image = rng.integers(0, 255, (count, 32, 32, 3), np.uint8)
    state = rng.normal(size=(count, 7)).astype("f")
    raw = {"image": {"side": image, "wrist": image}, "state": state}
    flow = jax.random.normal(jax.random.key(1), (count, config.chunk, config.action_dim))
    prompts, slots = np.zeros(count, np.int32), noise.action_slots(processor)
    if changes:
        target = jnp.zeros(flow.shape[1:]).at[: len(means)].set(means)
        ends, (x, after, step) = from_noise(key, target, flow, slots, changes["noise_level"])
        return ends[:, : len(means)], Chunks(raw, prompts, x, after[:, : len(means)], step)
    mean = jnp.broadcast_to(means, (count, *means.shape))
    actions = explore(key, mean, noise.Spread(std, 0.0), slots)
    return actions, Chunks(raw, prompts, flow, actions)


def chunks(*args, **options):
    return explored(*args, **options)[1]


def batch(chunks, advantages, valid=None):
    valid = jnp.ones(advantages.shape, bool) if valid is None else valid
    return WeightedChunks(chunks, advantages, valid, jnp.zeros_like(chunks.actions))


@both
def test_a_bandit_finds_its_optimum(processor, changes):
    """The reward is minus the squared distance of each action to its target."""
    programs, state, frozen = make(Bandit(), processor, settings(**changes))
    slots = noise.action_slots(processor)
    target = 0.5 * jax.random.normal(jax.random.key(3), (EXECUTED, 8)) * slots
    for step in range(60):
        means = state.adapters["chunk"].get_value()[:EXECUTED]
        actions, data = explored(processor, means, jax.random.key(step), changes)
        rewards = -jnp.sum(jnp.square(actions - target), axis=-1)
        advantages = rewards - rewards.mean(0)
        advantages = advantages / advantages.std()
        key = jax.random.key(step)
        state, rows = update.improve(programs, state, frozen, batch(data, advantages), key)
        assert rows["kl"][0] < 1e-12
    found = np.asarray(state.adapters["chunk"].get_value())
    np.testing.assert_allclose(found[:EXECUTED], target, atol=0.1)
    assert not found[:, ~slots].any()  # the robot does not execute them
    assert not found[EXECUTED:].any()


def test_gradients_are_those_of_the_log_probability(processor):
    """Before the first update, d ratio / d mean = (action - mean) / s²."""
    _, state, frozen = make(Bandit(), processor)
    graphdef = adaptation.split(Bandit())[0]
    data = chunks(processor, jnp.zeros((EXECUTED, 8)), jax.random.key(0))
    advantages = jax.random.normal(jax.random.key(2), (CHUNKS, EXECUTED))
    valid = jax.random.bernoulli(jax.random.key(3), 0.7, advantages.shape)
    loss = update.make_loss(settings(), graphdef)
    inputs = frozen, batch(data, advantages, valid)
    gradient = jax.grad(loss, has_aux=True)(state.adapters, *inputs)[0]["chunk"]
    weighted = (advantages * valid)[..., None] * data.actions / STD**2
    np.testing.assert_allclose(
        gradient.get_value()[:EXECUTED], -weighted.sum(0) / valid.sum(), rtol=1e-4, atol=1e-6
    )


@both
def test_gradients_of_a_backbone_match_finite_differences(processor, tmp_path, changes):
    policy = rooms.start(tmp_path, rooms.config()).policy
    graphdef, adapters, parameters = adaptation.split(policy.model)
    adapters = jax.tree.map(
        lambda x: x + 0.03 * jnp.sin(jnp.arange(x.size)).reshape(x.shape), adapters
    )
    frozen = Frozen(parameters, processor)
    changes = changes and {**changes, "noise_level": 1.0}
    data = chunks(processor, jnp.zeros((EXECUTED, 8)), KEY, changes, std=0.5, count=4)
    full = batch(data, jax.random.normal(jax.random.key(2), (4, EXECUTED)))
    of_config = update.make_loss(settings(std=2.0, clip=100.0, **changes), graphdef)
    loss = jax.jit(lambda x: of_config(x, frozen, full)[0])
    gradient = jax.jit(jax.grad(loss))(adapters)
    direction = jax.tree.map(lambda x: x / optax.tree.norm(gradient), gradient)
    move = lambda h: jax.tree.map(lambda x, d: x + h * d, adapters, direction)  # noqa: E731
    found = (loss(move(0.02)) - loss(move(-0.02))) / 0.04
    assert float(found) == pytest.approx(float(optax.tree.norm(gradient)), rel=0.03)


@both
def test_without_learning_the_ratio_is_exactly_one(processor, tmp_path, changes):
    policy = rooms.start(tmp_path, rooms.config()).policy
    programs, state, frozen = make(policy.model, processor, settings(8, 2, **changes), rate=0.0)
    data = chunks(processor, jnp.zeros((EXECUTED, 8)), jax.random.key(0), changes, count=24)
    advantages = jax.random.normal(jax.random.key(2), (24, EXECUTED))
    state, rows = update.improve(programs, state, frozen, batch(data, advantages), KEY)
    assert float(state.rate) == 1.5  # the policy may change more
    assert len(rows["ratio"]) == 6
    np.testing.assert_array_equal(rows["ratio"], 1)
    np.testing.assert_array_equal(rows["clipped"], 0)


def test_an_iteration_ends_when_the_policy_has_changed_enough(processor):
    programs, state, frozen = make(Bandit(), processor, rate=1.0)
    before = np.asarray(state.adapters["chunk"].get_value())
    data = chunks(processor, jnp.zeros((EXECUTED, 8)), jax.random.key(0))
    advantages = jax.random.normal(jax.random.key(2), (CHUNKS, EXECUTED))
    state, rows = update.improve(programs, state, frozen, batch(data, advantages), KEY)
    assert rows["within"].tolist() == [True, False]  # the second step is not taken
    assert rows["kl"][1] > 0.1
    assert float(state.rate) == pytest.approx(1 / 1.5)
    change = np.abs(np.asarray(state.adapters["chunk"].get_value()) - before).max()
    assert change == pytest.approx(1.0, rel=1e-3)  # that of Adam's first step


@pytest.mark.parametrize(
    ("step", "before", "after"), [(1.0, 1.0, 1 / 1.5), (0.0, 60.0, 64.0), (1.0, 1 / 60, 1 / 64)]
)
def test_the_rate_follows_the_change_of_a_single_step(processor, step, before, after):
    config = settings(CHUNKS, 1, max_kl=1e-3)
    programs, state, frozen = make(Bandit(), processor, config, step)
    state = dataclasses.replace(state, rate=jnp.asarray(before))
    data = chunks(processor, jnp.zeros((EXECUTED, 8)), jax.random.key(0))
    advantages = jax.random.normal(jax.random.key(2), (CHUNKS, EXECUTED))
    state, rows = update.improve(programs, state, frozen, batch(data, advantages), KEY)
    assert rows["kl"].tolist() == [0]  # before the step
    assert float(state.rate) == pytest.approx(after)


def test_micro_batches_add_up(processor):
    """Whatever the number of their valid actions."""
    found = []
    valid = jnp.ones((CHUNKS, EXECUTED), bool).at[: CHUNKS // 2, 1].set(False)
    for parts in (1, 4, 16):
        config = settings(CHUNKS, 1)
        optim = dataclasses.replace(config.optim, accumulate=parts)
        config = dataclasses.replace(config, optim=optim)
        programs, state, frozen = make(Bandit(), processor, config)
        data = chunks(processor, jnp.zeros((EXECUTED, 8)), jax.random.key(0))
        advantages = jax.random.normal(jax.random.key(2), (CHUNKS, EXECUTED))
        weighted = batch(data, advantages, valid)
        state, rows = update.improve(programs, state, frozen, weighted, KEY)
        assert rows["loss"].shape == (1,)
        found.append((state.adapters["chunk"].get_value(), rows["grad_norm"], rows["loss"]))
    for one, *others in zip(*found, strict=True):
        for other in others:
            np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)


def test_a_step_that_is_not_finite_is_skipped(processor):
    programs, state, frozen = make(Bandit(), processor)
    data = chunks(processor, jnp.zeros((EXECUTED, 8)), jax.random.key(0))
    advantages = jnp.full((CHUNKS, EXECUTED), jnp.nan)
    state, rows = update.improve(programs, state, frozen, batch(data, advantages), KEY)
    assert rows["in_a_row"].tolist() == [*range(1, 9)]
    assert float(state.rate) == pytest.approx(1 / 1.5)
    assert not np.asarray(state.adapters["chunk"].get_value()).any()


def test_equal_advantages_teach_nothing(processor):
    programs, state, frozen = make(Bandit(), processor)
    data = chunks(processor, jnp.zeros((EXECUTED, 8)), jax.random.key(0))
    zeros = jnp.zeros((CHUNKS, EXECUTED))
    assert update.improve(programs, state, frozen, batch(data, zeros), KEY)[1] == {}
