"""The deployment variants of two LoRA-SP runs, which the commands in README.md train.

lorasp-jax study --config studies/deployment/study.py --results studies/deployment/results.json
"""

from pathlib import Path

from lorasp_jax.extras.deployment import measurement
from lorasp_jax.extras.deployment.variants import VARIANTS
from lorasp_jax.extras.study import Study

RUNS = {"pi0_small": ("multitask", 256), "pi0_nano": ("press", 64)}
"""Name of a table -> folder of its run in runs/, and episodes per task."""
NAMES = tuple(name for name in VARIANTS if not name.startswith("lora-"))
"""Variants to compare: `lora` acts as `merged` does, but for rounding."""


def get_study(scale: str) -> Study:  # noqa: ARG001
    """Return the study."""
    cells = [
        cell
        for name, (run, episodes) in RUNS.items()
        for cell in measurement.cells(Path("runs", run), episodes, f"{name}/", names=NAMES)
    ]
    return Study(
        "deployment",
        tuple(cells),
        measure=measurement.measure,
        page=lambda _, results, __: {n: measurement.table(results, f"{n}/") for n in RUNS},
    )
