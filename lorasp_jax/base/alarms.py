"""Silence XLA's alarms about slow compilation in programs that report it themselves.

"Very slow compile? If you want to file a bug ..." and "Constant folding an instruction is taking
> 1s" are logged as errors (xla/service/slow_operation_alarm.cc); no setting turns off just those.
"""

import os
import threading
from collections.abc import Callable
from typing import Any

from jax import monitoring

from lorasp_jax.base import _compat

COMPILATION = "/jax/core/compile/backend_compile_duration"  # recorded at start and end
_FATAL, _JAX_DEFAULT = 3, 1  # levels of TF_CPP_MIN_LOG_LEVEL


def silence(
    set_level: Callable[[int], None] = _compat.set_min_log_level,
) -> "Compilations | None":
    """Log only fatal errors from JAX's C++ code while this process compiles. Call this once.

    Failing compilations still raise, and errors outside compilation are still logged. A level set
    in TF_CPP_MIN_LOG_LEVEL is respected. Plugins such as CUDA's have their own logging.

    Args:
        set_level: sets the lowest level that is logged.

    Returns:
        The listener registered with JAX, or None if the user chose a level.
    """
    if os.environ.get("TF_CPP_MIN_LOG_LEVEL", str(_JAX_DEFAULT)) != str(_JAX_DEFAULT):
        return None
    running = Compilations(set_level)
    monitoring.register_scalar_listener(running.on_start)
    monitoring.register_event_duration_secs_listener(running.on_end)
    return running


class Compilations:
    """Count the compilations running in all threads and set the log level accordingly."""

    def __init__(self, set_level: Callable[[int], None]) -> None:
        self._set_level = set_level
        self._lock = threading.Lock()
        self._running = 0

    def on_start(self, event: str, value: float, **_: Any) -> None:
        """Handle a scalar that JAX records."""
        del value  # the start time
        self._count(event, 1)

    def on_end(self, event: str, duration_secs: float, **_: Any) -> None:
        """Handle a duration that JAX records."""
        del duration_secs
        self._count(event, -1)

    def _count(self, event: str, change: int) -> None:
        if event == COMPILATION:
            with self._lock:
                self._running += change
                self._set_level(_FATAL if self._running else _JAX_DEFAULT)
