"""XLA's alarms about slow compilations, kept from the terminal of a program that says so itself.

"Very slow compile? If you want to file a bug ..." and "Constant folding an instruction is taking
> 1s" are logged as errors (xla/service/slow_operation_alarm.cc), and nothing turns off them alone.
"""

import os
import threading
from typing import Any

from jax import monitoring

from envs import _compat

_COMPILATION = "/jax/core/compile/backend_compile_duration"  # recorded at its start and at its end
_FATAL, _JAX_DEFAULT = 3, 1  # levels of TF_CPP_MIN_LOG_LEVEL

_lock = threading.Lock()
_running = 0


def silence() -> None:
    """From now on JAX's own C++ logs nothing below fatal while this process compiles anything.

    What makes a compilation fail is raised besides, and at all other times errors are logged as
    ever. Leaves alone what TF_CPP_MIN_LOG_LEVEL asks for, and plugins such as CUDA's, which log by
    themselves. To be called once.
    """
    if os.environ.get("TF_CPP_MIN_LOG_LEVEL", str(_JAX_DEFAULT)) == str(_JAX_DEFAULT):
        monitoring.register_scalar_listener(_begins)
        monitoring.register_event_duration_secs_listener(_ends)


def _begins(event: str, value: float, **_: Any) -> None:
    del value  # when
    _count(event, 1)


def _ends(event: str, duration_secs: float, **_: Any) -> None:
    del duration_secs
    _count(event, -1)


def _count(event: str, change: int) -> None:
    """Count the compilations that run, side by side in threads, and set the level by that."""
    global _running  # noqa: PLW0603
    if event == _COMPILATION:
        with _lock:
            _running += change
            _compat.set_least_logged_level(_FATAL if _running else _JAX_DEFAULT)
