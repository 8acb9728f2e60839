"""Enable JAX's persistent compilation cache, made safe for concurrent processes."""

import functools
import os
from pathlib import Path
from typing import Any

import jax
from jax import monitoring

from lorasp_jax.base import _compat, turns
from lorasp_jax.base.alarms import COMPILATION
from lorasp_jax.base.writing import write_bytes


class WholeFiles(_compat.FileCache):
    """JAX's file cache, with atomic writes and without two processes making the same entry.

    JAX writes entries in place, so another process may read a partial entry. If a process is killed
    while it writes, its partial entry is never rewritten.
    """

    def get(self, key: str) -> bytes | None:
        """Read an entry; if another process is making it, wait. None: this process has to make it.

        The processes of a distributed run do not wait, because they compile a program together.
        """
        found = super().get(key)
        if found is None and self._writes_whole_files and not jax.distributed.is_initialized():
            turns.take(Path(self.path) / f"{key}-lock")
            found = super().get(key)
        return found

    def put(self, key: str, value: bytes) -> None:
        """Write to a temporary file and rename it, which also replaces an unreadable entry.

        Raises:
            OSError: the folder is not writable. JAX turns this into a warning.
        """
        if self._writes_whole_files:
            write_bytes(Path(self.path) / f"{key}-cache", value)
        else:
            super().put(key, value)  # safe: takes a lock or writes whole objects

    @property
    def _writes_whole_files(self) -> bool:
        return not (self.eviction_enabled or "://" in str(self.path))


def enable() -> None:
    """Cache compiled programs in JAX_COMPILATION_CACHE_DIR, by default ~/.cache/lorasp_jax/xla.

    Call this before anything is compiled.
    """
    if jax.config.jax_compilation_cache_dir is None:
        folder = os.path.join(os.path.expanduser("~"), ".cache", "lorasp_jax", "xla")
        jax.config.update("jax_compilation_cache_dir", folder)
    # Below JAX's default of 1 s: initializing adapters compiles dozens of small programs.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    # Triton kernels carry the call stack in which they were first traced, and JAX does not strip it
    # from its keys: a program's key would depend on what other threads have traced before.
    jax.config.update("jax_traceback_in_locations_limit", 0)
    _compat.use_file_cache(WholeFiles)
    _end_turns()


@functools.cache  # once per process
def _end_turns() -> None:
    """Let waiting processes go on after each compilation, even if it failed."""

    def end(event: str, duration_secs: float, **_: Any) -> None:
        del duration_secs
        if event == COMPILATION:
            turns.end()

    monitoring.register_event_duration_secs_listener(end)
