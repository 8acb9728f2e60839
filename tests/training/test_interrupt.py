"""Signals: the first one waits for a good moment, the second does not."""

import contextlib
import signal

import pytest

from lorasp_jax.training.interrupt import deferred, sigterm_as_interrupt

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
