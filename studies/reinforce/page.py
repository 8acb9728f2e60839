"""The tables and figures of README.md, from the results of all policies alone."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from lorasp_jax.evaluation.figure_style import STYLE
from lorasp_jax.extras.study import Study, page, statistics
from lorasp_jax.extras.study import figure as figures
from lorasp_jax.extras.study.page import BACKBONES
from lorasp_jax.extras.study.results import ran
from lorasp_jax.extras.study.study import Results

COUNTS = (16, 32, 64)
CEILING = 512
"""Demonstrations of imitation alone."""
SEEDS = (0, 1, 2)
PILOTS = {
    "start": "before",
    "short": "16 and 18 of 30 iterations: 5 rounds of teachers, 256 worlds, 300 gradient steps",
    "long": "12 iterations: 15, 256, 1,000",
    "wide": "12 iterations: 15, 512, 1,000",
    "ppo": "`configs/ppo.py` for 20 minutes",
    "ppo_sde": "the same, `--online.exploration sde`",
}
PILOT_SEED = 1000
"""In no table but that of pilots."""
TASKS = ("open_pot", "pour", "press", "pick_place")
HARD = ("pour", "pick_place")
OWNED = "pick_place"
"""The task of few own episodes."""
EPISODES = (50, 200, 1000)
OWNERS = {"filtered": "`--learn filtered`", "recap": "`--learn recap`", "noise": "noise space"}
RANKS = {
    "r1": "LoRA, r = 1",
    "r4": "LoRA, r = 4",
    "r16": "LoRA, r = 16",
    "r64": "LoRA, r = 64",
    "lora_sp": "LoRA-SP, R = 64",
    "full": "full",
}
"""New adapters that learn from success after those of the start are merged."""
MODULES = ("vision", "language", "action")
COLORS = {16: "#4269d0", 32: "#ff725c", 64: "#3ca951"}
Ran = Sequence[Mapping[str, Any]]
"""Results of one policy, by seed."""


def cell(backbone: str, count: int, policy: str, seed: int) -> str:
    """Return the name of a policy."""
    return f"{backbone}/n{count}/{policy}/s{seed}"


def blocks(_: Study, results: Results, folder: Path) -> dict[str, str]:
    """Write the figures into `folder`; return the tables, with the seeds that have run."""
    _figure(results, folder / "progress.svg")
    _rank_figure(results, folder / "ranks.svg")
    return {
        "success": _success_table(results),
        "tasks": _task_table(results),
        "ranks": _rank_table(results),
        "active": _active_table(results),
        "scenes": _scene_table(results),
        "forgetting": _forgetting_table(results),
        "owner": _owner_table(results),
        "pilots": _pilot_table(results),
    }


def _ran(
    results: Results, backbone: str, count: int, policy: str, seeds: Sequence[int] = SEEDS
) -> Ran:
    """Return the results of a policy, of the seeds that have run."""
    return ran(results, [cell(backbone, count, policy, seed) for seed in seeds])[0]


def _outcomes(
    found: Ran, tasks: Sequence[str] = TASKS, when: str = "outcomes", prefix: str = ""
) -> np.ndarray | None:
    """Stack the episodes of a policy's seeds, bool `[S, T, N]`, or None without seeds.

    With `when` "before", they are those of the start that it began from, which each computer has
    trained for itself; with "shifted", those in a shifted scene, of which `prefix` says "before/"
    or "after/".
    """
    rows = [{task: each[when][prefix + task] for task in tasks} for each in found]
    return statistics.stacked(rows) if rows else None


def _success_table(results: Results) -> str:
    """Return success before and after, and what it took."""
    rows = []
    for backbone, count in itertools.product(BACKBONES, COUNTS):
        found = _ran(results, backbone, count, "teacher")
        row = [BACKBONES[backbone], str(count), str(len(found))]
        for tasks, when in itertools.product((TASKS, HARD), ("before", "outcomes")):
            row.append(page.success(_outcomes(found, tasks, when)))
        if found:
            last = [each["progress"][-1] for each in found]
            steps, minutes = (
                np.mean([row[name] for row in last]) for name in ("environment_steps", "minutes")
            )
            row += [f"{steps / 1e6:.1f} M", f"{minutes:.0f}"]
        rows.append(row)
    for backbone in BACKBONES:
        found = _ran(results, backbone, CEILING, "imitation")
        row = [BACKBONES[backbone], f"{CEILING}, imitation alone", str(len(found))]
        for tasks in (TASKS, HARD):
            row += [page.NONE, page.success(_outcomes(found, tasks))]
        if found:
            seconds = np.mean([each["seconds"]["total"] for each in found])
            row += [page.NONE, f"{seconds / 60:.0f}"]
        rows.append(row)
    heads = ("", "demonstrations", "seeds", "before", "after")
    hard = " and ".join(HARD)
    return page.table(
        [*heads, f"{hard}, before", f"{hard}, after", "environment steps", "minutes"], rows
    )


def _task_table(results: Results) -> str:
    """Return the gains by task over paired episodes."""
    rows = [
        [BACKBONES[b], str(n), *_gains(_ran(results, b, n, "teacher"))]
        for b, n in itertools.product(BACKBONES, COUNTS)
    ]
    return page.table(["gain [points]", "demonstrations", *TASKS], rows)


def _gains(found: Ran) -> list[str]:
    """Return the gains of a policy over its start, by task."""
    pairs = ([_outcomes(found, [task], when) for when in ("outcomes", "before")] for task in TASKS)
    return [page.difference(*pair) for pair in pairs]


def _rank_table(results: Results) -> str:
    """Return success of new adapters by their rank."""
    rows = []
    for name, label in RANKS.items():
        row = [label]
        for backbone in BACKBONES:
            found = _ran(results, backbone, COUNTS[0], name)
            row.append(str(len(found)))
            row += [page.success(_outcomes(found, tasks)) for tasks in (TASKS, HARD)]
        rows.append(row)
    return page.table([f"new adapters, N = {COUNTS[0]}", *_heads("seeds")], rows)


def _heads(*first: str) -> list[str]:
    """Return the heads of columns of each backbone, the last ones for all and for `HARD` tasks."""
    columns = (*first, "four tasks", " and ".join(HARD))
    return [f"{label}, {what}" for label in BACKBONES.values() for what in columns]


def _active_table(results: Results) -> str:
    """Return LoRA-SP's mean active rank by module in the first and the last iteration."""
    rows = []
    for backbone, label in BACKBONES.items():
        runs = [each["progress"] for each in _ran(results, backbone, COUNTS[0], "lora_sp")]
        row = [label, str(len(runs))]
        for name in MODULES if runs else ():
            first, last = (
                np.mean([run[i][f"active_rank/{name}"] for run in runs]) for i in (0, -1)
            )
            row.append(f"{first:.1f} → {last:.1f}")
        rows.append(row)
    return page.table(["active rank of 64", "seeds", *MODULES], rows)


def _scene_table(results: Results) -> str:
    """Return success as recorded and in a shifted scene."""
    rows = []
    for backbone in BACKBONES:
        for label, name, when, prefix in (
            ("before", "teacher", "before", "before/"),
            ("learned as recorded", "teacher", "outcomes", "after/"),
            ("learned in shifted scenes", "randomized", "outcomes", "after/"),
        ):
            found = _ran(results, backbone, COUNTS[0], name)
            recorded = page.success(_outcomes(found, when=when))
            shifted = page.success(_outcomes(found, when="shifted", prefix=prefix))
            rows.append([BACKBONES[backbone], label, str(len(found)), recorded, shifted])
    return page.table([f"N = {COUNTS[0]}", "", "seeds", "as recorded", "shifted"], rows)


def _forgetting_table(results: Results) -> str:
    """Return the gains of policies that learned `HARD` alone, by task over paired episodes."""
    rows = []
    for backbone, label in BACKBONES.items():
        found = _ran(results, backbone, COUNTS[0], "some")
        rows.append([label, str(len(found)), *_gains(found)])
    return page.table(["gain [points]", "seeds", *TASKS], rows)


def _owner_table(results: Results) -> str:
    """Return success in one task by the number of own episodes."""
    cases = {"before": [f"noise_{EPISODES[1]}"], "its 16 demonstrations alone": ["imitation_0"]}
    cases |= {label: [f"{x}_{n}" for n in EPISODES] for x, label in OWNERS.items()}
    rows = []
    for backbone, (label, names) in itertools.product(BACKBONES, cases.items()):
        when = "before" if label == "before" else "outcomes"
        every = (_ran(results, backbone, COUNTS[0], name) for name in names)
        row = [page.success(_outcomes(found, [OWNED], when)) for found in every]
        rows.append([BACKBONES[backbone], label, *row, *[""] * (len(EPISODES) - len(row))])
    return page.table([OWNED, "", *(f"{n} episodes" for n in EPISODES)], rows)


def _pilot_table(results: Results) -> str:
    """Return success of the pilots that have run."""
    rows = []
    for name, label in PILOTS.items():
        row = [label]
        for backbone in BACKBONES:
            found = _ran(results, backbone, COUNTS[0], name, [PILOT_SEED])
            for stacked in (_outcomes(found, tasks) for tasks in (TASKS, HARD)):
                row.append(page.NONE if stacked is None else f"{100 * stacked.mean():.1f}")
        rows.append(row)
    return page.table(["pilots", *_heads()], rows)


@mpl.rc_context(STYLE)
def _figure(results: Results, path: Path) -> None:
    """Draw success on fixed layouts over minutes: a panel per backbone, a line per run."""
    figure = Figure(figsize=(8, 3), layout="constrained")
    axes = figure.subplots(1, len(BACKBONES), sharey=True)
    pilot = (COUNTS[0], "wide", PILOT_SEED)
    for axis, backbone in zip(axes, BACKBONES, strict=True):
        for case in [pilot, *((n, "teacher", s) for n in COUNTS for s in SEEDS)]:
            if (name := cell(backbone, *case)) not in results:
                continue
            label = f"N = {case[0]}" + ", pilot" * (case == pilot)
            label = label if case[2] in (SEEDS[0], PILOT_SEED) else None
            style = {"linestyle": "dashed" if case == pilot else "solid", "marker": "."}
            minutes, rates = _progress(results[name])
            axis.plot(minutes, 100 * rates, color=COLORS[case[0]], label=label, **style)
        axis.set_title(BACKBONES[backbone], loc="left")
        axis.set_xlabel("minutes")
        axis.set_ylim(0, 100)
    axes[0].set_ylabel("success [%]")
    figures.write(figure, path, "reinforce")


@mpl.rc_context(STYLE)
def _rank_figure(results: Results, path: Path) -> None:
    """Draw success after learning by the new adapters, a line per backbone."""
    figure = Figure(figsize=(8, 3), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for axis, (title, tasks) in zip(
        axes, (("four tasks", TASKS), (" and ".join(HARD), HARD)), strict=True
    ):
        for number, (backbone, label) in enumerate(BACKBONES.items()):
            color = list(COLORS.values())[number]
            own = {name: _ran(results, backbone, COUNTS[0], name) for name in ("start", *RANKS)}
            stacked = {name: _outcomes(each, tasks) for name, each in own.items()}
            found = {n: statistics.success(x) for n, x in stacked.items() if x is not None}
            if "start" in found:
                start = 100 * found.pop("start").value
                axis.axhline(start, color=color, linestyle="dotted", label=f"{label}, before")
            at = [list(RANKS).index(name) for name in found]
            rates = 100 * np.array([[x.value, x.low, x.high] for x in found.values()])
            if at:
                bars = np.abs(rates[:, 1:].T - rates[:, 0])
                axis.errorbar(at, rates[:, 0], bars, color=color, marker=".", label=label)
        axis.set_title(title, loc="left")
        axis.set_xticks(range(len(RANKS)), [x.replace(", ", "\n") for x in RANKS.values()])
        axis.set_ylim(0, 100)
    axes[0].set_ylabel("success [%]")
    figures.write(figure, path, "ranks")


def _progress(result: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the minutes and the mean success of the evaluations of a run, from the start on."""
    evaluated = [row for row in result["progress"] if f"success/{TASKS[0]}" in row]
    minutes = [0.0, *(row["minutes"] for row in evaluated)]
    before = np.mean([_rate(result["before"][task]) for task in TASKS])
    rates = [before, *(np.mean([row[f"success/{task}"] for task in TASKS]) for row in evaluated)]
    return np.array(minutes), np.array(rates)


def _rate(outcomes: str) -> float:
    return outcomes.count("1") / len(outcomes)
