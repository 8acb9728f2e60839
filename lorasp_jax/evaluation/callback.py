"""Success in simulation before, while and after training, with a video of each task."""

import contextlib
import functools
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.progress import Progress

from envs.cli.bars import bars
from envs.compilation import messages
from envs.datasets.writing import atomic_file
from envs.env import Env
from envs.physics import physics
from envs.state import Poses
from lorasp_jax.adapters import adaptation
from lorasp_jax.config import Config
from lorasp_jax.evaluation import video
from lorasp_jax.evaluation.rollout import Result, compiled_rollout, evaluate
from lorasp_jax.training import records
from lorasp_jax.training.demonstrations import side_by_side
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run import Callback, Run
from lorasp_jax.training.run_folder import read_json, write_json

TOWERS = ("vision", "language", "action")


class Evaluation(Callback):
    """Measures every task of a run before the first and after the last step, and in between.

    Adapters start at exactly zero, so the policy before the first step is the unadapted base; all
    measurements share one compilation, the layouts of the last one differ from the others'.
    Training goes on while videos are made.
    """

    def __init__(
        self,
        compiled: Callable[[Config, str], tuple[Env, Callable]] = compiled_rollout,
        evaluate: Callable[..., Result] = evaluate,
        film: Callable[[Env, Poses, Path], None] = video.write_film,
    ) -> None:
        """Compile nothing yet.

        Args:
            compiled: gives a task's environment and jitted rollout.
            evaluate: measures a policy.
            film: writes a video of an episode's poses to a file.
        """
        self._compile, self._evaluate, self._film = compiled, evaluate, film
        self._tasks: dict[str, tuple[Env, Callable]] = {}
        self._films = ThreadPoolExecutor(1)
        self._filming: Future | None = None

    def on_start(self, run: Run) -> None:
        """Measure the base and record it, for a resumed run too."""
        results = self._measure(run, "before")
        write_json(run.folder / "before.json", {t: success(r) for t, r in results.items()})

    def on_log(self, run: Run, step: int, metrics: dict[str, float]) -> dict[str, float]:  # noqa: ARG002
        """Measure the policy in one batch of episodes a task, if it is time to; film it.

        Returns:
            `success/<task>`.
        """
        if not run.config.evaluates(step):
            return {}
        results = self._measure(run, f"at step {step}", run.config.evaluation.worlds)
        if self._filming:
            self._filming.result()
        self._filming = self._films.submit(self._record, run, results)
        return {f"success/{task}": result.success for task, result in results.items()}

    def on_end(self, run: Run) -> None:
        """Measure the trained policy and write results.json and the videos."""
        results = self._measure(run, "after")
        if self._filming:
            self._filming.result()
        self._films.shutdown()
        with run.console.status("rendering videos ..."):
            self._record(run, results)
        write_json(run.folder / "results.json", summarise(run, results))

    def _record(self, run: Run, results: dict[str, Result]) -> None:
        """Write a video and the first pictures of each task."""
        for task, result in results.items():
            first = {name: np.asarray(i[0, 0]) for name, i in run.episodes[task].image.items()}
            video.write_picture(run.folder / f"cameras_{task}.png", video.side_by_side(first))
            with atomic_file(run.folder / f"rollout_{task}.mp4") as unfinished:
                self._film(self._tasks[task][0], result.poses, unfinished)

    def _measure(self, run: Run, when: str, episodes: int = 0) -> dict[str, Result]:
        """Results by task, of the config's number of episodes or another; compilations run side by
        side.
        """
        shown = bars(run.console, "episodes", shown=not episodes)
        with run.timed("evaluate"), shown as progress:
            one = functools.partial(self._measure_task, run, when, episodes, progress)
            tasks = run.config.tasks
            # Warp is not for threads.
            each = map if physics.default_backend() == "warp" else side_by_side
            results = dict(zip(tasks, each(one, tasks), strict=True))
        for task, result in results.items():
            low, high = (100 * bound for bound in result.ci95)
            run.console.print(
                f"{task} {when}: {100 * result.success:.1f} % success "
                f"(95 % interval {low:.0f}-{high:.0f} %) in {result.episodes} episodes"
            )
        return results

    def _measure_task(
        self, run: Run, when: str, episodes: int, progress: Progress, task: str
    ) -> Result:
        """The result of one task, with a progress bar."""
        episodes = episodes or run.config.evaluation.episodes
        bar = progress.add_task(f"compiling evaluation of {task} ...", total=episodes)
        number = 2 * run.config.tasks.index(task) + (when == "after")
        key = RandomStream.EVALUATION.key(run.config.seed, number)
        with contextlib.ExitStack() as compiles:
            if task not in self._tasks:
                what = f"the evaluation of {task}, its first episodes included"
                compiles.enter_context(messages.announced(what))

            def report(done: int, _: int) -> None:
                compiles.close()
                progress.update(bar, completed=done, description=f"evaluating {task} {when}")

            if task not in self._tasks:
                self._tasks[task] = self._compile(run.config, task)
            env, rollout = self._tasks[task]
            return self._evaluate(run.policy, env, key, episodes, rollout=rollout, progress=report)


class NoEvaluation(Callback):
    """For a dataset whose tasks cannot be simulated: results without success rates."""

    def on_end(self, run: Run) -> None:
        """Say so and write results.json."""
        tasks, robot = ", ".join(run.config.tasks), run.config.robot
        run.console.print(f"not evaluated: there is no simulation of {tasks} with {robot}")
        write_json(run.folder / "results.json", summarise(run, {}))


def success(result: Result) -> dict[str, Any]:
    """The part of a result that results.json keeps per task."""
    return {"success": result.success, "episodes": result.episodes, "ci95": list(result.ci95)}


def summarise(run: Run, after: dict[str, Result]) -> dict[str, Any]:
    """The content of results.json."""
    before = read_json(run.folder / "before.json", records.BEFORE) if after else {}
    layers = _mean([result.active_rank for result in after.values()])
    modules = {
        tower: float(np.mean(np.concatenate(list(layers[tower].values()))))
        for tower in TOWERS
        if layers.get(tower)
    }
    if modules:
        values = [v for linears in layers.values() for v in linears.values()]
        modules["mean"] = float(np.mean(np.concatenate(values)))
    trainable, total = adaptation.count(run.policy.model)
    return {
        "scale": run.config.scale,
        "seconds": run.seconds,
        "tasks": {
            task: {"before": before[task], "after": success(result)}
            for task, result in after.items()
        },
        "active_rank": modules,
        "layer_active_rank": layers,
        "active_rank_histogram": _joined(
            lambda *counts: sum(counts).tolist(),
            [result.active_rank_histogram for result in after.values()],
        ),
        "trainable_parameters": trainable,
        "total_parameters": total,
    }


def _mean(trees: list[Any]) -> Any:
    """Mean of equal trees whose leaves are lists of numbers."""
    is_list = lambda node: isinstance(node, list)  # noqa: E731
    return _joined(lambda *v: np.mean(v, axis=0).tolist(), trees, is_leaf=is_list)


def _joined(function: Callable, trees: list[Any], **options: Any) -> Any:
    """`jax.tree.map` over any number of trees; of none, an empty one."""
    return jax.tree.map(function, *trees, **options) if trees else {}
