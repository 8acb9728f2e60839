"""Private JAX APIs that this package needs; no other module of it imports any.

All exist in JAX 0.10.2, 0.11.2 and 0.12.0.1.
"""

from collections.abc import Callable
from typing import Any

from jax._src import core, xla_bridge
from jax._src.interpreters import mlir

backends_are_initialized = xla_bridge.backends_are_initialized
"""Return whether XLA has read its flags. Public functions such as `jax.devices()` would start a
backend, and then `import envs` could no longer set the flag that makes MJX fast on CPU."""

is_untraced = core.trace_state_clean
"""Return whether no JAX transformation is tracing the caller. `jax.core` has had no public name for
this since 0.4.36. Without this check, a step inside a user's `jax.jit` would be announced as a
compilation, and would get compiler options that JAX rejects there."""


def cpu_lowering(primitive: Any) -> Callable[..., Any]:
    """Return the rule that lowers a primitive on CPU; public functions can only replace it."""
    return mlir._platform_specific_lowerings["cpu"][primitive].rule
