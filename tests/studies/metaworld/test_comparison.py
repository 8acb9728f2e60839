"""Test the comparison on Meta-World: its commands, its jobs and its tables."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from lorasp_jax import peft
from lorasp_jax.extras.judge import __main__ as evaluation
from lorasp_jax.extras.serving import __main__ as serving
from lorasp_jax.training import overrides
from studies.metaworld import compare, page
from studies.metaworld.cells import SEEDS, STAGES, Cell, cells
from studies.metaworld.tasks import GROUPS, HELD_OUT, SETS
from tests import ROOT
from tests.studies.metaworld.files import write_judged

ALL = [*cells(("pi0", "smolvla"))]


@pytest.fixture
def place(tmp_path, monkeypatch):
    """Work in a folder with the project's files and without runs."""
    for name in ("configs", "assets", "train.py"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_sets_split_the_fifty_tasks():
    assert len(SETS["mt50"]) == 50
    assert sorted(SETS["ml45"] + SETS["ml5"]) == sorted(SETS["mt50"])


def test_every_method_has_three_seeds_on_both_sets():
    names = [cell.name for cell in ALL]
    assert len(names) == len(set(names))
    for backbone in ("pi0", "smolvla"):
        for stage in ("mt50", "ml5"):
            of_stage = [n for n in names if n.startswith(f"metaworld_{backbone}_{stage}_")]
            assert len(of_stage) == 5 * 3


def test_cells_come_after_those_that_they_need():
    seen = set()
    for cell in ALL:
        assert seen.issuperset(cell.needs)
        seen.add(cell)


def test_rate_is_that_of_the_best_pilot():
    cell = Cell("pi0", "mt50", "lora_r16", 1)
    results = {pilot.name: policy(n) for pilot, n in zip(cell.pilots, (2, 4, 3), strict=True)}
    assert {pilot.method for pilot in cell.pilots} == {"lora_r64"}
    assert cell.rate(results) == cell.pilots[1].pilot_rate == 1e-3
    assert cell.pilots[2].rate({}) == 3e-3


CHECKED = [cell for cell in ALL if cell.seed in (1, 1000)]


@pytest.mark.parametrize("cell", CHECKED, ids=lambda cell: cell.name)
def test_train_command_sets_the_run(cell, place):
    python, script, *arguments = cell.train(Path("data"), 5e-4)
    assert (python, script) == (sys.executable, "train.py")
    config = overrides.parse(arguments).config
    kinds = {"lora_sp": peft.LoRASP, "ada_lora": peft.AdaLoRA, "full": peft.FullFineTuning}
    assert type(config.peft) is kinds.get(cell.method, peft.LoRA)
    rank = {"full": None, "lora_r16": 16}.get(cell.method, 64)
    assert getattr(config.peft, "rank", None) == rank
    assert (config.name, config.seed) == (cell.name, cell.seed)
    assert (config.model.backbone, config.model.size) == (cell.backbone, "small")
    assert config.data.source == f"data/{STAGES[cell.stage].tasks}"
    assert config.optim.steps == STAGES[cell.stage].steps
    assert config.optim.learning_rate == 5e-4
    base = f"runs/metaworld_{cell.backbone}_ml45_full_s0/base"
    bundled = f"assets/{cell.backbone}_small"
    assert config.model.source == (base if cell.stage == "ml5" else bundled)


def test_serve_and_judge_commands_fit_their_parsers():
    cell = Cell("pi0", "ml5", "full", 0)
    *_, module = cell.serve(8101)[:3]
    served = serving.parser("").parse_args(cell.serve(8101)[3:])
    judged = evaluation.parser("").parse_args(cell.judge("python", 8101, 3)[3:])
    assert module == "lorasp_jax.extras.serving"
    assert served.policy == [str(cell.run)]
    assert judged.server == f"ws://{served.host}:{served.port}"
    assert (judged.tasks, judged.episodes, judged.processes) == ([*HELD_OUT], 10, 3)
    assert judged.out == cell.judged


@pytest.mark.parametrize("wrong", [{"episodes": 3}, {"seed": 7}])
def test_other_episodes_are_refused(wrong, place):
    cell = Cell("pi0", "ml5", "full", 0)
    write_judged(cell, 1, **wrong)
    with pytest.raises(ValueError, match=r"judged.json has other tasks or episodes: delete it"):
        cell.outcomes()


def options(folder, *more):
    (folder / "page.md").write_text(f"Before.\n\n{page.BEGIN}old{page.END}\nAfter.\n")
    files = ["--results", str(folder / "r.json"), "--page", str(folder / "page.md")]
    return [*files, "--judge", sys.executable, *more]


def python(code, *arguments):
    return [sys.executable, "-c", code, *map(str, arguments)]


HEAD = f"import os, sys, time; sys.path.insert(0, {str(ROOT)!r})\n"
TRAIN = "with open('order.txt', 'a') as file: file.write(sys.argv[1] + '\\n')\n"
JUDGE = "from studies.metaworld.cells import cells; from tests.studies.metaworld.files import *\n"
JUDGE += "every = cells(('pi0', 'smolvla'))\n"
JUDGE += "write_judged(next(cell for cell in every if cell.name == sys.argv[1]), 1)\n"
SLEEP = "time.sleep(60)\n"


@pytest.fixture
def stand_ins(place, monkeypatch):
    """Replace the commands of cells by ones that leave the same files at once."""
    monkeypatch.setattr(compare, "POLL", 0.05)
    monkeypatch.setattr(Cell, "train", lambda self, *_: python(HEAD + TRAIN, self.name))
    monkeypatch.setattr(Cell, "serve", lambda *_: python(HEAD + SLEEP))
    monkeypatch.setattr(Cell, "judge", lambda self, *_: python(HEAD + JUDGE, self.name))
    return place


def trained(folder):
    return (folder / "order.txt").read_text().split()


def test_cells_run_once_and_after_those_that_they_need(stand_ins):
    arguments = options(stand_ins, "--only", "metaworld_pi0_ml5_full_*", "--jobs", "2")
    assert compare.main(arguments) == 0
    order = trained(stand_ins)
    assert sorted(order[:3]) == sorted(cell.name for cell in Cell("pi0", "ml5", "full", 0).pilots)
    assert order[3] == "metaworld_pi0_ml45_full_s0"
    assert len(order) == 3 + 1 + len(SEEDS)
    results = json.loads((stand_ins / "r.json").read_text())
    assert results["metaworld_pi0_ml5_full_s1"] == {
        "active_rank": {"vision": 3.25},
        "outcomes": dict.fromkeys(sorted(HELD_OUT), "1" + "0" * 9),
        "rate": 0.5,
        "trainable": 0.25,
    }
    shutil.rmtree("runs")  # the results are enough
    assert compare.main(arguments) == 0
    assert trained(stand_ins) == order


def test_failures_are_named_and_stop_no_other(stand_ins, monkeypatch, capsys):
    def train(self, *_):
        return python("raise SystemExit(3)" if self.pilot_rate == 1e-3 else HEAD + TRAIN, self.name)

    monkeypatch.setattr(Cell, "train", train)
    assert compare.main(options(stand_ins, "--only", "metaworld_pi0_mt50_full_s0")) == 1
    errors = capsys.readouterr().err
    assert "training of metaworld_pi0_pilot_full_0.001 failed: see" in errors
    assert "metaworld_pi0_mt50_full_s0 needs a policy that failed" in errors
    assert len(json.loads((stand_ins / "r.json").read_text())) == 2


def test_a_server_that_dies_ends_the_judgment(stand_ins, monkeypatch, capsys):
    monkeypatch.setattr(Cell, "serve", lambda *_: python("raise SystemExit(2)"))
    monkeypatch.setattr(Cell, "judge", lambda *_: python(HEAD + SLEEP))
    only = "metaworld_pi0_pilot_full_0.001"
    assert compare.main(options(stand_ins, "--only", only)) == 1
    assert f"serving of {only} failed" in capsys.readouterr().err


def test_a_damaged_file_is_named_and_hides_no_other(stand_ins, capsys):
    first, *others = Cell("pi0", "mt50", "full", 0).pilots
    write_judged(first, 1)
    first.judged.write_text("{")
    arguments = options(stand_ins, "--only", "metaworld_pi0_pilot_full*")
    assert compare.main(arguments) == 1
    assert "0.0003/judged.json is damaged, delete it" in capsys.readouterr().err
    results = json.loads((stand_ins / "r.json").read_text())
    assert results.keys() == {pilot.name for pilot in others}


def test_a_judged_policy_is_not_trained_again(stand_ins):
    for pilot in Cell("pi0", "mt50", "full", 0).pilots:
        write_judged(pilot, 2)
    assert compare.main(options(stand_ins, "--only", "metaworld_pi0_pilot_full*")) == 0
    assert not (stand_ins / "order.txt").exists()
    assert len(json.loads((stand_ins / "r.json").read_text())) == 3


def test_damaged_results_are_named_in_a_sentence(stand_ins, capsys):
    arguments = options(stand_ins, "--no-run")
    (stand_ins / "r.json").write_text("{")
    assert compare.main(arguments) == 2
    assert capsys.readouterr().err.startswith(f"error: {stand_ins / 'r.json'} is damaged")


def test_a_missing_judge_is_refused_at_once(stand_ins, capsys):
    with pytest.raises(SystemExit):
        compare.main(options(stand_ins, "--judge", "nowhere/python"))
    assert "--judge must be the Python with metaworld, got 'nowhere/python'" in (
        capsys.readouterr().err
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_all_processes(stand_ins, monkeypatch, number):
    code = HEAD + "with open('pids.txt', 'a') as file: file.write(f'{os.getpid()}\\n')\n" + SLEEP
    monkeypatch.setattr(Cell, "train", lambda *_: python(code))

    def interrupt():
        while not (stand_ins / "pids.txt").exists():
            time.sleep(0.05)
        os.kill(os.getpid(), number)

    thread = threading.Thread(target=interrupt)
    thread.start()
    assert compare.main(options(stand_ins, "--only", "*pilot_full*", "--jobs", "2")) == 130
    thread.join()
    pids = (stand_ins / "pids.txt").read_text().split()
    assert len(pids) <= 2
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)


@pytest.mark.parametrize(
    ("jobs", "visible", "expected"),
    [
        ("4", "", {"0 0.450", "1 0.450"}),
        ("3", "", {"0 0.450", "1 0.450"}),
        ("2", "5,7", {"5 0.900", "7 0.900"}),
    ],
)
def test_jobs_share_the_gpus(stand_ins, monkeypatch, jobs, visible, expected):
    names = "CUDA_VISIBLE_DEVICES", "XLA_PYTHON_CLIENT_MEM_FRACTION"
    code = f"values = ' '.join(os.environ[name] for name in {names})\n"
    code += "with open('gpus.txt', 'a') as file: file.write(values + '\\n')\n"
    monkeypatch.setattr(Cell, "train", lambda self, *_: python(HEAD + code, self.name))
    monkeypatch.delenv("XLA_PYTHON_CLIENT_MEM_FRACTION", raising=False)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    pattern = ["--only", "metaworld_pi0_pilot*", "--jobs", jobs, "--gpus", "2"]
    assert compare.main(options(stand_ins, *pattern)) == 0
    assert set((stand_ins / "gpus.txt").read_text().splitlines()) == expected


def policy(right, ranks=None):
    """Return a result that succeeds in the first `right` of ten episodes of each task."""
    outcomes = dict.fromkeys(SETS["mt50"], "1" * right + "0" * (10 - right))
    return {"outcomes": outcomes, "active_rank": ranks or {}, "rate": 1e-3, "trainable": 0.25}


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


def rows_by_label(table):
    """Return the last cell of each method's row."""
    rows = [line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("| ")]
    return {row[0]: row[-1] for row in rows if re.match(r"[−+][\d.]+ \[", row[-1])}


def excludes_zero(difference):
    low, high = re.findall(r"[−+]", difference.partition("[")[2])
    return low == high


def test_table_has_groups_means_and_paired_differences():
    rows = [line.split(" | ") for line in page.tables(synthetic()).splitlines() if "|" in line]
    by_label = {row[0].strip("| "): row[1:] for row in rows}
    ours, other = by_label["LoRA-SP, R = 64"], by_label["LoRA, r = 64"]
    assert ours[:3] == ["0.001", "25.0 %", "11.0, 3.0"]
    assert ours[3:7] == ["60.0", "60.0", "60.0", "40.0"]
    assert ours[7].startswith("58.0 [")
    assert ours[8] == "– |"
    assert other[7].startswith("40.0 [")
    assert other[8].startswith("−18.0 [−")
    assert by_label["full fine-tuning"][2] == "–"
    assert by_label["AdaLoRA, 64 cut to a mean of 16"][-1] == "1 of 3 seeds so far |"
    assert len({len(row) for row in rows}) == 1
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


def test_findings_quote_the_tables():
    text = (ROOT / "docs" / "metaworld.md").read_text()
    findings, _, tables = text.partition("### What was found")[2].partition(page.BEGIN)
    findings = " ".join(findings.split())
    fifty, _, five = tables.partition(page.TITLES["ml5"])
    pi0, smolvla = (rows_by_label(part) for part in fifty.split("| SmolVLA |"))
    said = {
        "LoRA, r = 64": ("−4.6", "+0.7", "4.6 points more than LoRA with r = 64", "cannot be told"),
        "LoRA, r = 16": ("−5.5", "−4.6", "5.5 more than LoRA with r = 16", "r = 16 (−4.6)"),
        "AdaLoRA": ("−4.3", "−4.9", "4.3 more than AdaLoRA", "AdaLoRA (−4.9)"),
        "full fine-tuning": ("−1.7", "−6.1", "cannot be told", "full fine-tuning (−6.1)"),
    }
    for method, (of_pi0, of_smolvla, *texts) in said.items():
        assert all(part in findings for part in texts)
        for rows, value in ((pi0, of_pi0), (smolvla, of_smolvla)):
            ((label, difference),) = [r for r in rows.items() if r[0].startswith(method)]
            assert difference.startswith(value), label
            assert excludes_zero(difference) == (value not in ("+0.7", "−1.7"))
    leads = [seed_mean("lora_sp", s) - seed_mean("lora_r64", s) for s in range(3)]
    assert "(by seed {:.1f}, {:.1f} and {:.1f})".format(*leads) in findings
    assert "LoRA-SP succeeds in 52.1 %" in findings
    assert "| 52.1 [" in fifty
    differences = [d for part in five.split("| SmolVLA |") for d in rows_by_label(part).values()]
    assert len(differences) == 8
    assert not any(map(excludes_zero, differences))


def seed_mean(method, seed):
    """Return the mean success [%] over fifty tasks of one π0."""
    results = json.loads((ROOT / "docs" / "metaworld.json").read_text())
    outcomes = results[f"metaworld_pi0_mt50_{method}_s{seed}"]["outcomes"].values()
    return 100 * np.mean([episode == "1" for task in outcomes for episode in task])


def test_results_are_written_the_same_way_every_time():
    text = page.dumps(synthetic())
    assert text == page.dumps(dict(reversed(synthetic().items())))
    assert json.loads(text) == synthetic()


def test_help_needs_no_metaworld():
    command = [sys.executable, "-m", "studies.metaworld.compare", "--help"]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert process.returncode == 0
    assert "--judge PYTHON" in process.stdout
