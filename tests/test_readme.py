"""The README's examples run as they stand, and it stays a front page."""

import re

import numpy as np
import pytest

from lorasp_jax.peft.lora_sp import reference
from tests import ROOT

README = (ROOT / "README.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
LINES = 126


def test_it_stays_short():
    assert len(README.splitlines()) <= LINES


def test_your_own_model(capsys):
    exec(compile(EXAMPLES[0], "README.md", "exec"), {})
    assert "lora_sp" in capsys.readouterr().out


def test_simulation_compiles_as_text():  # it needs a finished run
    (code,) = EXAMPLES[1:]
    compile(code, "README.md", "exec")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_figure_is_there_in_both_schemes(scheme):
    figure = f"docs/figures/lora_sp_{scheme}.svg"
    assert figure in README
    assert (ROOT / figure).stat().st_size < 300_000


def test_the_figure_shows_what_the_gate_does():
    facts = np.load(ROOT / "docs/figures/lora_sp.npz")
    mask, _ = reference.energy_gate(facts["scores"], float(facts["energy_target"]))
    np.testing.assert_array_equal(mask, facts["mask"])
    np.testing.assert_array_equal(mask.sum(-1), facts["active_rank"].ravel()[facts["token"]])


def test_the_films_load_fast():
    assert (ROOT / "docs/figures/films.webp").stat().st_size < 2_000_000
