"""Fast MJX on CPU: what JAX < 0.11 needs for it.

XLA's fusion emitters, which JAX 0.10 uses on CPU, make MJX 15 to 400 times slower (measured on two
cores). An XLA flag turns them off, but XLA reads its flags only once, when JAX starts a backend:
`import envs` sets it where that has not happened yet. Where it has, programs of this package's own
still get it, as an option of their `jax.jit`; that cannot be given to what others compile.
"""

import functools
import os
import warnings
from collections.abc import Callable
from typing import Any

import jax

from envs import _compat

_NAME = "xla_cpu_use_fusion_emitters"
FLAG = f"--{_NAME}=false"
_NEEDED = jax.__version_info__ < (0, 11)  # newer versions need no flag, and abort on this one


def _set_flag() -> bool:
    """Sets the flag; returns whether it came too late."""
    flags = os.environ.get("XLA_FLAGS", "")
    if not _NEEDED or _NAME in flags:
        return False
    if not _compat.backends_are_initialized():
        os.environ["XLA_FLAGS"] = f"{flags} {FLAG}".strip()
        return False
    return True


_LATE = _set_flag()  # when this package is imported


@functools.cache  # what was so when JAX started stays so
def is_late() -> bool:
    """Whether this process runs on a CPU, and what is compiled there lacks the flag."""
    return (_LATE or _set_flag()) and jax.default_backend() == "cpu"


@functools.cache  # once a process
def warn_if_late() -> None:
    """Warns where simulation in programs of others will be slow, and says what helps."""
    if is_late():
        warnings.warn(
            "JAX was started before `import envs`, so with JAX below 0.11 simulation inside your "
            "own jax.jit, env.rollout included, runs 15 to 400 times slower on CPU: import envs "
            f"before JAX computes anything, or set XLA_FLAGS={FLAG}",
            stacklevel=3,
        )


def without_simulation() -> dict[str, str | bool] | None:
    """Options for compiling what simulates nothing, which the flag would make slower on CPU."""
    return {_NAME: True} if _NEEDED and jax.default_backend() == "cpu" else None


def jit(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """`jax.jit`, fast on CPU even where the flag came too late; options are those of `jax.jit`."""
    plain = jax.jit(function, **options)
    if not _NEEDED:
        return plain
    # JAX takes such options only where nothing is traced around the call.
    own = jax.jit(function, **options, compiler_options={_NAME: False})

    def chosen() -> Callable[..., Any]:
        return own if is_late() and _compat.is_untraced() else plain

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        return chosen()(*arguments, **named)

    call.lower = lambda *arguments, **named: chosen().lower(*arguments, **named)
    return call
