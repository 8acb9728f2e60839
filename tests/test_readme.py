"""Test that the README's examples run as is and that it stays short."""

import re

import numpy as np
import pytest

from lorasp_jax.peft.lora_sp import reference
from tests import ROOT

README = (ROOT / "README.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
MAX_LINES = 130


def test_readme_is_short():
    assert len(README.splitlines()) <= MAX_LINES


def test_model_example_runs(capsys):
    exec(compile(EXAMPLES[0], "README.md", "exec"), {})
    assert "lora_sp" in capsys.readouterr().out


def test_simulation_example_compiles():  # running it needs a finished run
    (code,) = EXAMPLES[1:]
    compile(code, "README.md", "exec")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_figure_exists_in_both_color_schemes(scheme):
    figure = f"docs/figures/lora_sp_{scheme}.svg"
    assert figure in README
    assert (ROOT / figure).stat().st_size < 300_000


def test_figure_data_agree_with_the_gate():
    data = np.load(ROOT / "docs/figures/lora_sp.npz")
    mask, _ = reference.energy_gate(data["scores"], float(data["energy_target"]))
    np.testing.assert_array_equal(mask, data["mask"])
    np.testing.assert_array_equal(mask.sum(-1), data["active_rank"].ravel()[data["token"]])


def test_video_file_is_small():
    assert (ROOT / "docs/figures/films.webp").stat().st_size < 2_000_000
