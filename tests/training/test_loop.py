"""Runs: frozen stays frozen, resume is exact, a non-finite update stops the run."""

import dataclasses
import gc
import os
import signal

import jax
import numpy as np
import pytest
from rich.progress import Progress

from lorasp_jax.adapters import adaptation
from lorasp_jax.config import AugmentConfig, DataConfig
from lorasp_jax.data.batches import flatten, nbytes
from lorasp_jax.peft import LoRA
from lorasp_jax.training import checkpoint, loop
from lorasp_jax.training.loop import RunError, train
from lorasp_jax.training.run import Callback
from lorasp_jax.training.run_folder import read_metrics
from tests.runs import CONFIG, PROGRAMS, Miniature, Terminate, leaves, make_run, repeatable


def quick_run(folder, *, ema=0.5, streams=False):
    """A run of a tiny model, with gradient accumulation and a moving average."""
    optim = dataclasses.replace(CONFIG.optim, accumulate=2, ema=ema)
    config = dataclasses.replace(CONFIG, optim=optim, targets=("inp", "out"))
    if streams:  # the method does not matter: one that compiles faster
        data = DataConfig(augment=AugmentConfig("openpi"))
        config = dataclasses.replace(config, peft=LoRA(rank=4), data=data)
    run = make_run(folder, config, Miniature())
    run.programs = PROGRAMS
    if streams:
        run.dataset, run.streams = flatten(list(run.episodes.values())), True
    return run


def test_the_bar_has_the_rate_of_training_alone(tmp_path, monkeypatch):
    """That of the report, without what callbacks take; it says where a resumed run starts."""
    shown = []

    class Recorder(Progress):
        def add_task(self, description, **fields):
            shown.append((description, None))
            return super().add_task(description, **fields)

        def update(self, task_id, **fields):
            shown.append((fields["description"], fields["rate"]))

    monkeypatch.setattr(loop, "bars", lambda *_, **__: Recorder(disable=True))
    run = quick_run(tmp_path / "run")
    with pytest.raises(KeyboardInterrupt):
        train(run, [Terminate()])
    train(quick_run(tmp_path / "run"), resume=True)
    train(quick_run(tmp_path / "run"), resume=True)
    texts = [text for text, rate in shown if rate is None]
    assert texts[0].startswith("compiling")
    assert texts[1].startswith("resumed at step 2, compiling")
    assert texts[2] == "trained"
    logged = [row["speed/samples_per_second"] for row in read_metrics(run.folder)]
    assert [rate for _, rate in shown if rate] == logged


def gained(model, start, batch, noise, flow_time):
    """An objective: how much lower the loss is than at the start."""
    options = {"action_mask": batch.action_mask, "noise": noise, "flow_time": flow_time}
    (now, aux), (before, _) = (
        each.loss(None, batch.observation, batch.actions, **options) for each in (model, start)
    )
    return now - before, aux


def test_an_objective_replaces_the_loss(tmp_path):
    """It sees the model and that of the start, which are equal in the first step."""
    config = dataclasses.replace(CONFIG, peft=LoRA(rank=4), targets=("inp",), log_every=1)
    run = make_run(tmp_path / "run", config, Miniature())
    run.objective = gained
    train(run)
    first, *_, last = (row["task"] for row in read_metrics(run.folder))
    assert first == 0
    assert last < 0


class LogSize(Callback):
    def on_log(self, run, step, metrics):
        adapters = leaves(adaptation.split(run.policy.model)[1]).values()
        return {"size": float(sum(np.abs(x).sum() for x in adapters))}


@pytest.mark.parametrize("streams", [False, True])
def test_resume_is_bit_exact_and_frozen_stays_frozen(streams, tmp_path):
    """Also: a run ends with the averaged adapters, and another base is rejected.

    It restores signal handlers; callbacks get the current policy at each log step and add metrics.
    """
    whole, halved = (quick_run(tmp_path / name, streams=streams) for name in ("whole", "halved"))
    _, adapters_before, frozen_before = adaptation.split(whole.policy.model)
    handler = signal.getsignal(signal.SIGTERM)
    train(whole, [LogSize()])
    assert signal.getsignal(signal.SIGTERM) == handler
    assert jax.device_count() == 8
    first, second = (row["size"] for row in read_metrics(whole.folder))
    assert second == LogSize().on_log(whole, 4, {})["size"] != first > 0

    callback = Terminate()
    with pytest.raises(KeyboardInterrupt):
        train(halved, [LogSize(), callback])
    assert [row["step"] for row in read_metrics(halved.folder)] == [2]
    halved = quick_run(tmp_path / "halved", streams=streams)  # as in a new process
    train(halved, [LogSize(), callback], resume=True)
    assert callback.started == 1

    _, adapters, frozen = adaptation.split(whole.policy.model)
    _, resumed, _ = adaptation.split(halved.policy.model)
    for name, value in leaves(resumed).items():
        np.testing.assert_array_equal(value, leaves(adapters)[name], err_msg=name)
    assert repeatable(whole.folder) == repeatable(halved.folder)
    assert read_metrics(whole.folder)[-1]["speed/samples_per_second"] > 0
    assert ("speed/data_wait" in read_metrics(whole.folder)[-1]) == streams
    for name, value in leaves(frozen).items():
        np.testing.assert_array_equal(value, leaves(frozen_before)[name], err_msg=name)
    changed = [
        name for name, v in leaves(adapters).items() if (v != leaves(adapters_before)[name]).any()
    ]
    assert len(changed) == len(leaves(adapters))

    if not streams:  # which does not matter here
        plain = quick_run(tmp_path / "plain", ema=0.0)
        train(plain)
        for name, value in leaves(adaptation.split(plain.policy.model)[1]).items():
            assert (value != leaves(adapters)[name]).any(), name
    halved.base_hash = "hash of another base"
    with pytest.raises(ValueError, match="trained on a different base"):
        train(halved, resume=True)


def test_resuming_takes_the_place_of_the_initial_state(tmp_path, monkeypatch):
    """The device never holds two states: that is what a small GPU has no room for."""

    def held():
        gc.collect()
        return sum(x.nbytes for x in jax.live_arrays())

    train(quick_run(tmp_path / "run"))
    run, found, compute = quick_run(tmp_path / "run"), [], checkpoint.digest
    adapters = nbytes(adaptation.split(run.policy.model)[1])
    before = held() - adapters

    def digest(state, *arguments):
        found.append((held() - before, nbytes(state)))
        return compute(state, *arguments)

    monkeypatch.setattr(checkpoint, "digest", digest)
    train(run, resume=True)
    ((restoring, state),) = found
    assert state > 3 * adapters  # with moments and an average
    assert restoring < state + 0.5 * adapters


@pytest.mark.slow
def test_a_non_finite_update_stops_the_run_and_keeps_the_last_checkpoint(tmp_path):
    # The warm-up's first step has learning rate zero; the second overflows.
    optim = dataclasses.replace(CONFIG.optim, learning_rate=1e38, warmup_steps=2)
    config = dataclasses.replace(CONFIG, optim=optim, log_every=1, checkpoint_every=1)
    run = make_run(tmp_path / "run", config)
    with pytest.raises(RunError, match=r"non-finite by step 2 .*; nothing after step 1 was"):
        train(run)
    assert sorted(os.listdir(tmp_path / "run" / "checkpoints")) == ["1"]
    again = make_run(tmp_path / "run", config)
    with pytest.raises(RunError) as caught:
        train(again, resume=True)  # from a finite state
    assert "\n" not in str(caught.value)
