"""Every test runs on CPU with eight simulated devices and keeps what it compiles."""

import gc
import os

os.environ["JAX_PLATFORMS"] = "cpu"

import jax

from envs.compilation import cache
from tests import xla

cache.enable()
jax.config.update("jax_default_matmul_precision", "highest")


def pytest_configure(config):
    """Fast tests run most programs once; long ones run what users run."""
    os.environ["XLA_FLAGS"] = xla.flags(devices=8)
    if config.option.markexpr == "not slow":
        os.environ["XLA_FLAGS"] += f" {xla.UNOPTIMISED}"
    xla.compile_steps_as_all_else()


def pytest_collection_finish():
    """What was imported stays, and tracing makes many objects: collect garbage less often."""
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)
