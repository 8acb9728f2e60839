"""XLA settings for tests, applied before JAX starts."""

import functools
import os

UNOPTIMIZED = "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
"""Halves compile time: 113 numerical tests take 65 instead of 117 CPU seconds (JAX 0.10.2).

Test workers already share the cores, so splitting code generation would cost a third more CPU.
"""


def flags(devices: int) -> str:
    """Return the XLA flags for tests with this many simulated devices."""
    count = f"--xla_force_host_platform_device_count={devices}"
    return f"{os.environ.get('XLA_FLAGS', '')} {count}".strip()  # the last count wins


def drop_training_step_options() -> None:
    """Drop the compiler options of training steps, which are three times slower when unoptimized.

    Imports JAX.
    """
    if UNOPTIMIZED in os.environ.get("XLA_FLAGS", ""):
        from lorasp_jax.base import fast_cpu

        fast_cpu.without_simulation = functools.wraps(fast_cpu.without_simulation)(lambda: None)
