"""A clock on which time stands still while anybody thinks.

The client's control loop, the fake arm and the policy take turns, so an episode gives the same
result on a slow machine as on a fast one, and a policy's latency is a setting.
"""

import time

from lorasp_jax.serving.fake_piper.firmware import PERIOD, FakePiper
from lorasp_jax.serving.piper.arm import PiperArm

_PATIENCE = 5.0  # s of real time for the SDK's thread to read what the fake arm sent


class Lockstep:
    """Simulated time: waiting for it advances the fake arm."""

    def __init__(self, fake: FakePiper) -> None:
        """Create the clock of a fake arm; set `arm` before the first wait."""
        self._fake = fake
        self.arm: PiperArm | None = None

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
        if self.arm is None or self._fake.faults.silent:
            return
        while self.arm.sdk.GetCanBus().send_bus.recv(0) is not None:
            pass  # the SDK only sends on this bus, so nobody else empties its queue
        end = time.monotonic() + _PATIENCE
        while self.arm.sdk.GetArmStatus().time_stamp != self._fake.time:
            if time.monotonic() > end:
                raise TimeoutError("piper_sdk does not read the virtual bus")
            time.sleep(0)
