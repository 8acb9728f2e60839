"""Measure a finished run at several delays, and record the results in its latency.json."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.progress import Progress

import envs
from envs.env import Env
from lorasp_jax.evaluation.intervals import wilson_interval
from lorasp_jax.evaluation.metrics import position_bias
from lorasp_jax.evaluation.programs import prepared
from lorasp_jax.extras.latency.execution import (
    EXECUTIONS,
    Settings,
    Trace,
    check_delay,
    delayed_rollout,
)
from lorasp_jax.extras.latency.smoothness import action_delta, jerk
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training import records
from lorasp_jax.training.export import describe, load_policy
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run_folder import CONFIG_FILE, read_json, recorded_ranges, write_json

FILE = "latency.json"
MAX_DELAY = 8
"""Largest delay measured by default [control steps], if chunks are long enough."""
POINT: records.Schema = {
    "delay": int,
    "success": float,
    "episodes": int,
    "ci95": (float, float),
    "outcomes": str,
    "steps": float,
    "action_delta": float,
    "jerk": float,
}
SCHEMA: records.Schema = {
    "control_dt": float,
    "chunk": int,
    "execute_steps": int,
    "denoise_steps": int,
    "guidance": float,
    "episodes": int,
    "num_envs": int,
    "curves": {str: {str: [POINT]}},
}
"""Schema of latency.json; its curves are by task and execution."""
_CONFIG: records.Schema = records.CONFIG | {
    "image_size": int,
    "control_dt": float,
    "seed": int,
    "evaluation": {"episodes": int, "num_envs": int, "denoise_steps": int},
}


@dataclass(frozen=True)
class Options:
    """What to measure.

    Attributes:
        executions: some of `EXECUTIONS`; none: all that the policy supports.
        delays: delays [control steps]; none: from 0 to the longest, at most `MAX_DELAY`.
        tasks: some of the run's tasks; none: all.
        episodes: episodes per point; 0: as many as in the run's evaluation.
        execute_steps: control steps between observations; 0: half of the chunk.
        guidance: β of guided execution.
    """

    executions: Sequence[str] = ()
    delays: Sequence[int] = ()
    tasks: Sequence[str] = ()
    episodes: int = 0
    execute_steps: int = 0
    guidance: float = 10.0


def measure(run: Path, options: Options, progress: Progress | None = None) -> dict[str, Any]:
    """Measure every combination of task, execution and delay that latency.json lacks.

    The episodes are those of the run's final evaluation. latency.json is written after every point.

    Returns:
        The content of latency.json.

    Raises:
        ValueError: the run is unfinished or cannot be simulated, the options do not fit it, or
            latency.json was measured with other settings.
    """
    tasks = _tasks(run, options.tasks)
    config = read_json(run / CONFIG_FILE, _CONFIG)
    executions = _executions(run, config, options.executions)
    policy = load_policy(run)
    settings = _settings(config, options, policy.model.config.chunk)
    steps, chunk = settings["execute_steps"], settings["chunk"]
    longest = min(MAX_DELAY, steps, chunk - steps)
    delays = options.delays or range(longest + 1)
    for delay in delays:
        check_delay(delay, steps, chunk)
    found = _earlier(run / FILE, settings)
    missing = [
        (task, execution, delay)
        for task, execution, delay in itertools.product(tasks, executions, delays)
        if not any(p["delay"] == delay for p in found["curves"].get(task, {}).get(execution, []))
    ]
    bar = progress.add_task("", total=len(missing)) if progress else None
    policy = prepared(policy)
    rollout = functools.cache(functools.partial(_rollout, run, config, settings))
    for number, (task, execution, delay) in enumerate(missing):
        if progress and bar is not None:
            text = f"{task}, {execution}, delay {delay}"
            progress.update(bar, completed=number, description=text)
        env, play = rollout(task, execution)
        key = RandomStream.FINAL_EVALUATION.key(config["seed"], task)
        point = measure_point(policy, env, play, key, settings["episodes"], delay)
        points = found["curves"].setdefault(task, {}).setdefault(execution, [])
        points.append(point)
        points.sort(key=lambda point: point["delay"])
        write_json(run / FILE, found)
    if progress and bar is not None:
        progress.update(bar, completed=len(missing), description="measured")
    return found


def extrapolated(run: Path, curves: dict[str, Any]) -> list[int]:
    """Return the delays of trained execution beyond those that a run was trained for.

    Args:
        run: folder of the run.
        curves: the content of its latency.json.
    """
    limit = _trained_delay(read_json(run / CONFIG_FILE, _CONFIG))
    points = (p for task in curves["curves"].values() for p in task.get("trained", []))
    return sorted({point["delay"] for point in points if point["delay"] > limit})


def measure_point(
    policy: Policy,
    env: Env,
    rollout: Callable[[Policy, jax.Array, int], Trace],
    key: jax.Array,
    episodes: int,
    delay: int,
) -> dict[str, Any]:
    """Run episodes, a multiple of `env.num_envs`, at one delay; return a `POINT`.

    Raises:
        ValueError: success depends on an episode's position in its batch, see `position_bias`.
    """
    keys = jax.random.split(key, episodes // env.num_envs)
    traces = [rollout(policy, batch_key, delay) for batch_key in keys]
    fields = (field.name for field in dataclasses.fields(Trace))
    trace = Trace(*(np.concatenate([getattr(t, name) for t in traces]) for name in fields))
    if bias := position_bias([trace.success.tolist()]):
        raise ValueError(bias)
    successes = int(trace.success.sum())
    return {
        "delay": delay,
        "success": successes / episodes,
        "episodes": episodes,
        "ci95": list(wilson_interval(successes, episodes)),
        "outcomes": "".join("01"[int(succeeded)] for succeeded in trace.success),
        "steps": float(trace.steps.mean()),
        "action_delta": action_delta(trace),
        "jerk": jerk(trace, env.control_dt),
    }


def _rollout(
    run: Path,
    config: dict[str, Any],
    settings: dict[str, Any],
    task: str,
    execution: str,
) -> tuple[Env, Callable[[Policy, jax.Array, int], Trace]]:
    """Return the environment of a task and the rollout of an execution."""
    env = _environment(
        task,
        describe(run)["robot"],
        settings["num_envs"],
        config["image_size"],
        config["control_dt"],
    )
    names = ("execute_steps", "denoise_steps", "guidance")
    how = Settings(execution, **{name: settings[name] for name in names})
    return env, delayed_rollout(env, how, ranges=recorded_ranges(config))


@functools.cache
def _environment(task: str, robot: str, worlds: int, image_size: int, control_dt: float) -> Env:
    sizes = {"num_envs": worlds, "image_size": image_size, "control_dt": control_dt}
    return envs.make(task, robot=robot, **sizes)


def _settings(config: dict[str, Any], options: Options, chunk: int) -> dict[str, Any]:
    """Return the settings that all points of latency.json share."""
    recorded = config["evaluation"]
    episodes = options.episodes or recorded["episodes"]
    worlds = min(episodes, recorded["num_envs"])
    if episodes < 1 or episodes % worlds:
        raise ValueError(f"episodes must be a positive multiple of {worlds}, got {episodes}")
    steps = options.execute_steps or math.ceil(chunk / 2)
    if not 1 <= steps <= chunk:
        raise ValueError(f"execute_steps must be from 1 to the chunk length ({chunk}), got {steps}")
    if not 0 < options.guidance < math.inf:
        raise ValueError(f"guidance must be above 0, got {options.guidance}")
    return {
        "control_dt": config["control_dt"],
        "chunk": chunk,
        "execute_steps": steps,
        "denoise_steps": recorded["denoise_steps"],
        "guidance": options.guidance,
        "episodes": episodes,
        "num_envs": worlds,
    }


def _earlier(path: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """Return the content of latency.json, or what it starts with."""
    found = read_json(path, SCHEMA) or {"curves": {}}
    if changed := [name for name in settings if found.get(name, settings[name]) != settings[name]]:
        raise ValueError(
            f"{path} was measured with other settings ({', '.join(changed)}): remove it, or use "
            "the same settings"
        )
    return settings | found


def _tasks(run: Path, chosen: Sequence[str]) -> list[str]:
    """Return the tasks to measure."""
    results = read_json(run / "results.json", records.RESULTS)
    if not results:
        raise ValueError(f"no finished run in {run}: results.json is missing")
    tasks = [*results["tasks"]]
    if not tasks:
        raise ValueError(f"the tasks of {run} cannot be simulated")
    if unknown := [task for task in chosen if task not in tasks]:
        raise ValueError(f"the tasks of {run} are {', '.join(tasks)}, got {unknown[0]!r}")
    return [*chosen] or tasks


def _executions(run: Path, config: dict[str, Any], chosen: Sequence[str]) -> list[str]:
    """Return the executions to measure."""
    trained = _trained_delay(config) > 0
    if "trained" in chosen and not trained:
        raise ValueError(f"{run} was not trained for execution trained: --optim.rtc-max-delay is 0")
    return [*chosen] or [name for name in EXECUTIONS if trained or name != "trained"]


def _trained_delay(config: dict[str, Any]) -> int:
    """Return the largest delay that a run was trained for, 0 if for none."""
    return config["optim"].get("rtc_max_delay", 0)
