"""Sessions of the PiPER client on the fake arm, and what must hold after them."""

import numpy as np

from lorasp_jax.extras.piper.asking import InTurn
from lorasp_jax.extras.piper.safety import Limits
from lorasp_jax.extras.piper.session import PERIOD, Session
from lorasp_jax.extras.piper.settings import Settings
from tests.extras.serving.stand_in import StandIn

LIMITS = Limits.of()
ARM_STEP = np.array([0.03, 0, 0, 0, 0, 0, 0])  # rad per action


class Still(StandIn):
    """Answers with the state, so that the arm does not move."""

    def prepare(self, adapter, request, index):
        self.last_request = request
        return request.state


class Turning:
    """Turns the base of each arm by `ARM_STEP` an action; keeps what it was asked."""

    def __init__(self, chunk=10):
        self.asked, self.chunk, self.change = [], chunk, lambda actions: actions

    def __call__(self, observation):
        self.asked.append(observation)
        steps = np.arange(1, self.chunk + 1)[:, None]
        state = observation["state"]
        return self.change(state + steps * np.resize(ARM_STEP, len(state)))


class Run:
    """A session whose sentences are kept; `at` calls functions at times since the start."""

    def __init__(self, bench, ask, *, look=None, latency=0.0, **options):
        self.bench, self.said, self.at, self.commands = bench, [], {}, []
        settings = Settings("turn", hold=options.pop("hold", 0.5), **options.pop("settings", {}))
        asker = options.pop("asker", None) or InTurn(ask, bench.clock, latency)
        self.session = Session(
            bench.arms,
            look or bench.world.images,
            asker,
            settings,
            bench.clock,
            say=options.pop("say", self.said.append),
            **options,
        )

    def __call__(self, seconds, done=lambda: False):
        start, pending = self.bench.clock.now(), dict(self.at)
        sent = self.all_sent = [[] for _ in self.bench.drivers]
        self.sent = sent[0]
        for arm, own in zip(self.bench.drivers, sent, strict=True):
            arm.command = lambda pose, own=own, command=arm.command: (
                own.append(pose.copy()) or command(pose)
            )

        def each_tick():
            self.commands.append(self.session._arms.pose)
            for time in [t for t in pending if self.bench.clock.now() - start >= t]:
                pending.pop(time)()
            return done()

        return self.session.run(seconds, each_tick)

    @property
    def path(self):
        return np.stack(self.commands)


def assert_safe(run, jump=0.0):
    """Check the commands of all ticks, and what the fake arm thinks of them.

    At the start of a hold, the command may jump back to the measured pose [rad].
    """
    for path in np.split(run.path, len(run.bench.fakes), axis=1):
        steps = np.abs(np.diff(path, axis=0)[:, :6]).max(axis=1)
        assert np.sort(steps)[-2] < 1.0 * PERIOD + 1e-9
        assert steps.max() < max(jump, 1.0 * PERIOD + 1e-9)
    assert [fake.unsafe for fake in run.bench.fakes] == [[]] * len(run.bench.fakes)


def assert_braked(run, arms=None, jump=0.0):
    """Check that arms, by default all, moved, and were stopped within the limits."""
    for sent in run.all_sent if arms is None else [run.all_sent[arm] for arm in arms]:
        velocity = np.diff(np.stack(sent), axis=0)[:, :6] / PERIOD
        assert np.abs(velocity).max() > 0.25
        assert np.abs(np.diff(velocity, axis=0)).max() <= LIMITS.acceleration[0] * PERIOD + 1e-9
        assert not velocity[-1].any()
    assert_safe(run, jump)


def assert_holds(run, words, jump=0.0):
    """Check that the arm stands still, and that one sentence says why."""
    bench = run.bench
    bench.wait(0.5)  # until the servos have caught up
    before = [limb.pose for limb in bench.world.limbs.values()]
    bench.wait(0.3)
    after = [limb.pose for limb in bench.world.limbs.values()]
    np.testing.assert_allclose(after, before, atol=2e-3)
    holding = [text for text in run.said if text.startswith("holding")]
    assert len(holding) == 1, run.said
    assert words in holding[0]
    assert_safe(run, jump)
