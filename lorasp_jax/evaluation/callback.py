"""Measure success in simulation before, during and after training; render a video per task."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
from PIL import Image
from rich.progress import Progress

from envs.env import Env
from envs.physics import physics
from envs.rendering.video import side_by_side
from lorasp_jax.base import messages
from lorasp_jax.base.bars import bars
from lorasp_jax.base.writing import atomic_file
from lorasp_jax.evaluation import metrics, video
from lorasp_jax.evaluation.programs import compiled_rollout
from lorasp_jax.evaluation.results import Result, evaluate, map_rollouts
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training import early, records
from lorasp_jax.training.demonstrations import map_threads
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.rules import TOWERS, by_rule
from lorasp_jax.training.run import Callback, Run
from lorasp_jax.training.run_folder import read_json, read_metrics, write_json
from lorasp_jax.training.setup import RunSetup


class Evaluation(Callback):
    """Evaluates every task of a run before, during and after training, as the config says.

    The first evaluation measures the base, since new adapters leave its outputs unchanged. The
    final evaluation uses other layouts than the earlier ones; both depend only on the seed and the
    task. Compiled programs are shared, see `programs`. Videos are rendered in the
    background during training, in the foreground after it.
    """

    def __init__(self, *, media: bool = True, learned: bool = False) -> None:
        """Create the callback; `media`: whether to write videos and images; `learned`: whether the
        first policy is that of a finished run, not a base."""
        self._media, self._learned = media, learned
        self._rollouts: dict[str, tuple[Env, Callable]] = {}
        self._video_thread = ThreadPoolExecutor(1)
        self._pending_videos: Future | None = None

    def compile_early(self, run: Run, built: RunSetup) -> None:
        """Compile the rollouts of a run, whose demonstrations other threads may be collecting.

        A policy call per task finds what is left to compile. Warp is not thread-safe and compiles
        later.
        """
        if built.source or physics.default_backend() == "warp":
            return
        policy = early.blank_policy(run, built).with_sampler()

        def compile_task(task: str) -> None:
            with messages.announce(f"the evaluation of {task}"):
                env, rollout = compiled_rollout(run, task)
                rollout.compile(policy)
                jax.block_until_ready(rollout(policy, jax.random.key(0), calls=1))
            self._rollouts[task] = env, rollout

        map_threads(compile_task, run.config.tasks)

    def on_start(self, run: Run) -> None:
        """Evaluate the base and write before.json, unless `evaluation.before` is false."""
        if not run.config.evaluation.before:
            return
        results = self._evaluate_tasks(run, "before")
        write_json(run.folder / "before.json", {t: success(r) for t, r in results.items()})

    def on_log(self, run: Run, step: int, metrics: dict[str, float]) -> dict[str, float]:  # noqa: ARG002
        """If an evaluation is due, run one batch of episodes per task and start rendering videos.

        Returns:
            The success rate of each task, named `success/<task>`; empty if no evaluation is due.
        """
        if not (run.stops or run.config.evaluates(step)):
            return {}
        results = self._evaluate_tasks(run, f"at step {step}", run.config.evaluation.worlds)
        if self._pending_videos:
            self._pending_videos.result()
        self._pending_videos = self._video_thread.submit(self._write_media, run, results)
        return {f"success/{task}": result.success for task, result in results.items()}

    def on_end(self, run: Run) -> None:
        """Evaluate the trained policy; write results.json and the videos."""
        results = self._evaluate_tasks(run, "after")
        if self._pending_videos:
            self._pending_videos.result()
        self._video_thread.shutdown()
        with run.console.status("rendering videos ..."):
            self._write_media(run, results)
        write_json(run.folder / "results.json", summarize(run, results))

    def _write_media(self, run: Run, results: dict[str, Result]) -> None:
        """Write each task's video and initial images, those of its first demonstration if any."""
        if not self._media:
            return
        for task, result in results.items():
            env = self._rollouts[task][0]
            if episodes := run.episodes.get(task):
                images = {name: np.asarray(i[0, 0]) for name, i in episodes.image.items()}
            else:  # a run without demonstrations
                first = jax.tree.map(lambda x: x[:1], result.poses)
                frames = video.render_episode(env, first, result.draw, run.config.image_size)
                images = {name: frame[0] for name, frame in frames.items()}
            Image.fromarray(side_by_side(images)).save(run.folder / f"cameras_{task}.png")
            with atomic_file(run.folder / f"rollout_{task}.mp4") as unfinished:
                video.write_episode(env, result.poses, unfinished, result.draw)

    def _evaluate_tasks(self, run: Run, when: str, episodes: int = 0) -> dict[str, Result]:
        """Evaluate all tasks, concurrently unless the physics runs in Warp.

        A nonzero `episodes` overrides the number in the config.
        """
        progress_bars = bars(run.console, "episodes", shown=not episodes)
        with run.timed("evaluate"), progress_bars as progress:
            policy = run.policy.with_sampler()  # once for all tasks
            if when == "before" and not self._learned:  # the base knows no good or bad actions
                inputs = policy.processor
                inputs = dataclasses.replace(inputs, prompts=inputs.prompts.plain())
                policy = dataclasses.replace(policy, processor=inputs)
            evaluate_task = functools.partial(
                self._evaluate_task, run, policy, when, episodes, progress
            )
            tasks = run.config.tasks
            results = dict(zip(tasks, map_rollouts(evaluate_task, tasks), strict=True))
        for task, result in results.items():
            low, high = (100 * bound for bound in result.ci95)
            run.console.print(
                f"{task} {when}: {100 * result.success:.1f} % success "
                f"(95 % CI {low:.0f}-{high:.0f} %) in {result.episodes} episodes"
            )
        if bias := metrics.position_bias(result.outcomes for result in results.values()):
            run.console.print(f"warning: {bias}", style="yellow", highlight=False)
        return results

    def _evaluate_task(
        self, run: Run, policy: Policy, when: str, episodes: int, progress: Progress, task: str
    ) -> Result:
        episodes = episodes or run.config.evaluation.episodes
        bar = progress.add_task(f"compiling the evaluation of {task} ...", total=episodes)
        final = when == "after"
        stream = RandomStream.FINAL_EVALUATION if final else RandomStream.EVALUATION
        key = stream.key(run.config.seed, task)
        with contextlib.ExitStack() as compiles:
            if task not in self._rollouts:
                what = f"the evaluation of {task} (including its first episodes)"
                compiles.enter_context(messages.announce(what))

            def report(done: int, _: int) -> None:
                compiles.close()
                progress.update(bar, completed=done, description=f"evaluating {task} {when}")

            if task not in self._rollouts:
                self._rollouts[task] = compiled_rollout(run, task)
            env, rollout = self._rollouts[task]
            if run.recordings and policy.processor.datasets:  # each with statistics of its own
                processor = policy.processor.of_dataset(run.recordings.part_of(task).name)
                policy = dataclasses.replace(policy, processor=processor)
            return evaluate(policy, env, key, episodes, rollout=rollout, progress=report)


class NoEvaluation(Callback):
    """Replaces `Evaluation` for tasks that cannot be simulated; records no success rates."""

    def on_end(self, run: Run) -> None:
        """Print a note and write results.json."""
        tasks, robot = ", ".join(run.config.tasks), run.config.robot
        run.console.print(f"skipping evaluation: cannot simulate {tasks} with {robot}")
        write_json(run.folder / "results.json", summarize(run, {}))


def success(result: Result) -> dict[str, Any]:
    """Return the success of a task, as recorded in before.json and results.json.

    `outcomes` has one character per episode, "1" for success and "0" for failure.
    """
    return {
        "success": result.success,
        "episodes": result.episodes,
        "ci95": list(result.ci95),
        "outcomes": "".join("01"[succeeded] for succeeded in result.outcomes),
    }


def summarize(run: Run, after: dict[str, Result]) -> dict[str, Any]:
    """Return the content of results.json."""
    before = read_json(run.folder / "before.json", records.BEFORE)
    layers = (
        _mean([result.active_rank for result in after.values()]) if after else training_ranks(run)
    )
    modules = {
        tower: float(np.mean(np.concatenate(list(layers[tower].values()))))
        for tower in TOWERS
        if layers.get(tower)
    }
    if modules:
        values = [v for linears in layers.values() for v in linears.values()]
        modules["mean"] = float(np.mean(np.concatenate(values)))
    trainable, total = run.parameters
    rows = read_metrics(run.folder)[-1:] if run.config.adapt else []
    rules = {"rules": by_rule(run.config, run.policy.model, *rows)} if run.config.adapt else {}
    return {
        **rules,
        "scale": run.config.scale,
        "seconds": run.seconds,
        "tasks": {
            task: ({"before": before[task]} if before else {}) | {"after": success(result)}
            for task, result in after.items()
        },
        "active_rank": modules,
        "layer_active_rank": layers,
        "active_rank_histogram": _map_trees(
            lambda *counts: sum(counts).tolist(),
            [result.active_rank_histogram for result in after.values()],
        ),
        "trainable_parameters": trainable,
        "total_parameters": total,
    }


def training_ranks(run: Run) -> dict[str, dict[str, list[float]]]:
    """Return the active ranks of the end of training, as `Result` has those of an evaluation."""
    layers: dict[str, dict[str, list[float]]] = {}
    for name, ranks in run.layer_ranks.items():
        _, tower, layer = name.split("/", 2)
        layers.setdefault(tower, {})[layer] = ranks.tolist()
    return layers


def _mean(trees: list[Any]) -> Any:
    """Average trees of the same structure, whose leaves are lists of numbers."""
    is_list = lambda node: isinstance(node, list)  # noqa: E731
    return _map_trees(lambda *v: np.mean(v, axis=0).tolist(), trees, is_leaf=is_list)


def _map_trees(function: Callable, trees: list[Any], **options: Any) -> Any:
    """Apply `jax.tree.map`, but return {} if there are no trees."""
    return jax.tree.map(function, *trees, **options) if trees else {}
