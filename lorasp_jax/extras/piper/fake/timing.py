"""The two kinds of time in which a fake arm can live."""

import threading
import time

from lorasp_jax.extras.piper.arm import PiperArm
from lorasp_jax.extras.piper.clock import RealClock
from lorasp_jax.extras.piper.fake import frames
from lorasp_jax.extras.piper.fake.firmware import PERIOD, FakePiper

_PATIENCE = 5.0  # s of real time for the SDK's thread to read what the fake arm sent


class Lockstep:
    """Simulated time, which stands still while anybody thinks.

    The client's control loop, the fake arm and the policy take turns, so an episode gives the same
    result on a slow machine as on a fast one, and a policy's latency is a setting.
    """

    def __init__(self, fake: FakePiper) -> None:
        """Create the clock of a fake arm."""
        self._fake = fake
        self._arm: PiperArm | None = None

    def start(self, arm: PiperArm) -> None:
        """Wait for this arm's driver from now on."""
        self._arm = arm

    def stop(self) -> None:
        """Do nothing: this clock only goes while somebody waits."""

    def now(self) -> float:
        """Return the simulated time [s]."""
        return self._fake.time

    def wait_until(self, seconds: float) -> None:
        """Advance the fake arm to a time, after each tick until the SDK has read all frames."""
        while self._fake.time < seconds - PERIOD / 2:
            self._fake.tick()
            self._wait_for_reader()

    def _wait_for_reader(self) -> None:
        """Wait for the status frame, which is the last of every tick."""
        if self._arm is None:
            return
        _discard(self._arm)
        end = time.monotonic() + _PATIENCE
        while self._arm.heard.get(frames.STATUS, 0.0) != self._fake.reported:
            if time.monotonic() > end:
                raise TimeoutError("piper_sdk does not read the virtual bus")
            time.sleep(0)


class RealTime(RealClock):
    """The machine's monotonic clock; the fake arm lives in a thread of its own."""

    def __init__(self, fake: FakePiper) -> None:
        """Create the clock of a fake arm."""
        self._fake, self._stop = fake, threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, arm: PiperArm) -> None:
        """Start the fake arm."""
        self._thread = threading.Thread(target=self._run, args=(arm,), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop the fake arm."""
        self._stop.set()
        if self._thread:
            self._thread.join()

    def _run(self, arm: PiperArm) -> None:
        due = self.now()
        while not self._stop.is_set():
            self._fake.tick()
            _discard(arm)
            due += PERIOD
            self.wait_until(due)


def _discard(arm: PiperArm) -> None:
    """Empty the queue of the bus on which the SDK only sends, as nobody else does."""
    while (bus := arm.sdk.GetCanBus().send_bus) is not None and bus.recv(0) is not None:
        pass
