"""Compiler options of training steps."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from lorasp_jax.base import fast_cpu
from lorasp_jax.training import compilation, loop
from tests.runs import CONFIG, Miniature, make_run


@pytest.fixture
def on_gpu(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    return compilation.step_options(1)


def test_xla_knows_the_options_for_gpus(on_gpu):
    lowered = jax.jit(jnp.sin).lower(1.0)
    lowered.compile(on_gpu)
    with pytest.raises(jax.errors.JaxRuntimeError, match="xla_gpu_no_such_option"):
        lowered.compile({**on_gpu, "xla_gpu_no_such_option": True})


def test_on_a_cpu_they_leave_out_those_for_simulation(monkeypatch):
    monkeypatch.setattr(fast_cpu, "without_simulation", lambda: {"a": True})
    assert compilation.step_options(1) == {"a": True}


def test_only_one_gpu_runs_without_the_scheduler_that_hides_transfers(on_gpu, monkeypatch):
    scheduler = "xla_gpu_enable_latency_hiding_scheduler"
    assert on_gpu[scheduler] is False
    assert scheduler not in compilation.step_options(2)
    monkeypatch.undo()
    assert not any("gpu" in name for name in compilation.step_options(1) or {})


def test_a_training_program_is_compiled_with_its_options(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr(compilation, "step_options", lambda n: asked.append(n) or {"no_such": 1})
    with pytest.raises(jax.errors.JaxRuntimeError, match="no_such"):
        loop.train(make_run(tmp_path, dataclasses.replace(CONFIG, targets=("inp",)), Miniature()))
    assert asked == [1]
