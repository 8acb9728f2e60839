"""A run as its parts see it, and the hooks into it."""

import contextlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from envs.datasets.episodes import Episodes
from lorasp_jax.config import Config
from lorasp_jax.data.batches import Steps, flatten
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training import records
from lorasp_jax.training.distributed import processes
from lorasp_jax.training.run_folder import CLOCK, read_json, write_json


@dataclass
class Run:
    """A run as its callbacks see it.

    Attributes:
        config: what was asked for.
        folder: where everything is written.
        console: where to print.
        base_hash: hash of the frozen base.
        episodes: demonstrations by task; of a dataset, without all its pictures.
        dataset: the steps of a dataset, in files; None: those of `episodes`.
        streams: whether the steps of a dataset are read from there step by step, because the device
            has no room for them.
        devices: those that train; None: all.
        simulated: whether the tasks can be evaluated in simulation.
        policy: the policy as it is while a callback runs; in between, training owns its memory.
        started: `time.perf_counter()` when this process began.
        seconds: time spent by phase, and "total", over all processes that worked on this run.
    """

    config: Config
    folder: Path
    console: Console
    base_hash: str
    started: float = field(default_factory=time.perf_counter)
    episodes: dict[str, Episodes] = field(default_factory=dict)
    dataset: Steps | None = None
    streams: bool = False
    devices: Sequence[Any] | None = None
    simulated: bool = True
    policy: Policy = field(init=False)
    seconds: dict[str, float] = field(init=False)

    def __post_init__(self) -> None:
        """Takes over the time that earlier processes spent."""
        self.seconds = {"total": 0.0, **read_json(self.folder / CLOCK, records.TIMES)}
        self._before = self.seconds["total"]

    @property
    def steps(self) -> Steps:
        """All steps that are trained on."""
        return self.dataset or flatten(list(self.episodes.values()))

    @contextlib.contextmanager
    def timed(self, phase: str) -> Iterator[None]:
        """Add the time spent in this block to `seconds[phase]`, also if it is interrupted.

        Time of another phase inside this block is that phase's.
        """
        others = lambda: sum(self.seconds.values()) - self.seconds["total"]  # noqa: E731
        start, before = time.perf_counter(), others()
        try:
            yield
        finally:
            now = time.perf_counter()
            spent = now - start - (others() - before)
            self.seconds[phase] = self.seconds.get(phase, 0.0) + spent
            self.seconds["total"] = self._before + now - self.started
            if processes.is_first():
                write_json(self.folder / CLOCK, self.seconds)


class Callback:
    """Hooks into a run; override what is needed."""

    def on_start(self, run: Run) -> None:
        """Before the first step, with the policy as it comes; not called again on resume."""

    def on_log(self, run: Run, step: int, metrics: dict[str, float]) -> dict[str, float] | None:
        """At every log line, with the policy as it is then.

        Returns:
            Further scalars to log at this step.
        """

    def on_end(self, run: Run) -> None:
        """After the last step, with the trained policy."""

    def on_stop(self, run: Run, reason: str) -> None:
        """When training cannot go on, in place of `on_end`; there is no policy then."""
