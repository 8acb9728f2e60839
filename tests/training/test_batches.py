"""The batches of several steps in one call."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from lorasp_jax.adapters import adaptation
from lorasp_jax.data.batches import encode, flatten, nbytes, sample_batch
from lorasp_jax.training import batches, program
from lorasp_jax.training.batches import DrawnBatches
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.optim import make_optimizer
from lorasp_jax.training.random_streams import StepKeys
from lorasp_jax.training.step import init_state
from tests.runs import CONFIG, Miniature, make_run, random_episodes

KEY = jax.random.key(3)
SMALL = dataclasses.replace(CONFIG, targets=("inp", "out"))


@pytest.fixture(scope="module")
def steps():
    return flatten([random_episodes("press", 0), random_episodes("pour", 1)])


@pytest.fixture(scope="module")
def drawn(steps):
    return DrawnBatches(jax.device_put(steps), meshes.make_mesh(1, jax.devices()[:1]), 6, 3)


def test_batches_do_not_depend_on_the_number_of_steps_per_call(drawn):
    whole = drawn.take(KEY, 4, 3)
    for index in range(3):
        single = drawn.take(KEY, 4 + index, 1)
        jax.tree.map(lambda a, b, i=index: np.testing.assert_array_equal(a[i], b[0]), whole, single)


def test_a_batch_is_that_of_sample_batch(drawn, steps, tmp_path):
    processor = make_run(tmp_path / "run", SMALL, Miniature()).policy.processor
    raw = jax.tree.map(lambda x: x[0], drawn.take(KEY, 7, 1))
    encoded = jax.jit(functools.partial(encode, state_noise=0.1))
    found = encoded(StepKeys.of(KEY, 7).state_noise, raw, processor)
    batch_key, _ = jax.random.split(jax.random.fold_in(KEY, 7))
    sizes = {"batch_size": 6, "chunk": 3, "state_noise": 0.1}
    sample = jax.jit(functools.partial(sample_batch, **sizes))
    expected = sample(batch_key, jax.device_put(steps), processor)
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_shapes_are_those_of_the_batches(drawn):
    for shape, array in zip(
        jax.tree.leaves(drawn.shapes(5)), jax.tree.leaves(drawn.take(KEY, 0, 5)), strict=True
    ):
        assert (shape.shape, shape.dtype) == (array.shape, array.dtype)
        assert shape.sharding.is_equivalent_to(array.sharding, array.ndim)


@pytest.mark.parametrize(
    ("most", "count", "size"), [(1000, 125, 125), (30, 125, 25), (4.9, 7, 1), (0.5, 6, 1)]
)
def test_calls_divide_the_interval_and_fit_into_memory(drawn, monkeypatch, most, count, size):
    limit = int(most * nbytes(drawn.shapes(1)))
    monkeypatch.setattr(batches, "MAX_BYTES", limit)
    assert drawn.call_size(count) == size


def test_other_demonstrations_have_the_same_program(tmp_path):
    """Even if the number of tasks differs."""

    def lowered(name, *tasks):
        run = make_run(tmp_path / name, dataclasses.replace(SMALL, tasks=tasks), Miniature())
        graphdef, adapters, frozen = adaptation.split(run.policy.model)
        methods = adaptation.methods(run.policy.model).values()
        optimizer = make_optimizer(run.config.optim, methods)
        mesh = meshes.make_mesh(1, run.devices)
        state = init_state(adapters, optimizer)
        jitted = program.jit_steps(run, graphdef, optimizer, meshes.shardings(state, mesh))
        shapes = DrawnBatches(run.steps, mesh, 4, 2).shapes(2)
        frozen = program.Frozen(frozen, run.policy.processor.shared())
        return jitted.lower(frozen, shapes, state, KEY).as_text(), len(run.steps.end)

    one, two = lowered("one", "press"), lowered("two", "press", "pour")
    assert one[0] == two[0]
    assert one[1] != two[1]
