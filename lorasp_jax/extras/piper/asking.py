"""Ask a policy for actions while the arm goes on."""

import threading
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from lorasp_jax.extras.piper.clock import Clock
from lorasp_jax.extras.serving.client import PolicyError

Observation = Mapping[str, Any]
"""`image`: camera -> uint8 [H, W, 3]; `state`: f32 [7]; `prompt`: the request in words; `executed`
and `delay` as in `lorasp_jax.extras.serving.requests`, if the arm does not wait for the answer."""
Ask = Callable[[Observation], Any]
"""Return actions [C, 7] for an observation; may raise anything."""


class Asker(Protocol):
    """One question at a time."""

    def ask(self, observation: Observation) -> None:
        """Send a question."""
        ...

    def answer(self) -> Any | None:
        """Return the actions once they are there, else None.

        Raises:
            PolicyError: asking raised something.
        """
        ...


class InThread:
    """Asks in a thread; answers arrive when they do."""

    def __init__(self, ask: Ask) -> None:
        """Wrap a function that waits for the answer."""
        self._ask = ask
        self._outcome: list | None = None

    def ask(self, observation: Observation) -> None:
        """Send a question."""
        self._outcome = outcome = []
        self._thread = threading.Thread(
            target=lambda: outcome.append(_outcome(self._ask, observation)), daemon=True
        )
        self._thread.start()

    def answer(self) -> Any | None:
        """Return the actions once they are there, else None; raise `PolicyError`."""
        return _unpack(self._outcome)


class InTurn:
    """Asks while simulated time stands still; answers arrive after a chosen latency."""

    def __init__(self, ask: Ask, clock: Clock, latency: float = 0.0) -> None:
        """Wrap a function, on a simulated clock.

        Args:
            ask: the function.
            clock: measures the latency.
            latency: time from question to answer [s].
        """
        self._ask, self._clock, self._latency = ask, clock, latency
        self._outcome, self._due = [], 0.0

    def ask(self, observation: Observation) -> None:
        """Send a question."""
        self._outcome = [_outcome(self._ask, observation)]
        self._due = self._clock.now() + self._latency

    def answer(self) -> Any | None:
        """Return the actions once they are due, else None; raise `PolicyError`."""
        return _unpack(self._outcome) if self._clock.now() >= self._due - 1e-9 else None


def _outcome(ask: Ask, observation: Observation) -> tuple[Any, Exception | None]:
    try:
        return np.asarray(ask(observation)), None
    except Exception as error:  # raised again in the control loop
        return None, error


def _unpack(outcome: list | None) -> Any | None:
    if not outcome:
        return None
    actions, error = outcome[0]
    if error:
        raise PolicyError(str(error) or type(error).__name__) from error
    return actions
