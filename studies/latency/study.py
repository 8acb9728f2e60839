"""Success and smoothness under latency of two runs, which the commands in README.md train.

lorasp-jax study --config studies/latency/study.py --results studies/latency/results.json
"""

from pathlib import Path

from lorasp_jax.extras.latency import curve, figure
from lorasp_jax.extras.latency.execution import EXECUTIONS, Execution
from lorasp_jax.extras.study import Study, page
from lorasp_jax.extras.study.study import Results

RUNS = {"smolvla_small": ("SmolVLA small", "rtc_smolvla"), "pi0_small": ("π0 small", "rtc")}
"""Name of a table -> its title, and the folder of its run in runs/."""
TASKS = ("press", "pick_place", "open_pot", "pour")
SHOWN = (0, 2, 4, 8)
"""Delays in the tables [control steps]."""


def get_study(scale: str) -> Study:  # noqa: ARG001
    """Return the study."""
    executions = [Execution(name, execute_steps=8) for name in EXECUTIONS]
    cells = [
        cell
        for name, (_, run) in RUNS.items()
        for cell in curve.cells(Path("runs", run), TASKS, executions, range(9), 256, f"{name}/")
    ]
    return Study("latency", tuple(cells), page=blocks)


def blocks(_: Study, results: Results, folder: Path) -> dict[str, str]:
    """Write the figure into `folder`; return the tables."""
    by_run = {
        name: {n: result for n, result in results.items() if n.startswith(f"{name}/")}
        for name in RUNS
    }
    figure.write(folder / "latency.svg", [(RUNS[name][0], by_run[name]) for name in RUNS])
    return {name: _table(RUNS[name][0], by_run[name]) for name in RUNS}


def _table(title: str, results: Results) -> str:
    rows = []
    for execution in EXECUTIONS:
        points = {point["delay"]: point for point in figure.average(results, execution)}
        shown = [points[delay] for delay in SHOWN]
        success = ["{:.1f} ({:.0f}-{:.0f})".format(p["success"], *p["ci95"]) for p in shown]
        jerk = ", ".join(f"{point['jerk']:.0f}" for point in shown)
        rows.append([f"`{execution}`", *success, jerk])
    heads = [f"{title}, success [%]", *(f"d = {delay}" for delay in SHOWN)]
    return page.table([*heads, f"jerk [rad/s³] at d = {', '.join(map(str, SHOWN))}"], rows)
