"""Single keys of a terminal, without Enter."""

import contextlib
import os
import select
import signal
import sys
import termios
import time
import tty
from typing import Any, Self

from lorasp_jax.base.signals import handled

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)
"""Those that end or suspend a program, and so must stop the arm."""


class Keyboard:
    """The keys that a person presses; use it as a context, which gives the terminal back.

    Attributes:
        ended: whether nobody can press a key, or no more.
    """

    def __enter__(self) -> Self:
        """Let keys arrive at once if there is a terminal."""
        self.ended, self._stack = True, contextlib.ExitStack()
        with contextlib.suppress(OSError, ValueError):  # nobody is there
            self._file = sys.stdin.fileno()
            if os.isatty(self._file):
                if os.tcgetpgrp(self._file) != os.getpgrp():
                    return self  # in the background, reading it would suspend the program
                before = termios.tcgetattr(self._file)
                self._stack.callback(termios.tcsetattr, self._file, termios.TCSANOW, before)
                tty.setcbreak(self._file)  # Ctrl-C stays a signal
            self.ended = False
        return self

    def __exit__(self, *_: object) -> None:
        """Give the terminal back."""
        with contextlib.suppress(termios.error):  # it may have gone
            self._stack.close()

    def pressed(self, seconds: float | None = 0.0) -> str:
        """Return the next key, or "" if there is none within some time [s]; None: wait for it."""
        if self.ended or not select.select([self._file], [], [], seconds)[0]:
            return ""
        try:
            key = os.read(self._file, 1).decode(errors="replace")
        except OSError:  # the terminal has gone
            key = ""
        self.ended = not key
        return key

    def ask(self, question: str, keys: str, seconds: float | None = None) -> str:
        """Return one of some keys, or "" after some time [s].

        Raises:
            EOFError: nobody can answer, or a signal other than Ctrl-C ends the program.
            KeyboardInterrupt: Ctrl-C.
        """
        print(question, flush=True)
        end = None if seconds is None else time.monotonic() + seconds
        with handled(SIGNALS, _end):  # signals end the question, not what may be written after it
            while not self.ended:
                key = self.pressed(None if end is None else max(0.0, end - time.monotonic()))
                if key and key in keys:
                    return key
                if end is not None and time.monotonic() >= end:
                    return ""
        raise EOFError("there is no terminal")


def _end(number: int, _: Any) -> None:
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise EOFError(signal.Signals(number).name)  # the terminal may be gone
