"""A training step: its metrics, gradient accumulation, dropout and moving average."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.data.batches import Batch, flatten, sample_batch
from lorasp_jax.models import flow_matching
from lorasp_jax.models.flow_matching import Times
from lorasp_jax.peft import Aux, LoRA
from lorasp_jax.training.step import active_ranks, gradients, init_state, train_step
from tests.models.random_models import with_noise
from tests.runs import CONFIG, Miniature, leaves, make_run


def test_active_ranks_by_tower_and_by_layer():
    rank = jnp.arange(12.0).reshape(2, 2, 3)  # layers, windows, tokens
    mask = jnp.array([[True, True, False], [True, False, False]])
    aux = {
        "vision": {"fc1": Aux(rank, token_mask=mask), "fc2": Aux(rank + 1)},
        "action": {"out": Aux(jnp.full((2, 3), 5.0)), "frozen": Aux()},
        "language": {"q_proj": Aux()},
    }
    found = jax.jit(active_ranks)(aux)
    assert set(found) == {
        "active_rank/vision",
        "active_rank/vision/fc1",
        "active_rank/vision/fc2",
        "active_rank/action",
        "active_rank/action/out",
    }
    first, second = (0 + 1 + 3) / 3, (6 + 7 + 9) / 3
    np.testing.assert_allclose(found["active_rank/vision/fc1"], [first, second], rtol=1e-6)
    np.testing.assert_allclose(found["active_rank/vision/fc2"], [3.5, 9.5])
    mean = ((first + second) / 2 + 6.5) / 2
    np.testing.assert_allclose(found["active_rank/vision"], mean, rtol=1e-6)
    np.testing.assert_allclose(found["active_rank/action/out"], [5.0])


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A small model with adapters, moved away from their initialization, and a batch."""
    config = dataclasses.replace(CONFIG, targets=("inp", "out"))
    run = make_run(tmp_path_factory.mktemp("run") / "run", config, Miniature())
    graphdef, adapters, frozen = adaptation.split(run.policy.model)
    steps, chunk = flatten(list(run.episodes.values())), run.policy.model.config.chunk
    sizes = {"batch_size": 16, "chunk": chunk, "state_noise": 0.0}
    sample = jax.jit(functools.partial(sample_batch, **sizes))
    batch = sample(jax.random.key(0), steps, run.policy.processor)
    return graphdef, with_noise(adapters, 0.1), frozen, batch


def test_accumulated_gradients_equal_those_of_the_whole_batch(small):
    """Even for unequal numbers of valid elements; auxiliary losses only for equal ones."""
    graphdef, adapters, frozen, ragged = small
    counts = ragged.action_mask.sum((1, 2)).reshape(-1, 4).sum(0)
    assert counts.min() < counts.max()
    even = dataclasses.replace(ragged, action_mask=jnp.ones_like(ragged.action_mask))
    gradient, key = jax.jit(gradients, static_argnums=(2, 6)), jax.random.key(1)
    for batch, auxiliary in ((ragged, 0.0), (even, 1e-2)):
        weights = {"spectral": auxiliary, "balance": 0.0, "z": auxiliary}
        arguments = adapters, frozen, graphdef, batch, key, weights
        (whole, expected), (parts, found) = gradient(*arguments, 1), gradient(*arguments, 4)
        for name in ("task", "loss", *(("spectral", "z") if auxiliary else ())):
            np.testing.assert_allclose(found[name], expected[name], rtol=1e-5, err_msg=name)
        for name, value in leaves(whole).items():
            near = {"atol": 1e-4 * np.abs(value).max(), "rtol": 0, "err_msg": name}
            assert near["atol"] > 0, name
            np.testing.assert_allclose(leaves(parts)[name], value, **near)


def test_given_actions_do_not_count_in_the_loss(small):
    """Real-time chunking: the loss is the mean over valid actions after the given ones."""
    graphdef, adapters, frozen, batch = small
    key, weights = jax.random.key(1), dict.fromkeys(("spectral", "balance", "z"), 0.0)
    gradient = jax.jit(gradients, static_argnums=(2, 6, 7))
    arguments, times = (adapters, frozen, graphdef, batch, key, weights), Times(max_delay=2)
    whole, metrics = gradient(*arguments, 1, times)
    noise, time = flow_matching.draw(key, batch.actions, times)
    options = {"action_mask": batch.action_mask, "noise": noise, "flow_time": time}
    model = nnx.merge(graphdef, adapters, frozen)
    per_element, _ = jax.jit(model.loss)(key, batch.observation, batch.actions, **options)
    counts = np.asarray(batch.action_mask & (time > 0)[..., None])
    assert 0 < counts.sum() < batch.action_mask.sum()
    assert per_element[np.asarray(batch.action_mask) & ~counts].max() > 0.1
    np.testing.assert_allclose(metrics["task"], per_element[counts].mean(), rtol=1e-5)
    parts, found = gradient(*arguments, 4, times)
    np.testing.assert_allclose(found["task"], metrics["task"], rtol=1e-5)
    for name, value in leaves(whole).items():
        np.testing.assert_allclose(leaves(parts)[name], value, atol=1e-4 * np.abs(value).max())


class Linear(nnx.Module):
    """A minimal backbone; only dropout is random."""

    def __init__(self):
        self.out = nnx.Linear(8, 2, rngs=nnx.Rngs(0))

    def loss(self, key, observation, actions, **_):
        del key
        return (self.out(observation) - actions) ** 2, {}


def test_dropout_uses_the_key_of_the_step_and_one_per_micro_batch():
    method = LoRA(rank=2, dropout=0.5, initialization="pissa")
    model = adaptation.adapt(Linear(), [("out", method)], rngs=nnx.Rngs(0))
    graphdef, adapters, frozen = adaptation.split(model)
    one = lambda *shape: jnp.ones((1, *shape))  # noqa: E731
    batch = Batch(jnp.arange(8.0)[None], one(1, 2), one(1, 2))

    gradient = jax.jit(gradients, static_argnums=(2, 6))

    def task(copies, key, parts=1):
        rows = jax.tree.map(lambda x: jnp.repeat(x, copies, 0), batch)
        found = gradient(adapters, frozen, graphdef, rows, jax.random.key(key), {}, parts)
        return found[1]["task"]

    assert task(1, 0) == task(1, 0) != task(1, 1)
    assert task(2, 0, parts=2) != task(1, 0)
    assert task(1, 0) != model.loss(None, batch.observation, batch.actions)[0].mean()


def test_the_moving_average_is_updated_and_evaluated(small):
    graphdef, adapters, frozen, batch = small
    optimizer = optax.sgd(0.1)
    state = init_state(adapters, optimizer, ema=True)
    weights = dict.fromkeys(("spectral", "balance", "z"), optax.constant_schedule(0.0))
    options = {"graphdef": graphdef, "optimizer": optimizer, "weights": weights}
    step = jax.jit(lambda *arguments: train_step(*arguments, **options, ema=0.75)[0])
    after = step(state, frozen, batch, jax.random.key(0))
    updated = leaves(after.adapters)
    for name, old in leaves(adapters).items():
        expected = 0.75 * old + 0.25 * updated[name]
        np.testing.assert_allclose(leaves(after.average)[name], expected, atol=1e-5)
        assert (updated[name] != old).any()
    assert after.eval_adapters is after.average
    assert init_state(adapters, optimizer).eval_adapters is not None
