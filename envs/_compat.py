"""Private names of JAX that this package needs; no other module of it imports any.

All exist in JAX 0.10.2, 0.11.2 and 0.12.0.1.
"""

from jax._src import compilation_cache, core, lru_cache, xla_bridge
from jaxlib import utils

FileCache = lru_cache.LRUCache
"""JAX's file cache of compiled programs. Only its folder can be set publicly, not its writer, and a
process could read programs that another one has half written."""


def use_file_cache(kind: type[FileCache]) -> None:
    """Make JAX use this class for its cache; there is no setting for it."""
    compilation_cache.LRUCache = kind  # pyright: ignore[reportPrivateImportUsage]


backends_are_initialized = xla_bridge.backends_are_initialized
"""Return whether XLA has read its flags. Public functions such as `jax.devices()` would start a
backend, after which `import envs` could no longer set the flag that makes MJX fast on CPU."""

is_untraced = core.trace_state_clean
"""Return whether the caller is outside of all JAX transformations; `jax.core` lost its public names
for that in 0.4.36. Otherwise a step inside a user's `jax.jit` would be announced as a compilation,
and get compiler options that JAX rejects there."""

set_least_logged_level = utils.absl_set_min_log_level
"""Set the log level of JAX's C++ code at run time, to silence XLA's alarms about slow compilation;
TF_CPP_MIN_LOG_LEVEL is only read at start."""
