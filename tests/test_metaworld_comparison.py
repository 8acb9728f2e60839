"""Test the comparison on Meta-World: its commands, its jobs and its tables."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from examples.metaworld import compare, page
from examples.metaworld.cells import METHODS, RATES, SEEDS, Cell, cells
from examples.metaworld.tasks import GROUPS, HELD_OUT, SETS
from lorasp_jax import peft
from lorasp_jax.training import overrides
from tests import ROOT

ALL = [*cells(("pi0", "smolvla"))]


def test_sets_split_the_fifty_tasks():
    assert len(SETS["mt50"]) == 50
    assert sorted(SETS["ml45"] + SETS["ml5"]) == sorted(SETS["mt50"])


def test_every_method_has_three_seeds_on_both_sets():
    assert len(ALL) == len({cell.name for cell in ALL}) == 2 * 2 * len(METHODS) * len(SEEDS)


@pytest.mark.parametrize("cell", ALL[::3], ids=lambda cell: cell.name)
def test_train_command_sets_the_run(cell, monkeypatch):
    monkeypatch.chdir(ROOT)
    python, script, *arguments = cell.train(Path("data"), ["--optim.batch-size", "64"])
    assert (python, script) == (sys.executable, "train.py")
    config = overrides.parse([*arguments, "--scale", "accelerator"]).config
    kinds = {
        "lora_sp": peft.LoRASP,
        "ada_lora": peft.AdaLoRA,
        "full": peft.FullFineTuning,
    }
    assert type(config.peft) is kinds.get(cell.method, peft.LoRA)
    rank = {"full": None, "lora_r16": 16}.get(cell.method, 64)
    assert getattr(config.peft, "rank", None) == rank
    assert (config.name, config.seed) == (cell.name, cell.seed)
    assert config.model.backbone == cell.backbone
    assert config.data.source == f"data/{cell.tasks}"
    assert config.optim.learning_rate == RATES[cell.backbone].get(cell.method, 1e-3)
    assert config.optim.batch_size == 64
    base = f"runs/metaworld_{cell.backbone}_ml45_full_s0/base"
    bundled = f"assets/{cell.backbone}_small"
    assert config.model.source == (base if cell.tasks == "ml5" else bundled)


def test_judge_command_names_the_tasks():
    command = Cell("pi0", "ml5", "full", 0).judge("python", 8101, 7, 3)
    text = " ".join(command)
    assert "--server ws://127.0.0.1:8101" in text
    assert f"--tasks {' '.join(HELD_OUT)} --episodes 7 --processes 3" in text


def options(tmp_path, *more):
    (tmp_path / "page.md").write_text(f"Before.\n\n{page.BEGIN}old{page.END}\nAfter.\n")
    files = ["--results", str(tmp_path / "r.json"), "--page", str(tmp_path / "page.md")]
    return [*files, "--judge", "python", *more]


def python(code, *arguments):
    return [sys.executable, "-c", code, *map(str, arguments)]


TRAIN = """
import json, pathlib, sys
run = pathlib.Path(sys.argv[1])
(run / "base").mkdir(parents=True)
ranks = {"active_rank/vision": 3.25, "active_rank/vision/q_proj": 9.0, "loss": 1.0}
(run / "metrics.jsonl").write_text("{}\\n" + json.dumps(ranks) + "\\n")
with open("order.txt", "a") as order: order.write(f"{run.name}\\n")
"""
JUDGE = """
import json, pathlib, sys
outcomes = {task: {"outcomes": [True, False]} for task in sys.argv[2:]}
pathlib.Path(sys.argv[1]).write_text(json.dumps({"tasks": outcomes}))
"""


@pytest.fixture
def stand_ins(tmp_path, monkeypatch):
    """Replace the commands of cells by ones that write the same files at once."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(compare, "POLL", 0.05)
    monkeypatch.setattr(Cell, "train", lambda self, *_: python(TRAIN, self.run))
    monkeypatch.setattr(Cell, "serve", lambda *_: python("import time; time.sleep(60)"))
    monkeypatch.setattr(
        Cell, "judge", lambda self, *_: python(JUDGE, self.judged, *SETS[self.tasks])
    )
    return tmp_path


def test_cells_run_once_and_after_their_base(stand_ins):
    pattern = ["--backbones", "pi0", "--only", "*_ml5_lora_r*", "--jobs", "3"]
    arguments = options(stand_ins, *pattern)
    assert compare.main(arguments) == 0
    order = (stand_ins / "order.txt").read_text().split()
    assert order[0] == "metaworld_pi0_ml45_full_s0"
    assert len(order) == 1 + 2 * len(SEEDS)
    results = json.loads((stand_ins / "r.json").read_text())
    assert results["metaworld_pi0_ml5_lora_r16_s1"] == {
        "active_rank": {"vision": 3.25},
        "outcomes": dict.fromkeys(sorted(HELD_OUT), "10"),
    }
    assert compare.main(arguments) == 0
    assert (stand_ins / "order.txt").read_text().split() == order


def test_a_failed_command_is_named_and_stops_no_other(stand_ins, monkeypatch, capsys):
    def train(self, *_):
        return python("raise SystemExit(3)" if self.seed == 1 else TRAIN, self.run)

    monkeypatch.setattr(Cell, "train", train)
    assert compare.main(options(stand_ins, "--only", "metaworld_pi0_mt50_full_*")) == 1
    assert "training of metaworld_pi0_mt50_full_s1 failed: see" in capsys.readouterr().err
    assert len(json.loads((stand_ins / "r.json").read_text())) == len(SEEDS) - 1


def test_a_server_that_dies_ends_the_judgment(stand_ins, monkeypatch, capsys):
    monkeypatch.setattr(Cell, "serve", lambda *_: python("raise SystemExit(2)"))
    monkeypatch.setattr(Cell, "judge", lambda *_: python("import time; time.sleep(60)"))
    assert compare.main(options(stand_ins, "--only", "metaworld_pi0_mt50_full_s0")) == 1
    assert "serving of metaworld_pi0_mt50_full_s0 failed" in capsys.readouterr().err


def test_jobs_share_the_gpus(stand_ins, monkeypatch):
    names = "CUDA_VISIBLE_DEVICES", "MUJOCO_EGL_DEVICE_ID", "XLA_PYTHON_CLIENT_MEM_FRACTION"
    code = f"import os; values = ' '.join(os.environ[name] for name in {names})\n"
    code += "with open('gpus.txt', 'a') as file: file.write(values + '\\n')\n"
    monkeypatch.setattr(Cell, "train", lambda self, *_: python(code + TRAIN, self.run))
    pattern = ["--backbones", "pi0", "--only", "*_mt50_*", "--jobs", "4", "--gpus", "2"]
    assert compare.main(options(stand_ins, *pattern)) == 0
    lines = set((stand_ins / "gpus.txt").read_text().splitlines())
    assert lines == {"0 0 0.450", "1 1 0.450"}


def policy(right, ranks=None):
    """Return a result that succeeds in the first `right` of ten episodes of each task."""
    outcomes = dict.fromkeys(SETS["mt50"], "1" * right + "0" * (10 - right))
    return {"outcomes": outcomes, "active_rank": ranks or {}}


def synthetic():
    found = {}
    for seed in SEEDS:
        for method, right in {"lora_sp": 6, "lora_r64": 4, "full": 7}.items():
            ranks = {} if method == "full" else {"vision": 10.0 + seed, "action": 3.0}
            found[Cell("pi0", "mt50", method, seed).name] = policy(right, ranks)
    for task in GROUPS["very hard"]:
        found[Cell("pi0", "mt50", "lora_sp", 0).name]["outcomes"][task] = "0" * 10
    found[Cell("pi0", "mt50", "ada_lora", 0).name] = policy(1)
    return found


def test_table_has_groups_means_and_paired_differences():
    rows = [line.split(" | ") for line in page.tables(synthetic()).splitlines() if "|" in line]
    by_label = {row[0].strip("| "): row[1:] for row in rows}
    ours, other = by_label["LoRA-SP, R = 64"], by_label["LoRA, r = 64"]
    assert ours[0] == "11.0, 3.0"
    assert ours[1:5] == ["60.0", "60.0", "60.0", "40.0"]
    assert ours[5].startswith("58.0 [")
    assert ours[6] == "– |"
    assert other[5].startswith("40.0 [")
    assert other[6].startswith("−18.0 [−")
    assert by_label["full fine-tuning"][0] == "–"
    assert by_label["AdaLoRA, mean r = 16"][0] == "1 of 3 seeds so far"
    assert "SmolVLA" not in page.tables(synthetic())


def test_only_the_tables_of_the_page_are_replaced(tmp_path):
    options(tmp_path)
    page.write(synthetic(), tmp_path / "page.md")
    text = (tmp_path / "page.md").read_text()
    assert text.startswith("Before.\n\n")
    assert text.endswith("\nAfter.\n")
    assert "old" not in text
    (tmp_path / "page.md").write_text("nothing")
    with pytest.raises(ValueError, match="lacks the lines"):
        page.write(synthetic(), tmp_path / "page.md")


def test_committed_page_is_made_from_the_committed_results(tmp_path):
    docs = ROOT / "docs"
    results = docs / "metaworld.json"
    copy = tmp_path / "metaworld.md"
    copy.write_text((docs / "metaworld.md").read_text())
    page.write(json.loads(results.read_text()) if results.exists() else {}, copy)
    assert copy.read_text() == (docs / "metaworld.md").read_text()


def test_results_are_written_the_same_way_every_time():
    text = page.dumps(synthetic())
    assert text == page.dumps(dict(reversed(synthetic().items())))
    assert json.loads(text) == synthetic()


def test_help_needs_no_metaworld():
    command = [sys.executable, "-m", "examples.metaworld.compare", "--help"]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert process.returncode == 0
    assert "--judge PYTHON" in process.stdout
