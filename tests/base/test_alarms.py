"""XLA's alarms are silent during compilation, and its errors are logged at other times."""

import os
import subprocess
import sys
import threading

import jax
import pytest
from jax import monitoring

from lorasp_jax.base import alarms

# A sum over windows, which XLA computes while it compiles: seconds on one core of any machine.
SLOW = """
import os
os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
import jax
{}
iota = lambda: jax.lax.iota("float32", 20_000)
sums = lambda x: x + jax.lax.reduce_window(iota(), 0.0, jax.lax.add, (100,), (1,), "VALID")
jax.jit(sums).lower(1.0).compile()
"""


@pytest.fixture
def levels(monkeypatch):
    """Log levels in the order they were set."""
    found = []
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "1")
    running = alarms.silence(found.append)
    assert running is not None
    yield found
    monitoring.unregister_scalar_listener(running.on_start)
    monitoring.unregister_event_duration_listener(running.on_end)


def compiled(value):
    """Compile a different program for each value."""
    return jax.jit(lambda x: x + value).lower(1.0).compile()


def test_only_fatal_errors_while_compiling(levels):
    compiled(1)
    assert levels == [3, 1]


def test_silent_until_the_last_compilation_ends(levels):
    def compile_inside(event, *_, **__):
        if event == alarms.COMPILATION and len(levels) == 1:
            thread = threading.Thread(target=compiled, args=[2])
            thread.start()
            thread.join()

    monitoring.register_scalar_listener(compile_inside)
    compiled(3)
    monitoring.unregister_scalar_listener(compile_inside)
    assert levels == [3, 3, 3, 1]


def test_a_failed_compilation_counts_as_ended(levels):
    with pytest.raises(jax.errors.JaxRuntimeError, match="xla_no_such_option"):
        jax.jit(lambda x: x + 4).lower(1.0).compile(compiler_options={"xla_no_such_option": "1"})
    assert levels == [3, 1]


def test_a_level_set_by_the_user_stays(monkeypatch):
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "0")
    assert alarms.silence([].append) is None


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="only Linux pins to a core")
@pytest.mark.parametrize("silent", [False, True])
def test_no_alarm_reaches_the_terminal(silent):
    program = SLOW.format("from lorasp_jax.base import alarms; alarms.silence()" if silent else "")
    options = {"JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "false"}
    found = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | options,
        capture_output=True,
        text=True,
        check=True,
    )
    assert ("Constant folding an instruction is taking" in found.stderr) == (not silent)
