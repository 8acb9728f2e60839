"""Compiler options of training steps."""

import jax
import jax.numpy as jnp
import pytest

from lorasp_jax.training import compilation


@pytest.fixture
def on_gpu(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    return compilation.step_options()


def test_xla_knows_the_options_for_gpus(on_gpu):
    lowered = jax.jit(jnp.sin).lower(1.0)
    lowered.compile(on_gpu)
    with pytest.raises(jax.errors.JaxRuntimeError, match="xla_gpu_no_such_option"):
        lowered.compile({**on_gpu, "xla_gpu_no_such_option": True})


def test_they_are_for_gpus_alone(on_gpu, monkeypatch):
    assert on_gpu["xla_gpu_enable_triton_gemm"] is False
    monkeypatch.undo()
    assert not any("gpu" in name for name in compilation.step_options() or {})
