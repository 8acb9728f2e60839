"""The scripts that draw the README's pictures."""

import importlib

import numpy as np
import pytest

from tests import ROOT

FOLDER = ROOT / "docs" / "figures"


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    return importlib.import_module


def test_the_figure_is_drawn_again_from_what_was_measured(script, tmp_path):
    figure = script("lora_sp")
    facts = dict(np.load(FOLDER / "lora_sp.npz"))
    sizes = set()
    for scheme, colors in figure.SCHEMES.items():
        path = tmp_path / f"{scheme}.svg"
        figure.draw(facts, colors, path)
        assert colors["ink"] in path.read_text()
        sizes.add(path.stat().st_size)
    assert min(sizes) > 50_000


@pytest.mark.parametrize("size", [16, 128])
def test_the_figure_takes_banks_and_pictures_of_any_size(script, tmp_path, size):
    figure, rng = script("lora_sp"), np.random.default_rng(0)
    scores = rng.random((2, size))
    facts = {
        "image": np.zeros((64, 64, 3), np.uint8),
        "active_rank": rng.integers(1, size, (8, 8)),
        "token": np.array([0, 63]),
        "scores": scores,
        "mask": scores > 0.5,
        "energy_target": np.array(0.9),
    }
    figure.draw(facts, figure.SCHEMES["light"], tmp_path / "figure.svg")


def test_short_films_wait_and_success_is_framed(script):
    films = script("films")

    def film(length, success):
        return films.Film(np.zeros((length, films.TILE, films.TILE, 3), np.uint8), success)

    columns = [films.Column("press", film(2, False), film(4, True), 0.1)] * 2
    frames = films.strip(columns)
    assert len(frames) == 4 + films.HOLD
    corner = (3 * films.BAR, films.BAR + films.TILE + films.GAP)
    assert frames[0].getpixel(corner)[:3] == (0, 0, 0)
    assert frames[-1].getpixel(corner)[:3] == films.SUCCESS
    above = (corner[0], films.BAR)
    assert frames[-1].getpixel(above)[:3] == (0, 0, 0)
