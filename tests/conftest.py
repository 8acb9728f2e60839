"""Run every test on CPU with eight simulated devices and a persistent compilation cache."""

import gc
import os

os.environ["JAX_PLATFORMS"] = "cpu"

import jax
import pytest

import envs  # noqa: F401  # sets XLA's flag for fast simulation before JAX starts
from lorasp_jax.base import compilation_cache as cache
from tests import xla

cache.enable()
jax.config.update("jax_default_matmul_precision", "highest")


def pytest_configure(config):
    """Set XLA flags; fast tests skip XLA's optimizations, as they run most programs once."""
    os.environ["XLA_FLAGS"] = xla.flags(devices=8)
    if config.option.markexpr == "not slow":
        os.environ["XLA_FLAGS"] += f" {xla.UNOPTIMIZED}"
    xla.drop_training_step_options()


def pytest_collection_finish():
    """Collect garbage less often: imports are permanent and tracing creates many objects."""
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


@pytest.fixture(autouse=True, scope="module")
def _keep_programs():
    """Exempt the programs of each file from later collections, which would traverse them all."""
    yield
    gc.freeze()
