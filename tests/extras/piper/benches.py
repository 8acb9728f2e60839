"""A connected arm, its fake other end and their clock, for tests."""

import itertools
import types
from dataclasses import dataclass

from lorasp_jax.extras.piper.arm import PiperArm
from lorasp_jax.extras.piper.arms import Arms
from lorasp_jax.extras.piper.fake import frames
from lorasp_jax.extras.piper.fake.firmware import PERIOD, FakePiper
from lorasp_jax.extras.piper.fake.timing import Lockstep
from lorasp_jax.extras.piper.safety import Limits

_CHANNELS = (f"bench{i}" for i in itertools.count())  # the SDK keeps one interface per name


def channel():
    return next(_CHANNELS)


@dataclass
class Faults:
    """What goes wrong; may be changed at any time.

    Attributes:
        silent: no frames are sent.
        zeros: all joints are reported as zero.
        status: arm_status that is reported, such as 7 for a collision; the arm then stands still.
        ctrl_mode: control mode that is reported in place of the true one.
        corrupted: the firmware's joint limits are those of a known defect: all -0.1 degrees.
        dead_driver: number from 0 of a joint whose driver does not switch on.
        clock_step: added to the frames' time stamps [s], as when the system's clock is set.
    """

    silent: bool = False
    zeros: bool = False
    status: int = 0
    ctrl_mode: int | None = None
    corrupted: bool = False
    dead_driver: int | None = None
    clock_step: float = 0.0


class FaultyPiper(FakePiper):
    """A fake arm with `faults`."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.faults, self._faulty = Faults(), 0

    def _move(self):
        if self.faults.status or self._faulty:  # an emergency stop is not of these faults
            self._stopped = self._faulty = self.faults.status
        super()._move()

    def _report(self):
        self.stamp += self.faults.clock_step
        if not self.faults.silent:
            super()._report()

    def _send(self, kind, data):
        faults = self.faults
        if kind in frames.JOINTS and faults.zeros:
            data = frames.pair(0, 0)
        elif kind == frames.STATUS and faults.ctrl_mode is not None:
            data = bytes([faults.ctrl_mode]) + data[1:]
        elif kind == frames.FIRMWARE_LIMITS and faults.corrupted:
            data = frames.firmware_limits(data[0], -0.1, -0.1, 3.0)
        elif faults.dead_driver is not None and kind == frames.DRIVERS[faults.dead_driver]:
            data = frames.driver(False)
        super()._send(kind, data)


class Bench(types.SimpleNamespace):
    """Attributes: arms, drivers, fakes, clock, world; arm and fake are the only or left one."""

    def __init__(self, world, seed=3, *, speed=1.0, limits=None, **options):
        world.reset(seed)
        limbs = {channel(): limb for limb in world.limbs.values()}
        fakes = [FaultyPiper(name, world, limb, **options) for name, limb in limbs.items()]
        clock = Lockstep(*fakes)
        drivers = [PiperArm(name, bus="virtual", clock=clock, speed=speed) for name in limbs]
        clock.start(*drivers)
        arms = Arms(dict(zip(world.limbs, drivers, strict=True)), limits or Limits.of())
        super().__init__(arms=arms, drivers=drivers, fakes=fakes, clock=clock, world=world)
        self.arm, self.fake = drivers[0], fakes[0]

    def ready(self):
        self.arms.connect()
        self.arms.enable()
        return self

    def wait(self, seconds):
        self.clock.wait_until(self.clock.now() + seconds)

    def lose(self, kinds):
        """Drop some kinds of the arm's frames from now on."""
        send = self.fake._send
        self.fake._send = lambda kind, data: kind in kinds or send(kind, data)

    def close(self):
        self.arms.close()
        for fake in self.fakes:
            fake.close()

    def every_control_step(self, function):
        """Return a function for every tick that calls another one every 0.1 s."""
        ticks = itertools.count(1)
        return lambda: next(ticks) % round(0.1 / PERIOD) == 0 and function()
