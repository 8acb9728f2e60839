"""The tables and figures of README.md, from the results of all policies alone."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from lorasp_jax.evaluation.figure_style import STYLE
from lorasp_jax.extras.study import Study, page, statistics
from lorasp_jax.extras.study import figure as figures
from lorasp_jax.extras.study.page import BACKBONES
from lorasp_jax.extras.study.study import Results

COUNTS = (16, 32, 64)
CEILING = 512
"""Demonstrations of imitation alone."""
SEEDS = (0, 1, 2)
TASKS = ("open_pot", "pour", "press", "pick_place")
HARD = ("pour", "pick_place")
RANKS = {
    "r1": "LoRA, r = 1",
    "r4": "LoRA, r = 4",
    "r16": "LoRA, r = 16",
    "r64": "LoRA, r = 64",
    "lora_sp": "LoRA-SP, R = 64",
    "full": "full",
}
"""New adapters that learn from success after those of the start are merged."""
COLORS = {16: "#4269d0", 32: "#ff725c", 64: "#3ca951"}


def cell(backbone: str, count: int, policy: str, seed: int) -> str:
    """Return the name of a policy."""
    return f"{backbone}/n{count}/{policy}/s{seed}"


def blocks(_: Study, results: Results, folder: Path) -> dict[str, str]:
    """Write the figure into `folder`; return the tables, with the seeds that have run."""
    seeds = {(b, n): _seeds(results, b, n, "start", "teacher") for b in BACKBONES for n in COUNTS}
    cases = [case for case in seeds if seeds[case]]
    _figure(results, {case: seeds[case] for case in cases}, folder / "progress.svg")
    return {
        "success": _success_table(results, seeds),
        "tasks": _task_table(results, seeds),
        "ranks": _rank_table(results),
    }


def _seeds(results: Results, backbone: str, count: int, *policies: str) -> list[int]:
    """Return the seeds whose policies have all run."""
    return [s for s in SEEDS if all(cell(backbone, count, p, s) in results for p in policies)]


def _outcomes(
    results: Results,
    where: tuple[str, int],
    policy: str,
    seeds: Sequence[int],
    tasks: Sequence[str] = TASKS,
) -> np.ndarray:
    """Stack the episodes of a policy's seeds, bool `[S, T, N]`."""
    found = [results[cell(*where, policy, seed)]["outcomes"] for seed in seeds]
    return statistics.outcomes([[{"outcomes": {t: x[t] for t in tasks}}] for x in found])


def _success_table(results: Results, seeds: dict[tuple[str, int], list[int]]) -> str:
    """Return success before and after, and what it took."""
    rows = []
    for (backbone, count), own in seeds.items():
        row = [BACKBONES[backbone], str(count), str(len(own))]
        if own:
            at = results, (backbone, count)
            stacked = [
                _outcomes(*at, policy, own, tasks)
                for tasks in (TASKS, HARD)
                for policy in ("start", "teacher")
            ]
            row += [page.percent(statistics.success(x)) for x in stacked]
            row += [f"{_last(*at, own, 'environment_steps') / 1e6:.1f} M"]
            row += [f"{_last(*at, own, 'minutes'):.0f}"]
        rows.append(row + [page.NONE] * (9 - len(row)))
    for backbone in BACKBONES:
        own = _seeds(results, backbone, CEILING, "imitation")
        row = [BACKBONES[backbone], f"{CEILING}, imitation alone", str(len(own))]
        if own:
            at = results, (backbone, CEILING), "imitation", own
            estimates = [statistics.success(_outcomes(*at, tasks)) for tasks in (TASKS, HARD)]
            row += [page.NONE, page.percent(estimates[0]), page.NONE, page.percent(estimates[1])]
            seconds = [results[cell(backbone, CEILING, "imitation", s)]["seconds"] for s in own]
            row += [page.NONE, f"{np.mean([x['total'] for x in seconds]) / 60:.0f}"]
        rows.append(row + [page.NONE] * (9 - len(row)))
    heads = ("", "demonstrations", "seeds", "before", "after")
    hard = " and ".join(HARD)
    return page.table(
        [*heads, f"{hard}, before", f"{hard}, after", "environment steps", "minutes"], rows
    )


def _last(results: Results, where: tuple[str, int], seeds: Sequence[int], name: str) -> float:
    """Return the mean over seeds of what the last row of progress says."""
    found = [results[cell(*where, "teacher", s)]["progress"][-1][name] for s in seeds]
    return float(np.mean(found))


def _task_table(results: Results, seeds: dict[tuple[str, int], list[int]]) -> str:
    """Return the gains by task over paired episodes."""
    rows = []
    for (backbone, count), own in seeds.items():
        gains = [
            page.points(
                statistics.difference(
                    *(
                        _outcomes(results, (backbone, count), policy, own, [task])
                        for policy in ("teacher", "start")
                    )
                )
            )
            for task in (TASKS if own else ())
        ]
        rows.append([BACKBONES[backbone], str(count), *(gains or [page.NONE] * len(TASKS))])
    return page.table(["gain [points]", "demonstrations", *TASKS], rows)


def _rank_table(results: Results) -> str:
    """Return success of new adapters by their rank."""
    rows = []
    for name, label in RANKS.items():
        row = [label]
        for backbone in BACKBONES:
            where = backbone, COUNTS[0]
            own = _seeds(results, *where, name)
            row.append(str(len(own)))
            estimates = [
                page.percent(statistics.success(_outcomes(results, where, name, own, tasks)))
                for tasks in ((TASKS, HARD) if own else ())
            ]
            row += estimates or [page.NONE, page.NONE]
        rows.append(row)
    heads = [
        f"{label}, {what}"
        for label in BACKBONES.values()
        for what in ("seeds", "four tasks", "pour and pick_place")
    ]
    return page.table([f"new adapters, N = {COUNTS[0]}", *heads], rows)


@mpl.rc_context(STYLE)
def _figure(results: Results, seeds: dict[tuple[str, int], list[int]], path: Path) -> None:
    """Draw success on fixed layouts over minutes: a panel per backbone, a line per run."""
    figure = Figure(figsize=(8, 3), layout="constrained")
    axes = figure.subplots(1, len(BACKBONES), sharey=True)
    for axis, backbone in zip(axes, BACKBONES, strict=True):
        for (name, count), own in seeds.items():
            for seed in own if name == backbone else ():
                minutes, rates = _progress(results[cell(name, count, "teacher", seed)])
                label = f"N = {count}" if seed == own[0] else None
                axis.plot(minutes, 100 * rates, color=COLORS[count], label=label, marker=".")
        axis.set_title(BACKBONES[backbone], loc="left")
        axis.set_xlabel("minutes")
        axis.set_ylim(0, 100)
    axes[0].set_ylabel("success [%]")
    if seeds:
        axes[0].legend()
    figures.write(figure, path, "reinforce")


def _progress(result: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the minutes and the mean success of the evaluations of a run, from the start on."""
    evaluated = [row for row in result["progress"] if f"success/{TASKS[0]}" in row]
    minutes = [0.0, *(row["minutes"] for row in evaluated)]
    before = np.mean([_rate(result["before"][task]) for task in TASKS])
    rates = [before, *(np.mean([row[f"success/{task}"] for task in TASKS]) for row in evaluated)]
    return np.array(minutes), np.array(rates)


def _rate(outcomes: str) -> float:
    return outcomes.count("1") / len(outcomes)
