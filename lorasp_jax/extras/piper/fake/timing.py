"""The two kinds of time in which fake arms can live."""

import threading
import time

from lorasp_jax.extras.piper.arm import PiperArm
from lorasp_jax.extras.piper.clock import RealClock
from lorasp_jax.extras.piper.fake import frames
from lorasp_jax.extras.piper.fake.firmware import PERIOD, FakePiper

_PATIENCE = 5.0  # s of real time for the SDK's thread to read what a fake arm sent


class _Fakes:
    """Fake arms in one world, which take their turns together."""

    def __init__(self, *fakes: FakePiper) -> None:
        """Create the clock of fake arms."""
        self.fakes, self._arms = fakes, ()
        self._turn = threading.Lock()  # the arms may live in a thread of their own

    def reset(self, seed: int) -> None:
        """Start a random layout, with the arms at rest in their start poses.

        Commands that are still on their way are lost: they were meant for the previous layout.
        """
        with self._turn:
            self.fakes[0].world.reset(seed)
            for fake in self.fakes:
                fake.start()

    def _tick(self) -> None:
        """Advance by `PERIOD`: receive, simulate, send; nobody else reads the SDK's own frames."""
        with self._turn:
            for fake in self.fakes:
                fake.obey()
            self.fakes[0].world.advance(PERIOD)
            for fake in self.fakes:
                fake.report()
        for arm in self._arms:
            while (bus := arm.sdk.GetCanBus().send_bus) is not None and bus.recv(0) is not None:
                pass


class Lockstep(_Fakes):
    """Simulated time, which stands still while anybody thinks.

    The client's control loop, the fake arms and the policy take turns, so an episode gives the same
    result on a slow machine as on a fast one, and a policy's latency is a setting.
    """

    def start(self, *arms: PiperArm) -> None:
        """Wait for these arms' drivers from now on."""
        self._arms = arms

    def stop(self) -> None:
        """Do nothing: this clock only goes while somebody waits."""

    def now(self) -> float:
        """Return the simulated time [s]."""
        return self.fakes[0].time

    def wait_until(self, seconds: float) -> None:
        """Advance the fake arms to a time, after each tick until the SDK has read all frames."""
        while self.now() < seconds - PERIOD / 2:
            self._tick()
            for arm, fake in zip(self._arms, self.fakes, strict=False):
                if arm.sdk.get_connect_status():  # else it does not read yet
                    self._wait_for_reader(arm, fake)

    def _wait_for_reader(self, arm: PiperArm, fake: FakePiper) -> None:
        """Wait for the status frame, which is the last of every tick."""
        end = time.monotonic() + _PATIENCE
        while arm.heard.get(frames.STATUS, 0.0) != fake.reported:
            if time.monotonic() > end:
                raise TimeoutError("piper_sdk does not read the virtual bus")
            time.sleep(0)


class RealTime(_Fakes, RealClock):
    """The machine's monotonic clock; the fake arms live in a thread of their own."""

    def start(self, *arms: PiperArm) -> None:
        """Start the fake arms."""
        self._arms, self._stop = arms, threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop the fake arms."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        due = self.now()
        while not self._stop.is_set():
            self._tick()
            due += PERIOD
            self.wait_until(due)
