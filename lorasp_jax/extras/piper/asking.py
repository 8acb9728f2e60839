"""Ask a policy for actions while the arm goes on."""

import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from lorasp_jax.extras.piper.clock import Clock
from lorasp_jax.extras.serving.client import PolicyError

Observation = Mapping[str, Any]
"""`image`: camera -> uint8 [H, W, 3]; `state`: f32 [7 N] of N arms; `prompt`: the request in words;
`executed` and `delay` as in `lorasp_jax.extras.serving.requests`, if they do not wait for the
answer."""
Ask = Callable[[Observation], Any]
"""Return actions [C, 7 N] for an observation; may raise anything."""


class InThread:
    """Asks one question at a time in a thread; answers arrive when they do."""

    def __init__(self, ask: Ask) -> None:
        """Wrap a function that waits for the answer."""
        self._ask = ask
        self._outcome: list[tuple[Any, Exception | None]] = []

    def ask(self, observation: Observation) -> None:
        """Send a question."""
        self._outcome = outcome = []  # an answer to an earlier question has a list of its own

        def work() -> None:
            try:
                outcome.append((np.asarray(self._ask(observation)), None))
            except Exception as error:  # raised again in the control loop
                outcome.append((None, error))

        self._thread = threading.Thread(target=work, daemon=True)
        self._thread.start()

    def answer(self) -> Any | None:
        """Return the actions once they are there, else None.

        Raises:
            PolicyError: asking raised something.
        """
        if not self._outcome:
            return None
        actions, error = self._outcome[0]
        if error:  # some servers answer with a traceback, whose last line says what is wrong
            sentence = str(error).strip().rpartition("\n")[2]
            raise PolicyError(sentence or type(error).__name__) from error
        return actions


class InTurn(InThread):
    """Asks while simulated time stands still; answers arrive after a chosen latency."""

    def __init__(self, ask: Ask, clock: Clock, latency: float = 0.0) -> None:
        """Wrap a function; `latency` is the time from question to answer [s] on the clock."""
        super().__init__(ask)
        self._clock, self._latency, self._due = clock, latency, 0.0

    def ask(self, observation: Observation) -> None:
        """Send a question."""
        super().ask(observation)
        self._thread.join()
        self._due = self._clock.now() + self._latency

    def answer(self) -> Any | None:
        """Return the actions once they are due, else None; raise `PolicyError`."""
        return super().answer() if self._clock.now() >= self._due - 1e-9 else None
