"""What XLA is told in tests, before JAX starts."""

import functools
import os

UNOPTIMISED = "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
"""Compiles in half the time: 113 tests of values take 65 s of CPU instead of 117 (JAX 0.10.2).

Workers share the cores already: code generated in one piece takes a quarter less of CPU.
"""


def flags(devices: int) -> str:
    """What it is told here, with so many simulated devices."""
    count = f"--xla_force_host_platform_device_count={devices}"
    return f"{os.environ.get('XLA_FLAGS', '')} {count}".strip()  # of two counts the last holds


def compile_steps_as_all_else() -> None:
    """Let training steps have no options of their own: theirs take three times as long unoptimised.

    To be called where JAX may be imported.
    """
    if UNOPTIMISED in os.environ.get("XLA_FLAGS", ""):
        from envs.compilation import fast_cpu

        fast_cpu.without_simulation = functools.wraps(fast_cpu.without_simulation)(lambda: None)
