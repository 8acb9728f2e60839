"""Enable JAX's persistent compilation cache, made safe for concurrent processes."""

import os
from pathlib import Path

import jax

from envs import _compat
from envs.datasets.writing import write_bytes


class WholeFiles(_compat.FileCache):
    """JAX's file cache, with atomic writes.

    JAX writes entries in place, so another process may read a partial entry. If a process is killed
    while it writes, its partial entry is never rewritten.
    """

    def put(self, key: str, value: bytes) -> None:
        """Write to a temporary file and rename it, which also replaces an unreadable entry.

        Raises:
            OSError: the folder is not writable. JAX turns this into a warning.
        """
        if self.eviction_enabled or "://" in str(self.path):
            super().put(key, value)  # safe: takes a lock or writes whole objects
            return
        write_bytes(Path(self.path) / f"{key}-cache", value)


def enable() -> None:
    """Cache compiled programs in JAX_COMPILATION_CACHE_DIR, by default ~/.cache/lorasp_jax/xla.

    Call this before anything is compiled.
    """
    if jax.config.jax_compilation_cache_dir is None:
        folder = os.path.join(os.path.expanduser("~"), ".cache", "lorasp_jax", "xla")
        jax.config.update("jax_compilation_cache_dir", folder)
    # JAX's default, even if the environment sets another value.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
    _compat.use_file_cache(WholeFiles)
