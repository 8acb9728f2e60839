"""A connected arm, its fake other end and their clock, for tests."""

import itertools
import types

from lorasp_jax.extras.piper.arm import PiperArm
from lorasp_jax.extras.piper.fake.firmware import PERIOD, FakePiper
from lorasp_jax.extras.piper.fake.timing import Lockstep

_CHANNELS = (f"bench{i}" for i in itertools.count())  # the SDK keeps one interface per name


def channel():
    return next(_CHANNELS)


class Bench(types.SimpleNamespace):
    """Attributes: arm, fake, clock, world."""

    def __init__(self, world, seed=3, *, speed=1.0, **options):
        world.reset(seed)
        name = channel()
        fake = FakePiper(name, world, **options)
        clock = Lockstep(fake)
        arm = PiperArm(name, bus="virtual", clock=clock, speed=speed)
        clock.start(arm)
        super().__init__(arm=arm, fake=fake, clock=clock, world=world)

    def ready(self, limits):
        self.arm.connect()
        self.arm.enable(limits)
        return self

    def wait(self, seconds):
        self.clock.wait_until(self.clock.now() + seconds)

    def lose(self, kinds):
        """Drop some kinds of the arm's frames from now on."""
        send = self.fake._send
        self.fake._send = lambda kind, data: kind in kinds or send(kind, data)

    def close(self):
        self.arm.close()
        self.fake.close()

    def every_control_step(self, function):
        """Return a function for every tick that calls another one every 0.1 s."""
        ticks = itertools.count(1)
        return lambda: next(ticks) % round(0.1 / PERIOD) == 0 and function()
