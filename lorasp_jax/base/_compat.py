"""Private JAX APIs that this package needs; no other module of it imports any.

All exist in JAX 0.10.2, 0.11.2 and 0.12.0.1.
"""

from jax._src import core, xla_bridge

backends_are_initialized = xla_bridge.backends_are_initialized
"""Return whether XLA has read its flags. Public functions such as `jax.devices()` would start a
backend, and then `import envs` could no longer set the flag that makes MJX fast on CPU."""

is_untraced = core.trace_state_clean
"""Return whether no JAX transformation is tracing the caller. `jax.core` has had no public name for
this since 0.4.36. Without this check, a step inside a user's `jax.jit` would be announced as a
compilation, and would get compiler options that JAX rejects there."""
