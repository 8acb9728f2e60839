"""Skipped steps: what they leave unchanged, how they are counted, when a run stops."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from lorasp_jax.adapters import adaptation
from lorasp_jax.peft import LoRA
from lorasp_jax.training import guard as guards
from lorasp_jax.training import step as steps
from lorasp_jax.training.loop import RunError, train
from lorasp_jax.training.run import Callback
from lorasp_jax.training.run_folder import read_metrics
from tests.runs import CONFIG, PROGRAMS, Miniature, leaves, make_run

OPTIMIZER = optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(lambda count: 0.1 + count))
GOOD, TINY = 1.0, 1e-6


def loss(adapters, frozen, graphdef, batch, key, weights, **_):
    """Return w² b: the norm of its gradient overflows before the loss does."""
    value = sum((w**2).sum() for w in jax.tree.leaves(adapters)) * batch
    return value, {"loss": value}


@pytest.fixture
def step(monkeypatch):
    """Returns a jitted training step of `loss`, (state, batch) -> state, metrics."""
    monkeypatch.setattr(steps, "loss_fn", loss)

    def make(spike=0.0):
        one = functools.partial(
            steps.train_step, graphdef=None, optimizer=OPTIMIZER, weights={}, spike=spike, ema=0.5
        )
        return jax.jit(lambda state, batch: one(state, None, batch, jax.random.key(0)))

    return make


def initial_state():
    return steps.init_state({"w": jnp.arange(1.0, 4.0)}, OPTIMIZER, ema=True)


def unchanged(state):
    """Everything that a skipped step leaves unchanged."""
    return leaves((state.adapters, state.opt_state, state.average))


def after(step, state, *batches):
    for batch in batches:
        state, _ = step(state, batch)
    return state


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e30])
def test_a_skipped_step_changes_only_the_count(step, bad):
    step = step()
    before = after(step, initial_state(), GOOD)
    skipped, metrics = step(before, bad)
    assert math.isfinite(metrics["loss"]) == (bad == 1e30)
    assert not math.isfinite(metrics["grad_norm"])
    for name, value in unchanged(skipped).items():
        np.testing.assert_array_equal(value, unchanged(before)[name], err_msg=name)
    skips = skipped.guard.in_a_row, metrics["in_a_row"]
    assert (int(skipped.step), *map(int, skips)) == (2, 1, 1)
    assert int(skipped.guard.counted) == 1
    good = after(step, skipped, GOOD)  # as if it had not happened
    assert int(good.guard.in_a_row) == 0
    for name, value in unchanged(good).items():
        np.testing.assert_array_equal(value, unchanged(after(step, before, GOOD))[name])
        assert (value != unchanged(before)[name]).any(), name


def test_running_means_are_over_accepted_steps(step, monkeypatch):
    monkeypatch.setattr(guards, "WINDOW", 2)
    guard, accepted = guards.Guard.initial(), []
    for value in (3.0, math.nan, 5.0, 8.0):
        accept, guard = guards.check_step(guard, jnp.float32(value), jnp.float32(10 * value), 0.0)
        accepted.append(bool(accept))
    assert accepted == [True, False, True, True]
    assert int(guard.counted) == 3
    assert float(guard.loss) == ((3 + 5) / 2 + 8) / 2
    assert float(guard.grad_norm) == 10 * float(guard.loss)


@pytest.mark.parametrize(
    ("loss", "norm", "accepted"), [(1.0, 1.0, True), (3.1, 1.0, False), (1.0, 3.1, False)]
)
def test_a_spike_is_skipped_after_enough_accepted_steps(loss, norm, accepted, monkeypatch):
    monkeypatch.setattr(guards, "WINDOW", 2)
    guard = guards.Guard(jnp.int32(2), jnp.int32(0), jnp.float32(1), jnp.float32(1))
    values = jnp.float32(loss), jnp.float32(norm)
    assert bool(guards.check_step(guard, *values, 3.0)[0]) == accepted
    assert bool(guards.check_step(guard, *values, 0.0)[0])
    early = dataclasses.replace(guard, counted=jnp.int32(1))
    assert bool(guards.check_step(early, *values, 3.0)[0])


def test_train_step_detects_spikes_if_enabled(step, monkeypatch):
    monkeypatch.setattr(guards, "WINDOW", 2)
    for spike, skipped in ((0.0, 0), (50.0, 1)):
        state = after(step(spike), initial_state(), TINY, TINY, GOOD)
        assert int(state.guard.in_a_row) == skipped


def test_no_second_copy_of_the_state_is_needed(step, monkeypatch):
    """A decision by the updates, in place of loss and gradient norm, would need one."""
    leaf = 1 << 16
    state = jax.eval_shape(
        lambda: steps.init_state({str(i): jnp.ones(leaf) for i in range(16)}, OPTIMIZER, ema=True)
    )
    copy = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state.opt_state))

    def temporary(select):
        monkeypatch.setattr(guards, "select", select)
        lowered = jax.jit(step(), donate_argnums=0).lower(state, GOOD)
        return lowered.compile().memory_analysis().temp_size_in_bytes

    select = guards.select

    def by_update(counts, after, before):
        updates = jax.tree.map(jnp.subtract, after, before)
        changed = optax.tree.norm(getattr(updates, "adapters", updates))
        return select(counts & jnp.isfinite(changed), after, before)

    least, ours = temporary(lambda _, after, __: after), temporary(select)
    assert ours - least < copy / 4
    assert temporary(by_update) - least > copy / 2


def test_summary():
    loss, skips = np.array([1.0, np.nan, np.inf, 3.0]), np.array([0, 1, 2, 0])
    rows = {"loss": loss, "ranks": np.stack([loss, 2 * loss], -1), "in_a_row": skips}
    found = {name: value.tolist() for name, value in guards.summarize(rows).items()}
    assert found == {"loss": 2.0, "ranks": [2.0, 4.0], "skipped": 2}
    assert guards.summarize({name: v[1:3] for name, v in rows.items()}) == {"skipped": 2}


def spoiled(folder, episodes, at, **optim):
    """A run with NaN in some states of the demonstrations of one task."""
    optim = dataclasses.replace(CONFIG.optim, max_skipped=3, **optim)
    config = dataclasses.replace(CONFIG, peft=LoRA(rank=4), optim=optim, targets=("inp", "out"))
    run = make_run(folder, config, Miniature())
    run.programs = PROGRAMS
    run.episodes["press"].state[episodes, at] = np.nan
    return run


def test_too_many_skipped_steps_stop_the_run(tmp_path):
    class RecordReason(Callback):
        def on_stop(self, run, reason):
            self.reason = reason

    callback, run = RecordReason(), spoiled(tmp_path / "run", slice(None), slice(None))
    before = leaves(adaptation.split(run.policy.model)[1])
    message = (
        r"4 consecutive steps were skipped because .* non-finite \(step 4: loss nan, gradient norm "
        r"nan\); nothing after step 2 was saved: try a lower --optim.learning-rate"
    )
    with pytest.raises(RunError, match=message) as caught:
        train(run, [callback])
    assert callback.reason == str(caught.value)
    assert [(row["step"], row["skipped"]) for row in read_metrics(run.folder)] == [(2, 2), (4, 2)]
    assert "task" not in read_metrics(run.folder)[0]
    assert [path.name for path in (run.folder / "checkpoints").glob("*")] == ["2"]
    again = spoiled(tmp_path / "run", slice(None), slice(None), steps=2)
    train(again, resume=True)  # keeps the saved state
    for name, value in leaves(adaptation.split(again.policy.model)[1]).items():
        np.testing.assert_array_equal(value, before[name], err_msg=name)


def test_other_steps_still_train(tmp_path):
    run = spoiled(tmp_path / "run", 0, 0)
    run.config = dataclasses.replace(run.config, seed=1)
    train(run)
    rows = read_metrics(run.folder)
    assert 0 < sum(row["skipped"] for row in rows) < 4
    _, adapters, _ = adaptation.split(run.policy.model)
    assert all(np.isfinite(value).all() for value in leaves(adapters).values())
    assert all("task" in row for row in rows)
