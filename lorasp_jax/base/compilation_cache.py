"""Enable JAX's persistent compilation cache."""

import os

import jax

from lorasp_jax.base.user_cache import user_cache

MAX_BYTES = 32 * 2**30
"""Size of our own folder. JAX locks the files of a limited cache, so that no process reads an entry
that another is still writing; those of an unlimited one it does not."""


def enable() -> None:
    """Cache compiled programs in JAX_COMPILATION_CACHE_DIR, by default in `user_cache()`.

    Call this before anything is compiled.

    Raises:
        ValueError: neither that variable nor a home directory is there.
    """
    if jax.config.jax_compilation_cache_dir is None:
        jax.config.update("jax_compilation_cache_dir", str(user_cache() / "jax"))
        if "JAX_COMPILATION_CACHE_MAX_SIZE" not in os.environ:
            jax.config.update("jax_compilation_cache_max_size", MAX_BYTES)
    # Below JAX's default of 1 s: initializing adapters compiles dozens of small programs.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    # Triton kernels carry the call stack in which they were first traced, and JAX does not strip it
    # from its keys: a program's key would depend on what other threads have traced before.
    jax.config.update("jax_traceback_in_locations_limit", 0)
