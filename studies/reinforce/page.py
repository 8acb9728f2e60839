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


def cell(backbone: str, count: int, policy: str, seed: int) -> str:
    """Return the name of a policy."""
    return f"{backbone}/n{count}/{policy}/s{seed}"


def blocks(_: Study, results: Results, folder: Path) -> dict[str, str]:
    """Write the figures into `folder`; return the tables, with the seeds that have run."""
    seeds = {(b, n): _seeds(results, b, n, "teacher") for b in BACKBONES for n in COUNTS}
    _figure(results, folder / "progress.svg")
    _rank_figure(results, folder / "ranks.svg")
    return {
        "success": _success_table(results, seeds),
        "tasks": _task_table(results, seeds),
        "ranks": _rank_table(results),
        "active": _active_table(results),
        "scenes": _scene_table(results),
        "forgetting": _forgetting_table(results),
        "owner": _owner_table(results),
        "pilots": _pilot_table(results),
    }


def _seeds(results: Results, backbone: str, count: int, policy: str) -> list[int]:
    """Return the seeds of which a policy has run."""
    return [s for s in SEEDS if cell(backbone, count, policy, s) in results]


def _outcomes(
    results: Results,
    where: tuple[str, int],
    policy: str,
    seeds: Sequence[int],
    tasks: Sequence[str] = TASKS,
    when: str = "outcomes",
    prefix: str = "",
) -> np.ndarray:
    """Stack the episodes of a policy's seeds, bool `[S, T, N]`; `when` "before": of its start.

    That is the start that it began from, which each computer has trained for itself. With `when`
    "shifted", they are those in a shifted scene, of which `prefix` says "before/" or "after/".
    """
    found = [results[cell(*where, policy, seed)][when] for seed in seeds]
    return statistics.stacked([{task: x[prefix + task] for task in tasks} for x in found])


def _success_table(results: Results, seeds: dict[tuple[str, int], list[int]]) -> str:
    """Return success before and after, and what it took."""
    rows = []
    for (backbone, count), own in seeds.items():
        row = [BACKBONES[backbone], str(count), str(len(own))]
        if own:
            at = results, (backbone, count)
            stacked = [
                _outcomes(*at, "teacher", own, tasks, when)
                for tasks in (TASKS, HARD)
                for when in ("before", "outcomes")
            ]
            row += [page.percent(statistics.success(x)) for x in stacked]
            row += [f"{_last(*at, own, 'environment_steps') / 1e6:.1f} M"]
            row += [f"{_last(*at, own, 'minutes'):.0f}"]
        rows.append(row)
    for backbone in BACKBONES:
        own = _seeds(results, backbone, CEILING, "imitation")
        row = [BACKBONES[backbone], f"{CEILING}, imitation alone", str(len(own))]
        if own:
            at = results, (backbone, CEILING), "imitation", own
            estimates = [statistics.success(_outcomes(*at, tasks)) for tasks in (TASKS, HARD)]
            row += [page.NONE, page.percent(estimates[0]), page.NONE, page.percent(estimates[1])]
            seconds = [results[cell(backbone, CEILING, "imitation", s)]["seconds"] for s in own]
            row += [page.NONE, f"{np.mean([x['total'] for x in seconds]) / 60:.0f}"]
        rows.append(row)
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
        gains = _gains(results, (backbone, count), "teacher", own)
        rows.append([BACKBONES[backbone], str(count), *gains])
    return page.table(["gain [points]", "demonstrations", *TASKS], rows)


def _gains(
    results: Results, where: tuple[str, int], policy: str, seeds: Sequence[int]
) -> list[str]:
    """Return the gains of a policy over its start, by task; none without seeds."""
    if not seeds:
        return []
    pairs = [
        [_outcomes(results, where, policy, seeds, [task], when) for when in ("outcomes", "before")]
        for task in TASKS
    ]
    return [page.points(statistics.difference(*pair)) for pair in pairs]


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
        for what in ("seeds", "four tasks", " and ".join(HARD))
    ]
    return page.table([f"new adapters, N = {COUNTS[0]}", *heads], rows)


def _active_table(results: Results) -> str:
    """Return LoRA-SP's mean active rank by module in the first and the last iteration."""
    rows = []
    for backbone in BACKBONES:
        own = _seeds(results, backbone, COUNTS[0], "lora_sp")
        runs = [results[cell(backbone, COUNTS[0], "lora_sp", s)]["progress"] for s in own]
        row = [BACKBONES[backbone], str(len(own))]
        for name in MODULES if own else ():
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
        where = backbone, COUNTS[0]
        for label, name, when in (
            ("before", "teacher", "before"),
            ("learned as recorded", "teacher", "after"),
            ("learned in shifted scenes", "randomized", "after"),
        ):
            own = _seeds(results, *where, name)
            row = [BACKBONES[backbone], label, str(len(own))]
            if own:
                recorded = "before" if when == "before" else "outcomes"
                stacked = [
                    _outcomes(results, where, name, own, when=recorded),
                    _outcomes(results, where, name, own, when="shifted", prefix=f"{when}/"),
                ]
                row += [page.percent(statistics.success(x)) for x in stacked]
            rows.append(row)
    return page.table([f"N = {COUNTS[0]}", "", "seeds", "as recorded", "shifted"], rows)


def _forgetting_table(results: Results) -> str:
    """Return the gains of policies that learned `HARD` alone, by task over paired episodes."""
    rows = []
    for backbone in BACKBONES:
        own = _seeds(results, backbone, COUNTS[0], "some")
        gains = _gains(results, (backbone, COUNTS[0]), "some", own)
        rows.append([BACKBONES[backbone], str(len(own)), *gains])
    return page.table(["gain [points]", "seeds", *TASKS], rows)


def _owner_table(results: Results) -> str:
    """Return success in one task by the number of own episodes."""
    rows = []
    for backbone in BACKBONES:
        cases = {"before": (f"noise_{EPISODES[1]}",)}
        cases |= {"its 16 demonstrations alone": ("imitation_0",)}
        cases |= {label: tuple(f"{x}_{n}" for n in EPISODES) for x, label in OWNERS.items()}
        for label, names in cases.items():
            row, when = [BACKBONES[backbone], label], "before" if label == "before" else "outcomes"
            for name in names:
                own = _seeds(results, backbone, COUNTS[0], name)
                where = results, (backbone, COUNTS[0]), name, own, [OWNED], when
                row.append(
                    page.percent(statistics.success(_outcomes(*where))) if own else page.NONE
                )
            at = 3 - len(names)
            rows.append([*row, *[""] * at])
    return page.table([OWNED, "", *(f"{n} episodes" for n in EPISODES)], rows)


def _pilot_table(results: Results) -> str:
    """Return success of the pilots that have run."""
    rows = []
    for name, label in PILOTS.items():
        row = [label]
        for backbone in BACKBONES:
            where = backbone, COUNTS[0]
            there = cell(*where, name, PILOT_SEED) in results
            row += [
                f"{100 * _outcomes(results, where, name, [PILOT_SEED], tasks).mean():.1f}"
                if there
                else page.NONE
                for tasks in (TASKS, HARD)
            ]
        rows.append(row)
    heads = [
        f"{label}, {what}"
        for label in BACKBONES.values()
        for what in ("four tasks", " and ".join(HARD))
    ]
    return page.table(["pilots", *heads], rows)


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
            where, color = (backbone, COUNTS[0]), list(COLORS.values())[number]
            own = {name: _seeds(results, *where, name) for name in ("start", *RANKS)}
            found = {
                name: statistics.success(_outcomes(results, where, name, seeds, tasks))
                for name, seeds in own.items()
                if seeds
            }
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
