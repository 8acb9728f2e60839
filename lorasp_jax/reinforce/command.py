"""`train.py` for a `ReinforceConfig`."""

from pathlib import Path

from rich.console import Console

from lorasp_jax.evaluation.callback import Evaluation
from lorasp_jax.reinforce import loop, start
from lorasp_jax.reinforce.config import ReinforceConfig
from lorasp_jax.reinforce.films import Films
from lorasp_jax.report.callback import Report

KIND = "reinforcement learning"
resolve = start.resolve


def run(
    config: ReinforceConfig, folder: Path, console: Console, started: float, *, resume: bool
) -> None:
    """Learn from a start run, evaluate before and after, export the policy, write the report."""
    learned = start.load(config, folder, console, started)
    callbacks = [start.PolicyExport(), Evaluation(learned=True), Films(learned.policy), Report()]
    loop.train(learned, callbacks, resume=resume)
    report = folder / "report.html"
    console.print(f"finished in {learned.seconds['total']:.0f} s: {report}", markup=False)
