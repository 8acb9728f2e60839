"""Compiled programs kept between processes, safely for many at once."""

import os
from pathlib import Path

import jax

from envs import _compat
from envs.datasets.writing import write_bytes


class WholeFiles(_compat.FileCache):
    """JAX' cache of files, in which a program appears whole or not at all.

    JAX writes an entry in place: another process reads half of it, and what a killed process left
    half written is never written again.
    """

    def put(self, key: str, value: bytes) -> None:
        """Write aside, then rename; replaces an entry that could not be read.

        Raises:
            OSError: the folder cannot be written. JAX turns it into a warning.
        """
        if self.eviction_enabled or "://" in str(self.path):
            super().put(key, value)  # a lock guards it, or a bucket that writes whole objects
            return
        write_bytes(Path(self.path) / f"{key}-cache", value)


def enable() -> None:
    """Keep compiled programs between processes, in JAX_COMPILATION_CACHE_DIR or ~/.cache.

    To take effect, call it before anything is compiled.
    """
    if jax.config.jax_compilation_cache_dir is None:
        folder = os.path.join(os.path.expanduser("~"), ".cache", "lorasp_jax", "xla")
        jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
    _compat.use_file_cache(WholeFiles)
