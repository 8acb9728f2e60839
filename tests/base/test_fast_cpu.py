"""The XLA flag that MJX needs on CPU with old JAX; each test in a fresh process."""

import inspect
import os
import subprocess
import sys

import jax
import pytest

import envs
from lorasp_jax.base import fast_cpu
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


def test_import_sets_the_flag_again_if_flags_are_replaced():
    python(
        "import os, jax, envs\n"
        "is_set = lambda: '--xla_cpu_use_fusion_emitters=false' in os.environ['XLA_FLAGS']\n"
        f"assert is_set() == {OLD}\n"
        "os.environ['XLA_FLAGS'] = '--xla_force_host_platform_device_count=2'\n"
        "envs.make('press')\n"
        f"assert is_set() == {OLD}\n"
        "assert jax.device_count() == 2",
        "--xla_force_host_platform_device_count=3",
    )


@old
def test_the_users_flag_stays():
    flags = "--xla_cpu_use_fusion_emitters=true"
    python(f"import os, envs\nassert os.environ['XLA_FLAGS'] == {flags!r}", flags)


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
@pytest.mark.parametrize("then", ["", pytest.param(FAST, marks=pytest.mark.slow)])
def test_too_late_warns_once_and_our_programs_are_fast(then):
    python(LATE + then, xla.UNOPTIMIZED)


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
