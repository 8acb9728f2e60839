"""Judge several tasks at once, each in a process that asks the same policy server."""

import contextlib
import functools
import multiprocessing
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from lorasp_jax.base.processes import end_with_parent
from lorasp_jax.extras.judge.actors import ServerActor
from lorasp_jax.extras.judge.judge import EpisodeResult, Progress, judge_task, summarize
from lorasp_jax.extras.judge.task import load_tasks


def judge_in_processes(
    env: str,
    names: Sequence[str],
    connect: Callable[[], ServerActor],
    episodes: int,
    processes: int,
    *,
    seed: int = 0,
    films: Path | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Measure success on every task, several tasks at once.

    Args:
        env: factory of the tasks, as for `load_tasks`; each process calls it.
        names: tasks to judge; empty: all.
        connect: connects to the server, once for each task; it is sent to the processes. The
            server's noise depends on which task connects first.
        episodes, seed, films: see `judge.judge`.
        processes: number of processes.
        progress: called after each task.

    Raises:
        ValueError: a process was killed; see also `load_tasks`, `ServerActor` and `judge`.
    """
    started, tasks = time.perf_counter(), load_tasks(env, names)
    run = functools.partial(_run, env, connect, episodes, seed, films)
    runs = dict[str, list[EpisodeResult]]()
    context = multiprocessing.get_context("spawn")  # a copy of a process with threads may hang
    try:
        with ProcessPoolExecutor(processes, context, initializer=end_with_parent) as pool:
            for name, done in pool.map(run, [task.name for task in tasks]):
                runs[name] = done
                if progress:
                    progress(name, len(done), sum(bool(each.success) for each in done))
    except BrokenProcessPool as error:
        raise ValueError("a process that judged a task was killed: lower --processes?") from error
    return summarize(tasks, runs, time.perf_counter() - started)


def _run(
    env: str,
    connect: Callable[[], ServerActor],
    episodes: int,
    seed: int,
    films: Path | None,
    name: str,
) -> tuple[str, list[EpisodeResult]]:
    """Judge one task; return its name and episodes, without the frames of its film."""
    (task,) = load_tasks(env, [name])
    with contextlib.closing(connect()) as actor:
        done = judge_task(task, actor, episodes, seed=seed, films=films)
    for episode in done:
        episode.frames.clear()
    return name, done
