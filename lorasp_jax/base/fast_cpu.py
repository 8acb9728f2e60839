"""Make MJX fast on CPU with JAX < 0.11.

XLA's fusion emitters, which JAX 0.10 uses on CPU, make MJX 15 to 400 times slower (measured on two
cores). An XLA flag turns them off, but XLA reads its flags only once, when JAX starts a backend. If
no backend has started, `import envs` sets the flag. Otherwise this package passes the option to its
own `jax.jit` calls, but cannot do so for programs that other code compiles.
"""

import functools
import os
import warnings
from collections.abc import Callable
from typing import Any

import jax

from lorasp_jax.base import _compat

_NAME = "xla_cpu_use_fusion_emitters"
FLAG = f"--{_NAME}=false"
_NEEDED = jax.__version_info__ < (0, 11)  # newer versions do not need the flag, and abort on it


def set_flag() -> bool:
    """Set the flag; return True if it is too late for that."""
    flags = os.environ.get("XLA_FLAGS", "")
    if not _NEEDED or _NAME in flags:
        return False
    if not _compat.backends_are_initialized():
        os.environ["XLA_FLAGS"] = f"{flags} {FLAG}".strip()
        return False
    return True


@functools.cache  # the result cannot change once JAX has started
def is_late() -> bool:
    """Return whether this process compiles for CPU without the flag that it needs."""
    return set_flag() and jax.default_backend() == "cpu"


@functools.cache  # once per process
def warn_if_late() -> None:
    """Warn if simulation inside a user's own jit will be slow, and say how to fix it."""
    if is_late():
        warnings.warn(
            "JAX was started before `import envs`. With JAX < 0.11, simulation inside your own "
            "jax.jit (including env.rollout) runs 15 to 400 times slower on CPU. Import envs "
            f"before JAX computes anything, or set XLA_FLAGS={FLAG}",
            stacklevel=3,
        )


def without_simulation() -> dict[str, str | bool] | None:
    """Return compiler options that undo the flag, which slows other programs on CPU."""
    return {_NAME: True} if _NEEDED and jax.default_backend() == "cpu" else None


def jit_policy(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Apply `jax.jit` to a function that does not simulate, with `without_simulation`."""

    @functools.cache  # at the first call, because the compiler options start JAX's backend
    def jitted() -> Callable[..., Any]:
        return jax.jit(function, **options, compiler_options=without_simulation())

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        return jitted()(*arguments, **named)

    return call


def jit(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Apply `jax.jit`, with fast simulation on CPU even if it was too late to set the flag."""
    plain = jax.jit(function, **options)
    if not _NEEDED:
        return plain
    # JAX accepts compiler options only in the outermost jit.
    fast = jax.jit(function, **options, compiler_options={_NAME: False})

    def select() -> Callable[..., Any]:
        return fast if is_late() and _compat.is_untraced() else plain

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        return select()(*arguments, **named)

    call.lower = lambda *arguments, **named: select().lower(*arguments, **named)
    return call
