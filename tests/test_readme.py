"""Test the README: its examples run, its results are those of the studies, and it stays short."""

import re

import jax
import numpy as np
import pytest

from lorasp_jax.peft.lora_sp import reference
from tests import ROOT

README = (ROOT / "README.md").read_text()
STUDY, METAWORLD = (
    (ROOT / "studies" / name / "README.md").read_text().replace("\N{NO-BREAK SPACE}", " ")
    for name in ("paper", "metaworld")
)
EXAMPLES = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
MAX_WORDS = 1200
INTERVAL = r"[−+\d.]+ \[[−+\d.]+, [−+\d.]+\]"


def test_readme_is_short():
    assert len(README.split()) <= MAX_WORDS


def test_first_link_of_the_text_is_the_reference():
    link = re.search(r"(?<!\!)\[[^\]!]*\]\(([^)]+)\)", README)
    assert link[1] == "lorasp_jax/peft/lora_sp/reference.py"


def test_equations_are_those_of_the_reference():
    names = {}
    exec(compile(EXAMPLES[0], "README.md", "exec"), names)
    rng = np.random.default_rng(0)
    shapes = {"v": (8, 16), "u": (16, 6), "w1": (8, 4), "b1": (4,), "w2": (4, 16), "b2": (16,)}
    v, u, *router = parts = [rng.normal(size=shape).astype("f") for shape in shapes.values()]
    named = dict(zip(shapes, parts, strict=True))
    params = {"bank": {"v": v, "u": u}, "router": {k: named[k] for k in ("w1", "b1", "w2", "b2")}}
    x, kernel = rng.normal(size=(32, 8)).astype("f"), rng.normal(size=(8, 6)).astype("f")
    expected, _ = jax.jit(reference.lora_sp)(params, x, kernel)
    found = jax.jit(names["lora_sp"])(x, kernel, v, u, *router)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def row(text, label):
    """Return the intervals of the first table row of `text` that starts with `label`."""
    return re.findall(INTERVAL, re.search(rf"^\| {re.escape(label)}.*$", text, re.M)[0])


def minus(interval):
    """Return the interval of the negated difference."""
    value, low, high = (-float(n.replace("−", "-")) for n in re.findall(r"[−+]?[\d.]+", interval))
    return f"{value:+.1f} [{high:+.1f}, {low:+.1f}]".replace("-", "−")


def test_result_table_quotes_both_studies():
    tables = [METAWORLD.partition(f"| {name} |")[2] for name in ("π0", "SmolVLA")]
    own = [row(STUDY.partition(f"**{name}**")[2], "LoRA-SP") for name in ("π0", "SmolVLA")]
    assert row(README, "LoRA, r = R") == [
        *row(STUDY, "1 | LoRA-SP minus"),
        *(minus(row(table, "LoRA, r = 64")[1]) for table in tables),
    ]
    assert row(README, "LoRA, r = mean active rank") == [
        *row(STUDY, "r = LoRA-SP's mean active rank"),
        *(minus(row(table, "LoRA, r = 16")[1]) for table in tables),
    ]
    assert row(README, "full fine-tuning") == [
        *row(STUDY, "2 | LoRA-SP minus"),
        *(minus(row(table, "full fine-tuning")[1]) for table in tables),
    ]
    assert row(README, "itself") == [
        *(means[-1] for means in own),
        *(row(table, "LoRA-SP")[0] for table in tables),
    ]


def test_model_example_runs(capsys):
    exec(compile(EXAMPLES[1], "README.md", "exec"), {})
    assert "lora_sp" in capsys.readouterr().out


def test_simulation_example_compiles():  # running it needs a finished run
    (code,) = EXAMPLES[2:]
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
