"""The control loop: read the arm, ask the policy, command the arm, 200 times a second.

Whatever goes wrong, the arm brakes and holds. Only then one sentence says why, since a terminal may
block. If feedback or pictures come back soon, it goes on from where it holds. Otherwise, and after
a refused chunk or a policy's error, it moves slowly to its rest pose and stays there, powered; it
does not move again while it reports a fault itself. Signals and all other errors stop it where it
is.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from lorasp_jax.base.errors import one_line
from lorasp_jax.extras.piper.arm import NoArm, PiperArm
from lorasp_jax.extras.piper.asking import InThread
from lorasp_jax.extras.piper.cameras import Look, NoPicture
from lorasp_jax.extras.piper.clock import Clock
from lorasp_jax.extras.piper.interpolation import Path
from lorasp_jax.extras.piper.log import Log
from lorasp_jax.extras.piper.recording import Recording
from lorasp_jax.extras.piper.safety import (
    CAN_CONTROL,
    MAX_AGE,
    Governor,
    Limits,
    Reading,
    Unsafe,
    check_chunk,
    clamped,
    fault,
)
from lorasp_jax.extras.piper.settings import Settings
from lorasp_jax.extras.serving.client import PolicyError

PERIOD = 0.005
"""Time between two commands [s], as in piper_sdk's examples (200 Hz)."""
REST = np.array([0.0, 0.06, -0.06, 0.0, 0.35, 0.0, 0.0])
"""Pose in which the arm lies folded [rad, m]: all joints near zero; our choice."""
_REACHED = 0.01  # rad from the rest pose that counts as arrived
_APPROACH_TIME = 20.0  # s that the way to the first action may take
_GO_TIME = 60.0  # s that the way to the rest or start pose may take
_INSTANT = 1e-6  # control steps that rounding may take from a clock's time
_LATE = 0.05  # s of delay after which ticks are skipped instead of made up for


class Session:
    """One run of a policy on an arm.

    Attributes:
        problem: why the arm holds, in a sentence; None while it does not.
        chunks: number of chunks received.
        stopped: whether `stop` was called.
    """

    def __init__(
        self,
        arm: PiperArm | NoArm,
        look: Look,
        asker: InThread,
        limits: Limits,
        settings: Settings,
        clock: Clock,
        *,
        log: Log | None = None,
        recorder: Recording | None = None,
        say: Callable[[str], None] = print,
    ) -> None:
        """Prepare a session; the arm is enabled, unless it is a dry run."""
        self._arm, self._look, self._asker, self._clock = arm, look, asker, clock
        self._limits, self._settings, self._log, self._say = limits, settings, log, say
        self._recorder = recorder
        self._governor = Governor(limits, PERIOD)
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
        """Move slowly to a pose [7] after a run; result and errors are those of `run`."""

        def work() -> None:
            self._say("moving slowly to the start pose")
            if problem := self._go(pose):
                self._hold(problem)

        return self._guarded(work)

    def _guarded(self, work: Callable[[], None]) -> str | None:
        """Work on an arm at rest; however that ends, brake, then say why, and only then raise."""
        self._governor.start(self._read().pose)
        self._failures: list[BaseException] = []
        self._attempt(work)
        self._settle()
        if self._failures:
            first = self._failures[0]
            self._attempt(self._hold, one_line(first) or type(first).__name__)
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
            held = self.problem and not self._governor.velocity.any()
            if held and self._clock.now() - self._since > self._settings.hold:
                self._rest()
                break

    def _tick(self) -> None:
        reading, now = self._read(), self._clock.now()
        try:
            if problem := fault(reading, self._limits):
                self._fail(problem, reading)
            elif not self._final:
                self._drive(reading, now)
        except (Unsafe, PolicyError) as error:
            self._hold(one_line(error))
            self._final |= not isinstance(error, NoPicture)
        if self.problem:
            self._send(self._governor.brake(), reading)
        if not self._governor.velocity.any():
            self._tell()
        self._wait()

    def _drive(self, reading: Reading, now: float) -> None:
        """Follow the policy's path by one tick."""
        if self.problem:
            if self._governor.velocity.any():
                return  # it brakes to the end, whatever comes back
            self._look()  # still no picture: it goes on holding
            self._say("going on")
            self._governor.start(self._governor.pose)
            self.problem = None
            self._forget()
        self._receive(now)
        if self._asked is None and self._wants_chunk(now):
            self._ask(reading, now)
            self._receive(now)
        if self._asked is not None and now - self._asked > self._settings.patience:
            raise PolicyError(f"the server did not answer within {self._settings.patience:g} s")
        if self._path is None:
            self._send(self._governor.brake(), reading)
            return
        if self._governor.approaching:
            self._send(self._approach(self._path, now), reading)
        else:
            self._record(reading, now)
            command = self._governor.step(self._path.target(now + PERIOD - self._start))
            self._send(command, reading)

    def _approach(self, path: Path, now: float) -> np.ndarray:
        """Return the command of a tick on the way to the first action; the path waits for it."""
        command = self._governor.step(path.action(0))
        if self._approached is None:
            self._approached = now
        if now - self._approached > _APPROACH_TIME:
            raise Unsafe("the first action is out of reach: the finger tips would leave the box")
        self._path, self._start = path.starting_at(command), now + PERIOD
        return command

    def _ask(self, reading: Reading, now: float) -> None:
        images = self._look()
        state = reading.pose.astype(np.float32)
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
        settings, chunk = self._settings, check_chunk(actions)
        self._check_length(chunk)
        if not self._warned and (warning := clamped(chunk, self._limits)):
            self._warned = True
            self._untold.append(warning)
        own = chunk[: settings.execute + settings.ahead]
        if self._path is None:
            self._path = Path(self._governor.pose.copy(), own, settings.control_dt)
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

    def _fail(self, problem: str, reading: Reading) -> None:
        """Hold because of what the arm reports: where it is, if it may stand still already."""
        stands = reading.age <= MAX_AGE and (reading.arm_status or not reading.enabled)
        if stands and not self.problem:
            self._governor.start(reading.pose)
        self._final |= bool(reading.arm_status) or reading.ctrl_mode != CAN_CONTROL
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
        """Move slowly to the rest pose, unless the arm itself reports a fault."""
        if fault(self._read(), self._limits) or self.stopped:
            return
        self._say("moving slowly to the rest pose")
        if problem := self._go(REST):
            self._untold.append(f"holding: {problem}")

    def _go(self, pose: np.ndarray) -> str | None:
        """Move slowly to a pose [7]; return what prevents it in a sentence, if anything does."""
        self._governor.start(self._governor.pose)
        self._next = self._clock.now()
        end = self._next + _GO_TIME
        while np.abs(self._governor.pose - pose)[:6].max() > _REACHED and not self.stopped:
            reading = self._read()
            if problem := fault(reading, self._limits):
                return problem
            if self._clock.now() > end:
                return "the pose is out of reach"
            self._send(self._governor.step(pose, slow=True), reading)
            self._wait()
        return None

    def _settle(self) -> None:
        """Brake, whatever fails meanwhile, then leave the arm holding its last target."""
        while True:
            self._attempt(self._read)
            self._attempt(self._send, self._governor.brake(), self._reading)
            if not self._governor.velocity.any():
                return
            self._attempt(self._wait)

    def _read(self) -> Reading:
        self._reading = self._arm.read()
        if self._settings.dry_run:  # the arm need not be ready
            self._reading = self._reading._replace(ctrl_mode=CAN_CONTROL, enabled=True)
        return self._reading

    def _send(self, command: np.ndarray, reading: Reading) -> None:
        now = self._clock.now()
        if self._settings.dry_run:
            if now - self._printed >= self._settings.control_dt - 1e-6:
                degrees = " ".join(f"{angle:7.2f}" for angle in np.rad2deg(command[:6]))
                self._say(f"would command {degrees} degrees, {1000 * command[6]:.1f} mm")
                self._printed = now
        elif reading.ctrl_mode == CAN_CONTROL:  # else a person or another program has the arm
            self._arm.command(command)
        self._write(now, pose=reading.pose, command=command, age=reading.age)

    def _record(self, reading: Reading, now: float) -> None:
        """Record the first tick of every action."""
        if self._recorder is None or self._path is None:
            return
        step = int(self._position(now) + _INSTANT)
        if self._recorded < step < self._path.steps:
            action = self._path.action(step)
            self._recorder.step(self._look(), reading.pose, action)
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
