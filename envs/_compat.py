"""What this package needs of JAX beyond its public names; no other module here imports such names.

Each is there in JAX 0.10.2, 0.11.2 and 0.12.0.1; where a later one moves it, this file follows.
"""

from jax._src import compilation_cache, core, lru_cache, xla_bridge
from jaxlib import utils

FileCache = lru_cache.LRUCache
"""JAX's cache of compiled programs in files. Its folder can be set publicly, its writer cannot: a
process would read programs that another one has half written."""


def use_file_cache(kind: type[FileCache]) -> None:
    """Let JAX make its cache of this class, which no setting does."""
    compilation_cache.LRUCache = kind  # pyright: ignore[reportPrivateImportUsage]


backends_are_initialized = xla_bridge.backends_are_initialized
"""Whether XLA has read its flags. `jax.devices()` and the like would start a backend to answer:
without it `import envs` could not set the flag that makes MJX fast on a CPU."""

is_untraced = core.trace_state_clean
"""Whether no transformation is traced around the caller. `jax.core` lost its names for that in
0.4.36. Without it a step inside somebody's `jax.jit` would be announced as a compilation of its
own, and be given compiler options that JAX refuses there."""

set_least_logged_level = utils.absl_set_min_log_level
"""Sets the level of JAX's C++ log while the process runs; TF_CPP_MIN_LOG_LEVEL is read once, at the
start. Without it XLA's alarms about slow compilations reach the terminal."""
