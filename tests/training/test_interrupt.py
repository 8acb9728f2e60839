"""Signals: the first one sets a flag, the second interrupts."""

import contextlib
import os
import signal
import subprocess
import sys

import pytest

from lorasp_jax.training.interrupt import deferred, sigterm_as_interrupt
from tests import ROOT

IMPORTING = """
import os, runpy, sys

class Signal:
    def find_spec(self, name, *_):
        if name == "lorasp_jax.training.cost.dry_run":
            os.kill(os.getpid(), 15)

sys.meta_path.insert(0, Signal())
sys.argv = {arguments}
runpy.run_path({path!r}, run_name="__main__")
"""
SIGNALS = (signal.SIGINT, signal.SIGTERM)


@pytest.mark.parametrize("first", SIGNALS)
def test_the_first_signal_sets_a_flag_and_the_second_interrupts(first, capfd):
    with deferred() as stop:
        assert not stop.requested
        signal.raise_signal(first)
        assert stop.requested
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    assert capfd.readouterr().out.count("another signal stops immediately") == 1


def test_sigterm_is_like_ctrl_c():
    for number in SIGNALS:
        with sigterm_as_interrupt(), pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)


@pytest.mark.parametrize("block", [deferred, sigterm_as_interrupt])
def test_handlers_are_restored_after_an_error(block):
    before = [signal.getsignal(number) for number in SIGNALS]
    with contextlib.suppress(RuntimeError), block():
        assert signal.getsignal(signal.SIGTERM) != before[-1]
        raise RuntimeError
    assert [signal.getsignal(number) for number in SIGNALS] == before


def test_a_signal_during_imports_stops_the_process(tmp_path):
    """Later ones; for those before JAX see `tests/cli`."""
    config = str(ROOT / "configs" / "multitask.py")
    arguments = ["train.py", "--config", config, "--scale", "smoke", "--dry-run"]
    path = str(ROOT / "train.py")
    result = subprocess.run(
        [
            sys.executable,
            "-c",
            IMPORTING.format(arguments=arguments, path=path),
        ],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (result.returncode, result.stdout) == (130, "")
    assert result.stderr.startswith("stopped; to resume: python train.py")
    assert result.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())
