"""Signals: the first one waits for a good moment, the second does not."""

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
        if name == {place!r}:
            os.kill(os.getpid(), {number})

sys.meta_path.insert(0, Signal())
sys.argv = {arguments}
runpy.run_path({path!r}, run_name="__main__")
"""
SIGNALS = (signal.SIGINT, signal.SIGTERM)


@pytest.mark.parametrize("first", SIGNALS)
def test_first_signal_is_noted_and_second_interrupts(first, capfd):
    with deferred() as stop:
        assert not stop.requested
        signal.raise_signal(first)
        assert stop.requested
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    assert capfd.readouterr().out.count("once more stops at once") == 1


def test_sigterm_is_like_ctrl_c():
    for number in SIGNALS:
        with sigterm_as_interrupt(), pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)


@pytest.mark.parametrize("block", [deferred, sigterm_as_interrupt])
def test_handlers_are_put_back_after_an_error(block):
    before = [signal.getsignal(number) for number in SIGNALS]
    with contextlib.suppress(RuntimeError), block():
        assert signal.getsignal(signal.SIGTERM) not in before
        raise RuntimeError
    assert [signal.getsignal(number) for number in SIGNALS] == before


@pytest.mark.parametrize(
    ("place", "number", "said"),
    [
        ("jax", signal.SIGTERM, ""),
        ("jax", signal.SIGINT, ""),
        ("lorasp_jax.training.cost.dry_run", signal.SIGTERM, "stopped; to resume: python train.py"),
    ],
)
def test_a_process_that_starts(place, number, said, tmp_path):
    """Imports take seconds."""
    config = str(ROOT / "configs" / "multitask.py")
    arguments = ["train.py", "--config", config, "--scale", "smoke", "--dry-run"]
    path = str(ROOT / "train.py")
    found = subprocess.run(
        [
            sys.executable,
            "-c",
            IMPORTING.format(place=place, number=int(number), arguments=arguments, path=path),
        ],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (found.returncode, found.stdout) == (130, "")
    assert found.stderr.startswith(said)
    assert found.stderr.count("\n") == bool(said)
    assert not list(tmp_path.iterdir())
