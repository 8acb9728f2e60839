"""Every test runs on CPU with eight simulated devices and keeps what it compiles."""

import os

from tests import xla

os.environ["JAX_PLATFORMS"] = "cpu"
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {xla.flags(devices=8)}".strip()

import jax

from envs import compilation_cache

compilation_cache.enable()
jax.config.update("jax_default_matmul_precision", "highest")
