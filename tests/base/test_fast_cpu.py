"""The XLA flag that MJX needs on CPU with old JAX."""

import functools
import inspect
import os
import subprocess
import sys

import jax
import pytest

import envs
from lorasp_jax.base import _compat, fast_cpu
from tests import xla

OLD = jax.__version_info__ < (0, 11)
old = pytest.mark.skipif(not OLD, reason="newer versions need no flag")


def python(code, flags=""):
    """Run code in a new process, with warnings as errors."""
    root = os.path.dirname(os.path.dirname(envs.__file__))
    environment = os.environ | {"XLA_FLAGS": flags}
    subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "-c", code],
        cwd=root,
        env=environment,
        check=True,
    )


@pytest.mark.parametrize(
    "call",
    [
        "lorasp_jax.base.fast_cpu.warn_if_late()",  # as envs.make does, which loads MJX for seconds
        pytest.param("envs.make('press')", marks=pytest.mark.slow),
    ],
)
def test_import_sets_the_flag_again_if_flags_are_replaced(call):
    python(
        "import os, jax, envs, lorasp_jax.base.fast_cpu\n"
        "is_set = lambda: '--xla_cpu_use_fusion_emitters=false' in os.environ['XLA_FLAGS']\n"
        f"assert is_set() == {OLD}\n"
        "os.environ['XLA_FLAGS'] = '--xla_force_host_platform_device_count=2'\n"
        f"{call}\n"
        f"assert is_set() == {OLD}\n"
        "assert jax.device_count() == 2",
        "--xla_force_host_platform_device_count=3",
    )


@old
def test_the_users_flag_stays(monkeypatch):
    flags = "--xla_cpu_use_fusion_emitters=true"
    monkeypatch.setenv("XLA_FLAGS", flags)
    for started in (True, False):
        monkeypatch.setattr(_compat, "backends_are_initialized", lambda started=started: started)
        assert not fast_cpu.set_flag()
    assert os.environ["XLA_FLAGS"] == flags


@old
def test_too_late_warns_once(monkeypatch):
    jax.devices()
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(fast_cpu, "is_late", fast_cpu.is_late.__wrapped__)
    once = functools.cache(fast_cpu.warn_if_late.__wrapped__)
    monkeypatch.setattr(fast_cpu, "warn_if_late", once)
    with pytest.warns(UserWarning, match="15 to 400 times slower.*Import envs before") as caught:
        assert all(envs.make("press") for _ in range(2))
    assert len(caught) == 1


LATE = (
    "import time, warnings, jax\n"
    "jax.devices()\n"
    "import envs\n"
    "with warnings.catch_warnings(record=True) as caught:\n"
    "    warnings.simplefilter('always')\n"
    "    env = [envs.make('press'), envs.make('press')][0]\n"
    "(output,) = map(str, [w.message for w in caught if w.category is UserWarning])\n"
    "assert '15 to 400 times slower' in output and 'Import envs before' in output, output\n"
)
FAST = (
    "state = env.reset(jax.random.key(0))\n"
    "state = env.step(state, state.info['command'])\n"
    "jax.eval_shape(jax.jit(env.step), state, state.info['command'])\n"
    "start = time.process_time()\n"
    "for _ in range(10):\n"
    "    state = env.step(state, state.info['command'])\n"
    "jax.block_until_ready(state)\n"
    "assert time.process_time() - start < 1.5"  # otherwise 10 s
)


@old
@pytest.mark.slow
def test_too_late_warns_once_and_our_programs_are_fast():
    python(LATE + FAST, xla.UNOPTIMIZED)


@old
@pytest.mark.parametrize(
    ("late", "used"),
    [(False, {}), (True, {"compiler_options": {"xla_cpu_use_fusion_emitters": False}})],
)
def test_our_programs_get_the_option_if_it_is_too_late(late, used, monkeypatch):
    monkeypatch.setattr(fast_cpu, "is_late", lambda: late)
    monkeypatch.setattr(jax, "jit", lambda function, **options: lambda x: (function(x), options))
    assert fast_cpu.jit(abs)(-1) == (1, used)


def test_programs_without_simulation_use_jaxs_defaults():
    options = inspect.unwrap(fast_cpu.without_simulation)()  # in fast tests it is replaced
    assert options == ({"xla_cpu_use_fusion_emitters": True} if OLD else None)
    assert jax.jit(lambda x: x + 1).lower(1).compile(compiler_options=options)(1) == 2
