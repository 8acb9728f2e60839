"""Figures appear on the page as soon as a backbone has all results for them."""

import pytest

from studies.paper import drawings
from studies.paper.book import Book
from tests.studies.paper import synthetic

NAMES = tuple(cell.name for cell in synthetic.study().cells)
SOME = {n: r for n, r in synthetic.results().items() if n.startswith("pi0/multi/") or n[-1] == "0"}
BOOK = Book(NAMES, SOME)


@pytest.fixture
def written(tmp_path):
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures/study_3_dark.svg").touch()
    drawings.write(BOOK, tmp_path)
    return sorted(path.name for path in tmp_path.rglob("*.svg"))


def test_only_figures_with_all_results_are_drawn(written):
    names = ("1", "6", "directions", "gradients")
    assert written == [f"study_{name}_{s}.svg" for name in names for s in ("dark", "light")]


def test_missing_backbones_are_named():
    text = drawings.markdown(BOOK, "gradients")
    assert 'src="figures/study_gradients_light.svg"' in text
    assert text.endswith("**SmolVLA: 8 of 24 runs so far.**\n")
    text = drawings.markdown(BOOK, "3")
    assert "<picture>" not in text
    assert text.endswith("**84 of 210 runs so far.**\n")


def test_a_finished_figure_lacks_nothing():
    text = drawings.markdown(Book(NAMES, synthetic.results()), "1")
    assert "scaled from R = 128 to 64. " in text
    assert "it stores all 64.*\n" in text
    assert "so far" not in text


def test_a_figure_without_cells():
    book = Book(tuple(n for n in NAMES if "/panda/" not in n), {})
    assert drawings.markdown(book, "4").endswith("**The study has no runs for this.**\n")


def test_every_figure_says_what_it_shows_to_who_cannot_see_it():
    for name, drawing in drawings.DRAWINGS.items():
        assert drawing.alt.endswith(".")
        text = drawings.markdown(Book(NAMES, synthetic.results()), name)
        assert f'<img alt="{drawing.alt}" src=' in text
        assert '"' not in drawing.alt
