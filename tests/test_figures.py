"""Test the scripts that draw the README's figure and videos."""

import importlib
import json
import re

import numpy as np
import pytest

from lorasp_jax.base.intervals import wilson_interval
from studies.performance import float8
from tests import ROOT

FOLDER = ROOT / "docs" / "figures"
PERFORMANCE = ROOT / "studies" / "performance"


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    return importlib.import_module


def test_figure_is_redrawn_from_saved_measurements(script, tmp_path):
    figure = script("lora_sp")
    measurements = dict(np.load(FOLDER / "lora_sp.npz"))
    sizes = set()
    for scheme, colors in figure.SCHEMES.items():
        path = tmp_path / f"{scheme}.svg"
        figure.draw(measurements, colors, path)
        assert colors["ink"] in path.read_text()
        sizes.add(path.stat().st_size)
    assert min(sizes) > 50_000


def test_short_videos_hold_their_last_image_and_success_gets_a_border(script):
    films = script("films")

    def video(length, success):
        return films.Video(np.zeros((length, films.TILE, films.TILE, 3), np.uint8), success)

    columns = [films.Column("press", video(2, False), video(4, True), 0.1)] * 2
    frames = films.draw_frames(columns)
    assert len(frames) == 4 + films.HOLD
    corner = (3 * films.BAR, films.BAR + films.TILE + films.GAP)
    assert frames[0].getpixel(corner)[:3] == (0, 0, 0)
    assert frames[-1].getpixel(corner)[:3] == films.SUCCESS
    above = (corner[0], films.BAR)
    assert frames[-1].getpixel(above)[:3] == (0, 0, 0)


def test_the_float8_figure_and_table_show_what_was_measured(tmp_path):
    float8.main(tmp_path / "float8.svg")
    assert (tmp_path / "float8.svg").stat().st_size > 20_000
    found = json.loads((PERFORMANCE / "float8.json").read_text())["small"]
    page = (PERFORMANCE / "README.md").read_text()
    table = page.partition("| π0 small, bf16 | float8 |")[2].partition("\n\n")[0]
    rows = re.findall(r"^\| `(\w+)` \| (.*) \|$", table, re.M)
    assert {task for task, _ in rows} == {*found["pi0"]["bf16"][0]["successes"]}
    for task, cells in rows:
        counts = [
            sum(run["successes"][task] for run in found[backbone][kind])
            for backbone in ("pi0", "smolvla")
            for kind in ("bf16", "float8")
        ]
        bounds = [wilson_interval(count, 768) for count in counts]
        assert cells.split(" | ") == [
            f"{100 * count / 768:.1f} ({100 * low:.0f}-{100 * high:.0f})"
            for count, (low, high) in zip(counts, bounds, strict=True)
        ]


def test_the_table_of_other_programs_shows_what_was_measured():
    found = json.loads((PERFORMANCE / "peers.json").read_text())["tables"]
    page = (ROOT / "docs/benchmarks.md").read_text()
    table = page.partition("| work | program |")[2].partition("\n\n")[0]
    shown = re.findall(r"\| ([\d.]+) \| ([\d.]+) GiB \|$", table, re.M)
    variants = [
        ("pi0-train", "ours", "LoRA-SP"),
        ("pi0-train", "ours", "openpi's LoRA"),
        ("pi0-train", "openpi", "LoRA"),
        ("smolvla-train", "ours", "LoRA-SP"),
        ("smolvla-train", "ours", "LoRA"),
        ("smolvla-train", "lerobot", "LoRA, autocast"),
        ("smolvla-expert", "ours", "expert only"),
        ("smolvla-expert", "lerobot", "expert only"),
    ]
    measured = []
    for name, *variant in variants:
        rows = [row for row in found[name] if [row["program"], row["variant"]] == variant]
        rate = 32e3 / np.mean([row["ms"] for row in rows])
        measured.append((f"{rate:.1f}", f"{rows[0]['GiB']:.1f}"))
    assert shown == measured


def test_the_table_of_policy_calls_shows_what_was_measured():
    found = json.loads((PERFORMANCE / "peers.json").read_text())["tables"]
    page = (ROOT / "docs/benchmarks.md").read_text().partition("## Policy calls")[2]
    shown = [
        re.findall(r"\| ([\d.]+)(?= \|)", line) for line in page.split("\n") if line[:3] in _ROWS
    ]
    items = [f"batch {batch}, {n} denoising steps" for batch in (1, 8) for n in (10, 2, 1)]
    measured = []
    for name, *variant in _CALLS:
        rows = [row for row in found[name] if [row["program"], row["variant"]] == variant]
        times = [np.mean([row["ms"] for row in rows if row["item"] == item]) for item in items]
        measured.append([f"{time:.1f}" for time in times])
    assert shown == measured


_ROWS = ("| π", "| S")
_CALLS = [
    (f"{backbone}-sample", program, variant)
    for backbone, peer in (("pi0", "openpi"), ("smolvla", "lerobot"))
    for program, variant in (("ours", "none"), ("ours", "LoRA-SP"), (peer, "none"))
]
