"""The tables and the figure of README.md, from the results of all policies alone."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from lorasp_jax.evaluation.figure_style import STYLE
from lorasp_jax.extras.study import Study, page, statistics
from lorasp_jax.extras.study import figure as figures
from lorasp_jax.extras.study.page import BACKBONES
from lorasp_jax.extras.study.results import ran
from lorasp_jax.extras.study.statistics import Estimate
from lorasp_jax.extras.study.study import Results

LABELS = {
    "lora_r16": "LoRA, r = 16",
    "lora_r64": "LoRA, r = 64",
    "lora_sp": "LoRA-SP, R = 64",
    "vlm_lora": "LoRA on the VLM, full expert",
    "full": "full fine-tuning",
}
COLORS = {
    "lora_r16": "#97bbf5",
    "lora_r64": "#4269d0",
    "lora_sp": "#ff725c",
    "vlm_lora": "#3ca951",
    "full": "#9498a0",
}
Points = Mapping[tuple[str, str, str], Mapping[str, Sequence[Estimate]]]
"""Success by (backbone, scene, augmentation), then method, for each of `COUNTS`."""
AUGMENT = {"none": "no", "openpi": "openpi's"}
"""Preset of augmentation -> its label."""
COUNTS = (10, 25, 50, 120, 512)
STEPS, OTHER_STEPS = 2000, (500, 8000)
STEPPED, STEPPED_COUNTS = "lora_r64", (10, 50, 512)
"""Method and numbers of demonstrations that train for other numbers of steps, too."""
SEEDS = (0, 1, 2)
PARTS = {
    "none": "none",
    "openpi": "openpi's",
    "openpi_cropped": "openpi's, the camera cropped in evaluation, too",
    "crop": "openpi's crop alone",
    "crop_cropped": "openpi's crop alone, the camera cropped in evaluation, too",
    "rotate": "openpi's rotation alone",
    "color": "openpi's colors alone",
    "no_crop": "openpi's rotation and colors",
    "lerobot": "LeRobot's",
}
"""Augmentation of `STEPPED` with the most demonstrations and the first seed -> its label."""
SCENES = {"recorded": "as recorded", "shifted": "shifted"}
DRAWS = 2_000
"""Resamplings of policies for the interval of a correlation."""


def cell(backbone: str, method: str, kind: str, count: int, seed: int) -> str:
    """Return the name of a policy; see `kind`."""
    return f"{backbone}/{method}/{kind}/n{count}/s{seed}"


def kind(augment: str, steps: int) -> str:
    """Return the part of a name that says the augmentation and, unless usual, the steps."""
    return augment if steps == STEPS else f"{augment}_{steps}"


def blocks(_: Study, results: Results, folder: Path) -> dict[str, str]:
    """Write the figure into `folder`; return the tables, of backbones whose policies have run."""
    cases = [*itertools.product(LABELS, AUGMENT, COUNTS)]
    backbones = [b for b in BACKBONES if all(_names(results, b, *case) for case in cases)]
    points = {
        (backbone, scene, kind): {
            method: [_estimate(results, backbone, method, kind, n, scene) for n in COUNTS]
            for method in LABELS
        }
        for backbone in backbones
        for scene in SCENES
        for kind in AUGMENT
    }
    if backbones:
        _figure(folder / "success.svg", backbones, points)
    made = {"augmentation": _parts_table(results)}
    for backbone in backbones:
        for scene in SCENES:
            made[f"{backbone} {scene}"] = _success_table(results, points, backbone, scene)
        made[f"{backbone} methods"] = _difference_table(results, backbone)
        made[f"{backbone} steps"] = _steps_table(results, backbone)
        made[f"{backbone} error"] = _error_table(results, backbone)
    return made


def _success_table(results: Results, points: Points, backbone: str, scene: str) -> str:
    head = [f"{BACKBONES[backbone]}, {SCENES[scene]} [%]", "augmentation"]
    head += [f"N = {n}" for n in COUNTS]
    rows = []
    for method, kind in itertools.product(LABELS, AUGMENT):
        found = [_names(results, backbone, method, kind, n) for n in COUNTS]
        cells = map(_percent, points[backbone, scene, kind][method], found)
        rows.append([LABELS[method], AUGMENT[kind], *cells])
    return page.table(head, rows)


def _names(results: Results, backbone: str, method: str, kind: str, count: int) -> list[str]:
    """Return the policies of all seeds that have run."""
    names = [cell(backbone, method, kind, count, seed) for seed in SEEDS]
    return [name for name in names if name in results]


def _percent(estimate: Estimate, names: Sequence[str]) -> str:
    """Return a rate, with the number of seeds where some have not run."""
    seeds = len(names)
    return page.percent(estimate) + (f" ({seeds} of {len(SEEDS)})" if seeds < len(SEEDS) else "")


def _difference_table(results: Results, backbone: str) -> str:
    """Return success as recorded, without augmentation, minus that of `STEPPED`, by layout."""
    rows = []
    for method, label in LABELS.items():
        if method == STEPPED:
            continue
        cells = []
        for n in COUNTS:
            both = ([cell(backbone, m, "none", n, s) for s in SEEDS] for m in (method, STEPPED))
            pair = (outcomes(found, "recorded") for found in ran(results, *both))
            cells.append(page.difference(*pair))
        rows.append([label, *cells])
    head = [f"{BACKBONES[backbone]}, points", *(f"N = {n}" for n in COUNTS)]
    return page.table(head, rows)


def _parts_table(results: Results) -> str:
    """Return success by the parts of augmentation."""
    rows = []
    for part, label in PARTS.items():
        cells = []
        for backbone, scene in itertools.product(BACKBONES, SCENES):
            result = results.get(cell(backbone, STEPPED, part, COUNTS[-1], SEEDS[0]))
            cells.append(page.success(outcomes([result], scene) if result else None))
        rows.append([label, *cells])
    head = [f"{name}, {scene}" for name in BACKBONES.values() for scene in SCENES.values()]
    return page.table(["augmentation", *head], rows)


def _steps_table(results: Results, backbone: str) -> str:
    """Return success and held-out error of `STEPPED` by augmentation and number of steps."""
    lengths = sorted((STEPS, *OTHER_STEPS))
    rows = []
    for augment, n in itertools.product(AUGMENT, STEPPED_COUNTS):
        cells = []
        for steps in lengths:
            at = backbone, STEPPED, kind(augment, steps), n
            names = _names(results, *at)
            errors = [results[name]["action_error"] for name in names]
            if not names:
                cells.append(page.NONE)
                continue
            shown = _percent(_estimate(results, *at, "recorded"), names)
            cells.append(f"{shown}; {np.mean(errors):.3f}")
        rows.append([AUGMENT[augment], f"{n}", *cells])
    head = [f"{BACKBONES[backbone]}: augmentation", "N", *(f"{n:,} steps" for n in lengths)]
    return page.table(head, rows)


def _error_table(results: Results, backbone: str) -> str:
    """Return how well measures of held-out demonstrations rank policies by success."""
    rows = []
    names = {
        n: [name for m in LABELS for a in AUGMENT for name in _names(results, backbone, m, a, n)]
        for n in COUNTS
    }
    everything = [name for group in names.values() for name in group]
    for label, group in ({f"N = {n}": g for n, g in names.items()} | {"all": everything}).items():
        found = [results[name] for name in group]
        row = [label]
        for scene in SCENES:
            rates = [outcomes([result], scene).mean() for result in found]
            for measure in ("action_error", "loss"):
                row.append(_correlation([result[measure] for result in found], rates))
        rows.append(row)
    pairs = [f"{m}, {label}" for label in SCENES.values() for m in ("action error", "loss")]
    return page.table([f"{BACKBONES[backbone]}, policies", *pairs], rows)


def _correlation(errors: Sequence[float], rates: Sequence[float]) -> str:
    """Return Spearman's correlation with its interval from a bootstrap over policies."""
    pairs = np.array([errors, rates])
    # The raw stream of PCG64 is one that NumPy promises not to change.
    raw = np.random.PCG64(0).random_raw(DRAWS * len(errors)) % np.uint64(len(errors))
    chosen = [np.arange(len(errors)), *raw.astype(np.int64).reshape(DRAWS, -1)]
    ranks = stats.rankdata(pairs[:, np.array(chosen)], axis=-1)
    ranks -= ranks.mean(-1, keepdims=True)
    products = (ranks[0] * ranks[1]).sum(-1) / np.sqrt((ranks**2).sum(-1).prod(0))
    low, high = np.nanquantile(products[1:], [0.025, 0.975])
    value, low, high = (page.signed(float(x), 2) for x in (products[0], low, high))
    return f"{value} [{low}, {high}]"


def _estimate(
    results: Results, backbone: str, method: str, kind: str, count: int, scene: str
) -> Estimate:
    found = [results[name] for name in _names(results, backbone, method, kind, count)]
    return statistics.success(outcomes(found, scene))


def outcomes(found: Iterable[Mapping[str, Any]], scene: str) -> np.ndarray:
    """Stack the episodes of some policies in a scene, bool `[S, T, N]`."""
    every = (result["outcomes"].items() for result in found)
    return statistics.stacked([{k: o for k, o in x if k.startswith(f"{scene}/")} for x in every])


@mpl.rc_context(STYLE)
def _figure(path: Path, backbones: Sequence[str], points: Points) -> None:
    """Draw a row per scene, and a column per backbone and augmentation; write it as SVG."""
    columns = [(backbone, kind) for backbone in backbones for kind in AUGMENT]
    figure = Figure(figsize=(1.2 + 3.2 * len(columns), 5.4), layout="constrained")
    axes = figure.subplots(len(SCENES), len(columns), sharex=True, sharey=True, squeeze=False)
    for column, (backbone, kind) in enumerate(columns):
        for row, scene in enumerate(SCENES):
            methods = points[backbone, scene, kind]
            curves = {LABELS[name]: (COLORS[name], found) for name, found in methods.items()}
            figures.panel(axes[row, column], COUNTS, curves)
        title = f"{BACKBONES[backbone]}, {AUGMENT[kind]} augmentation"
        axes[0, column].set_title(title, loc="left")
        axes[-1, column].set_xlabel("demonstrations of each task")
    for row, label in zip(axes, SCENES.values(), strict=True):
        row[0].set_ylabel(f"success, {label} [%]")
    figures.write(figure, path, "few")
