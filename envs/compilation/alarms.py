"""XLA's alarms about slow compilations, kept from the terminal of a program that says so itself.

"Very slow compile? If you want to file a bug ..." and "Constant folding an instruction is taking
> 1s" are logged as errors (xla/service/slow_operation_alarm.cc), and nothing turns off them alone.
"""

import os
import threading
from collections.abc import Callable
from typing import Any

from jax import monitoring

from envs import _compat

COMPILATION = "/jax/core/compile/backend_compile_duration"  # recorded at its start and at its end
_FATAL, _JAX_DEFAULT = 3, 1  # levels of TF_CPP_MIN_LOG_LEVEL


def silence(
    set_level: Callable[[int], None] = _compat.set_least_logged_level,
) -> "Compilations | None":
    """From now on JAX's own C++ logs nothing below fatal while this process compiles anything.

    What makes a compilation fail is raised besides, and at all other times errors are logged as
    ever. Leaves alone what TF_CPP_MIN_LOG_LEVEL asks for, and plugins such as CUDA's, which log by
    themselves. To be called once.

    Args:
        set_level: sets the least level that is logged.

    Returns:
        What listens to JAX, or None where the user chose a level.
    """
    if os.environ.get("TF_CPP_MIN_LOG_LEVEL", str(_JAX_DEFAULT)) != str(_JAX_DEFAULT):
        return None
    running = Compilations(set_level)
    monitoring.register_scalar_listener(running.begins)
    monitoring.register_event_duration_secs_listener(running.ends)
    return running


class Compilations:
    """Counts the compilations that run, side by side in threads, and sets the level by that."""

    def __init__(self, set_level: Callable[[int], None]) -> None:
        self._set_level = set_level
        self._lock = threading.Lock()
        self._running = 0

    def begins(self, event: str, value: float, **_: Any) -> None:
        """Listens to the scalars that JAX records."""
        del value  # when
        self._count(event, 1)

    def ends(self, event: str, duration_secs: float, **_: Any) -> None:
        """Listens to the durations that JAX records."""
        del duration_secs
        self._count(event, -1)

    def _count(self, event: str, change: int) -> None:
        if event == COMPILATION:
            with self._lock:
                self._running += change
                self._set_level(_FATAL if self._running else _JAX_DEFAULT)
