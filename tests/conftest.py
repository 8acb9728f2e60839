"""Every test runs on CPU with eight simulated devices and keeps what it compiles."""

import os

os.environ["JAX_PLATFORMS"] = "cpu"
os.environ["XLA_FLAGS"] = (
    os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=8"
).strip()

import jax

from envs import compilation_cache

compilation_cache.enable()
jax.config.update("jax_default_matmul_precision", "highest")
