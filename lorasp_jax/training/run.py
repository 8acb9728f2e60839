"""The state of a run, shared by all parts of training, and the callback interface."""

import contextlib
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import nnx
from rich.console import Console

from envs.datasets.episodes import Episodes
from lorasp_jax.adapters import adaptation
from lorasp_jax.config import AugmentConfig, Config
from lorasp_jax.data.batches import Mixture, Steps, flatten
from lorasp_jax.data.cache import Cache
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training import records
from lorasp_jax.training.distributed import processes
from lorasp_jax.training.offline import Chosen
from lorasp_jax.training.run_folder import TIMES_FILE, read_json, write_json
from lorasp_jax.training.step import Objective


@dataclass
class Run:
    """A run, as passed to callbacks.

    Attributes:
        episodes: demonstrations per task; those of a dataset repeat one image per camera. Tasks to
            replay follow those of the config.
        dataset: all steps of a dataset, stored on disk; None: train on `episodes`.
        recordings: the dataset; None: train on `episodes`.
        held_out: numbers of its episodes that are not trained on.
        chosen: which of its episodes and steps count.
        streams: whether batches are read from disk because the dataset does not fit on the device.
        devices: devices to train on; None: all.
        simulated: whether the tasks can be evaluated in simulation.
        stops: whether training ends with this step, before the last of the config.
        objective: what to learn in place of the demonstrated actions.
        trained: pattern of the paths of the adapters that the run trains; "": all.
        layer_ranks: the active ranks `[L]` of the last log interval, by name as logged.
        fixed: which parameters of the adapters training leaves as they are; None: it changes all.
        programs: jitted training programs by their inputs; see `program.jit_steps`.
        policy: the current policy; read it in callbacks or after training, since each step donates
            its buffers.
        started: `time.perf_counter()` when this process started.
        seconds: time per phase, and "total" [s], including the earlier processes of a resumed run.
    """

    config: Config
    folder: Path
    console: Console
    base_hash: str
    started: float = field(default_factory=time.perf_counter)
    episodes: dict[str, Episodes] = field(default_factory=dict)
    dataset: Steps | None = None
    recordings: Cache | None = None
    held_out: Sequence[int] = ()
    chosen: Chosen | None = None
    streams: bool = False
    devices: Sequence[Any] | None = None
    simulated: bool = True
    stops: bool = False
    objective: Objective | None = None
    trained: str = ""
    layer_ranks: dict[str, np.ndarray] = field(default_factory=dict)
    fixed: Any = None
    programs: dict[Any, Callable[..., Any]] = field(default_factory=dict)
    policy: Policy = field(init=False)
    seconds: dict[str, float] = field(init=False)

    def __post_init__(self) -> None:
        """Continue from the times of earlier processes."""
        self.seconds = {"total": 0.0, **read_json(self.folder / TIMES_FILE, records.TIMES)}
        self._before = self.seconds["total"]

    def with_policy(self, policy: Policy, **changes: Any) -> "Run":
        """Return a copy that has a policy, and other fields where `changes` says so."""
        run = replace(self, **changes)
        run.policy = policy
        return run

    @property
    def steps(self) -> Steps:
        """All steps to train on."""
        if self.dataset:
            return self.dataset
        groups, count = list(self.episodes.values()), len(self.config.tasks)
        steps, share = flatten(groups), self.config.data.replay
        if not share:
            return steps
        learned = sum(group.num_steps for group in groups[:count])  # the others are replayed
        bounds = np.array([0, learned, steps.num_starts], np.int32)
        return replace(steps, mixture=Mixture(bounds, np.array([1 - share, share], np.float32)))

    @property
    def augmentation(self) -> AugmentConfig | None:
        """How training images are changed; None: not at all."""
        return self.config.data.augment.chosen(simulated=self.simulated)

    @property
    def parameters(self) -> tuple[int, int]:
        """Numbers of trainable parameters and of all parameters; see `adaptation.count`."""
        model = self.policy.model
        trained = sum(x.size for x in jax.tree.leaves(self.split()[1]))
        unused = {p: n for p, n in adaptation.padding(model).items() if re.search(self.trained, p)}
        return trained - sum(unused.values()), adaptation.count(model).total

    def split(self) -> tuple[Any, Any, Any]:
        """Split the policy's model into (graphdef, adapters that the run trains, all others)."""
        graphdef, adapters, frozen = adaptation.split(self.policy.model)
        if not self.trained:
            return graphdef, adapters, frozen
        chosen = lambda path, _: bool(re.search(self.trained, "/".join(map(str, path))))  # noqa: E731
        adapters, others = nnx.split_state(adapters, chosen, ...)
        return graphdef, adapters, nnx.merge_state(frozen, others)

    @contextlib.contextmanager
    def timed(self, phase: str) -> Iterator[None]:
        """Add the time spent in this block to `seconds[phase]`, even if it is interrupted.

        The time of a nested phase counts only for the nested phase.
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
                write_json(self.folder / TIMES_FILE, self.seconds)


class Callback:
    """Hooks called during a run; override any of them."""

    def on_start(self, run: Run) -> None:
        """Called with the untrained policy before training, unless a checkpoint was restored."""

    def on_log(self, run: Run, step: int, metrics: dict[str, float]) -> dict[str, float] | None:
        """Called at every log step, with the current policy.

        Returns:
            Additional scalars to log at this step.
        """

    def on_end(self, run: Run) -> None:
        """Called after the last step, with the trained policy."""

    def on_stop(self, run: Run, reason: str) -> None:
        """Called instead of `on_end` when training cannot continue; the policy is not available."""
