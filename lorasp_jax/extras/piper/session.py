"""The control loop: read the arm, ask the policy, command the arm, 200 times a second.

Whatever goes wrong, the arm brakes and holds. Only then one sentence says why, since a terminal may
block. If feedback or pictures come back soon, it goes on from where it holds. Otherwise, and after
a refused chunk or a policy's error, it moves slowly to its rest pose and stays there, powered; it
does not move again while it reports a fault itself. Signals and all other errors stop it where it
is. Several arms do all of this as one: what goes wrong with one holds all.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from lorasp_jax.base.errors import describe_any, one_line
from lorasp_jax.extras.piper.arms import PERIOD, Arms
from lorasp_jax.extras.piper.asking import InThread
from lorasp_jax.extras.piper.cameras import Look, NoPicture
from lorasp_jax.extras.piper.clock import Clock
from lorasp_jax.extras.piper.interpolation import Path
from lorasp_jax.extras.piper.log import Log
from lorasp_jax.extras.piper.recording import Recording
from lorasp_jax.extras.piper.safety import CAN_CONTROL, Reading, Unsafe
from lorasp_jax.extras.piper.settings import Settings
from lorasp_jax.extras.serving.client import PolicyError

_REACHED = 0.01  # rad from the rest pose that counts as arrived
_APPROACH_TIME = 20.0  # s that the way to the first action may take
_GO_TIME = 60.0  # s that the way to the rest or start pose may take
_INSTANT = 1e-6  # control steps that rounding may take from a clock's time
_LATE = 0.05  # s of delay after which ticks are skipped instead of made up for


class Session:
    """One run of a policy on one or several arms.

    Attributes:
        problem: why the arms hold, in a sentence; None while they do not.
        chunks: number of chunks received.
        stopped: whether `stop` was called.
    """

    def __init__(
        self,
        arms: Arms,
        look: Look,
        asker: InThread,
        settings: Settings,
        clock: Clock,
        *,
        log: Log | None = None,
        recorder: Recording | None = None,
        say: Callable[[str], None] = print,
    ) -> None:
        """Prepare a session; the arms are enabled, unless it is a dry run."""
        self._arms, self._look, self._asker, self._clock = arms, look, asker, clock
        self._settings, self._log, self._say = settings, log, say
        self._recorder = recorder
        self.problem: str | None = None
        self.chunks = 0
        self._final, self._since, self.stopped, self._next = False, 0.0, False, 0.0
        self._untold: list[str] = []
        self._warned = False
        self._forget()

    def stop(self) -> None:
        """Brake and hold from the next tick on; may be called from a signal handler."""
        self.stopped = True

    def run(self, seconds: float, done: Callable[[], bool] = lambda: False) -> str | None:
        """Run the policy until the time is over, `done` says so, or a problem lasts.

        However it ends, the arm has braked and holds.

        Returns:
            The problem in a sentence, or None.

        Raises:
            ValueError: the first chunk has fewer actions than the settings need; the arm has not
                moved.
            BaseException: whatever else a camera, the log, `say` or `done` raised.
        """
        return self._guarded(lambda: self._follow(seconds, done))

    def home(self, pose: np.ndarray) -> str | None:
        """Move slowly to a pose [7 N] after a run; result and errors are those of `run`."""

        def work() -> None:
            self._say("moving slowly to the start pose")
            if problem := self._go(pose):
                self._hold(problem)

        return self._guarded(work)

    def _guarded(self, work: Callable[[], None]) -> str | None:
        """Work on an arm at rest; however that ends, brake, then say why, and only then raise."""
        self._arms.start(self._read())
        self._failures: list[BaseException] = []
        self._attempt(work)
        self._settle()
        if self._failures:
            first = self._failures[0]
            self._attempt(self._hold, describe_any(first))
        self._attempt(self._tell)
        if self._failures:
            raise self._failures[0]
        if self.stopped:
            self._say("stopped")
        return self.problem

    def _attempt(self, part: Callable[..., Any], *arguments: Any) -> None:
        """Call a function; what it raises, if anything, waits until the arm has braked."""
        try:
            part(*arguments)
        except BaseException as error:
            self._failures.append(error)

    def _follow(self, seconds: float, done: Callable[[], bool]) -> None:
        self._next = start = self._clock.now()
        while self._clock.now() - start < seconds and not self.stopped and not done():
            self._tick()
            held = self.problem and not self._arms.moving
            if held and self._clock.now() - self._since > self._settings.hold:
                self._rest()
                break

    def _tick(self) -> None:
        self._read()
        try:
            if problem := self._arms.fault():
                self._fail(problem)
            elif not self._final:
                self._drive(self._clock.now())
        except (Unsafe, PolicyError) as error:
            self._hold(one_line(error))
            self._final |= not isinstance(error, NoPicture)
        if self.problem:
            self._send(self._arms.brake())
        if not self._arms.moving:
            self._tell()
        self._wait()

    def _drive(self, now: float) -> None:
        """Follow the policy's path by one tick."""
        if self.problem:
            if self._arms.moving:
                return  # it brakes to the end, whatever comes back
            self._look()  # still no picture: it goes on holding
            self._say("going on")
            self._arms.start(self._arms.pose)
            self.problem = None
            self._forget()
        self._receive(now)
        if self._asked is None and self._wants_chunk(now):
            self._ask(now)
            self._receive(now)
        if self._asked is not None and now - self._asked > self._settings.patience:
            raise PolicyError(f"the server did not answer within {self._settings.patience:g} s")
        if self._path is None:
            self._send(self._arms.brake())
            return
        if self._arms.approaching:
            self._send(self._approach(self._path, now))
        else:
            self._record(now)
            self._send(self._arms.step(self._path.target(now + PERIOD - self._start)))

    def _approach(self, path: Path, now: float) -> np.ndarray:
        """Return the command of a tick on the way to the first action; the path waits for it."""
        command = self._arms.step(path.action(0))
        if self._approached is None:
            self._approached = now
        if now - self._approached > _APPROACH_TIME:
            raise Unsafe("the first action is out of reach: the finger tips would leave the box")
        self._path, self._start = path.starting_at(command), now + PERIOD
        return command

    def _ask(self, now: float) -> None:
        images = self._look()
        state = self._arms.measured.astype(np.float32)
        observation = {"image": images, "state": state, "prompt": self._settings.prompt}
        if self._path:
            self._executed = min(round(self._position(now)), self._path.steps)
            if self._settings.ahead:  # the new chunk may continue the previous one
                left = self._path.steps - self._executed
                observation |= {"executed": self._executed, "delay": left}
        if self._log:
            self._log.observation(now, observation)
        self._asker.ask(observation)
        self._asked = now

    def _receive(self, now: float) -> None:
        """Start on a new chunk if there is one."""
        if self._asked is None or (actions := self._asker.answer()) is None:
            return
        settings, chunk = self._settings, self._arms.check_chunk(actions)
        self._check_length(chunk)
        if not self._warned and (warning := self._arms.clamped(chunk)):
            self._warned = True
            self._untold.append(warning)
        own = chunk[: settings.execute + settings.ahead]
        if self._path is None:
            self._path = Path(self._arms.pose, own, settings.control_dt)
            self._start, self._recorded = now, -1
        else:
            self._switch(own, now)
        self._asked = None
        self.chunks += 1
        self._write(now, chunk=chunk, start=self._start)

    def _check_length(self, chunk: np.ndarray) -> None:
        """Refuse a chunk that is too short; ValueError if it is the first, as no arm moves yet."""
        execute, ahead = self._settings.execute, self._settings.ahead
        if len(chunk) >= execute + ahead:
            return
        needed = f"need chunks of at least {execute + ahead} actions, got {len(chunk)}"
        problem = f"execute {execute} and ahead {ahead} {needed}"
        if self.chunks:
            raise Unsafe(problem)
        raise ValueError(problem)

    def _switch(self, chunk: np.ndarray, now: float) -> None:
        """Let a new chunk take over where the present action ends, as in the simulation.

        If the path has ended, the arm has waited, and no action is skipped for that time.
        """
        assert self._path is not None
        step = min(math.ceil(self._position(now) - _INSTANT), self._path.steps)
        skipped = step - self._executed
        self._path = self._path.switching(self._executed, step, chunk)
        self._recorded -= self._executed
        dt = self._settings.control_dt
        self._start = max(self._start + self._executed * dt, now - skipped * dt)

    def _wants_chunk(self, now: float) -> bool:
        if self._path is None:
            return True
        return self._path.steps - self._position(now) <= self._settings.ahead + _INSTANT

    def _position(self, now: float) -> float:
        """Return the time on the path in control steps."""
        return (now - self._start) / self._settings.control_dt

    def _fail(self, problem: str) -> None:
        """Hold because of what an arm reports: where it is, if it may stand still already."""
        self._arms.yield_to_faults()
        self._final |= self._arms.taken
        self._hold(problem)

    def _hold(self, problem: str) -> None:
        """Begin to hold, unless the arm holds already."""
        if self.problem:
            return
        self.problem, self._since = problem, self._clock.now()
        self._untold.append(f"holding: {problem}")
        self._write(self._since, problem=problem)

    def _tell(self) -> None:
        """Say what is to be said, now that the arm stands still."""
        while self._untold:
            self._say(self._untold.pop(0))

    def _rest(self) -> None:
        """Move slowly to the rest pose, unless an arm itself reports a fault.

        Two arms stay where they are: they may hold the same thing, and nothing keeps one from the
        other.
        """
        self._read()
        if self._arms.fault() or self.stopped or len(self._arms.readings) > 1:
            return
        self._say("moving slowly to the rest pose")
        if problem := self._go(self._arms.rest):
            self._untold.append(f"holding: {problem}")

    def _go(self, pose: np.ndarray) -> str | None:
        """Move slowly to a pose; return what prevents it in a sentence, if anything does."""
        self._arms.start(self._arms.pose)
        self._next = self._clock.now()
        end = self._next + _GO_TIME
        while self._arms.distance(pose) > _REACHED and not self.stopped:
            self._read()
            if problem := self._arms.fault():
                return problem
            if self._clock.now() > end:
                return "the pose is out of reach"
            self._send(self._arms.step(pose, slow=True))
            self._wait()
        return None

    def _settle(self) -> None:
        """Brake, whatever fails meanwhile, then leave the arm holding its last target."""
        while True:
            self._attempt(self._read)
            self._attempt(self._send, self._arms.brake())
            if not self._arms.moving:
                return
            self._attempt(self._wait)

    def _read(self) -> np.ndarray:
        return self._arms.read(_ready) if self._settings.dry_run else self._arms.read()

    def _send(self, command: np.ndarray) -> None:
        now, arms = self._clock.now(), self._arms
        if not self._settings.dry_run:
            arms.send(command)
        elif now - self._printed >= self._settings.control_dt - 1e-6:
            self._say(f"would command {arms.describe(command)}")
            self._printed = now
        age = max(reading.age for reading in arms.readings)
        self._write(now, pose=arms.measured, command=command, age=age)

    def _record(self, now: float) -> None:
        """Record the first tick of every action."""
        if self._recorder is None or self._path is None:
            return
        step = int(self._position(now) + _INSTANT)
        if self._recorded < step < self._path.steps:
            action = self._path.action(step)
            self._recorder.step(self._look(), self._arms.measured, action)
            self._recorded = step

    def _forget(self) -> None:
        """Drop the path and the open question."""
        self._path: Path | None = None
        self._start, self._asked, self._approached = 0.0, None, None
        self._executed, self._recorded = 0, -1
        self._printed = -np.inf

    def _write(self, now: float, **values: Any) -> None:
        if self._log:
            self._log.line(now, **values)

    def _wait(self) -> None:
        """Wait for the next tick; after a long delay, do not make up for those that were missed."""
        self._next += PERIOD
        now = self._clock.now()
        if now > self._next + _LATE:
            self._next = now
        self._clock.wait_until(self._next)


def _ready(reading: Reading) -> Reading:
    """In a dry run, arms need not be ready."""
    return reading._replace(ctrl_mode=CAN_CONTROL, enabled=True)
