"""The comparison on Meta-World: its cells, and what the judge is asked."""

import json
import sys

import pytest

from lorasp_jax import peft
from lorasp_jax.extras.judge import __main__ as judging
from lorasp_jax.extras.study import results as files
from lorasp_jax.extras.study.progress import describe_config
from lorasp_jax.training.run_folder import MetricsLog, changed_settings
from studies.metaworld import judge, study
from studies.metaworld.tasks import HELD_OUT, SETS
from tests import ROOT
from tests.runs import make_run

STUDY = study.get_study("accelerator")
RESULTS = files.load(ROOT / "studies/metaworld/results.json")


def test_sets_split_the_fifty_tasks():
    assert len(SETS["mt50"]) == 50
    assert sorted(SETS["ml45"] + SETS["ml5"]) == sorted(SETS["mt50"])


def test_every_method_has_three_seeds_on_both_sets():
    names = [cell.name for cell in STUDY.cells]
    for prefix in ("pi0/mt50/", "pi0/ml5/", "smolvla/mt50/", "smolvla/ml5/"):
        assert sum(name.startswith(prefix) for name in names) == 5 * 3
    assert {*names} == RESULTS.keys()


def test_runs_have_the_settings_in_the_results():
    kinds = {"lora_sp": peft.LoRASP, "ada_lora": peft.AdaLoRA, "full": peft.FullFineTuning}
    for cell in STUDY.cells:
        config = cell.config(RESULTS) if callable(cell.config) else cell.config
        recorded = RESULTS[cell.name]["config"]
        assert changed_settings(recorded, describe_config(cell, config)) == ["name"]
        backbone, stage, method, _ = cell.name.split("/")
        assert type(config.peft) is kinds.get(method, peft.LoRA)
        assert config.data.source == (f"data/{study.STAGES[stage].tasks}",)
        base = f"runs/metaworld/{backbone}/ml45/full/s0/base"
        bundled = f"assets/{backbone}_small"
        assert config.model.source == (base if stage == "ml5" else bundled)
        assert bool(cell.source) == (stage == "ml5")


def test_rate_is_that_of_the_best_pilot():
    pilots = study._pilots("pi0/mt50/lora_r16/s0")
    assert {name.split("/")[2] for name in pilots} == {"lora_r64"}
    outcomes = {"reach": "0011"}, {"reach": "1111"}, {"reach": "0111"}
    found = {name: {"outcomes": o} for name, o in zip(pilots, outcomes, strict=True)}
    assert study.best_rate(found, pilots) == 1e-3


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A run whose judge and server write down their options."""
    made = make_run(tmp_path / "run")
    log = MetricsLog(made.folder)
    log.write(1, {"active_rank/vision": 3.25, "active_rank/vision/q_proj": 9.0, "task": 1.0})
    log.close()
    (tmp_path / "python").write_text(
        f"#!{sys.executable}\n"
        "import json, pathlib, sys\n"
        "if sys.argv[2].endswith('serving'):\n"
        "    sys.exit()\n"
        f"pathlib.Path({str(tmp_path)!r}, 'judge.txt').write_text(json.dumps(sys.argv[3:]))\n"
        "tasks = {'door-lock': {'outcomes': [True, False]}}\n"
        "pathlib.Path(sys.argv[-1]).write_text(json.dumps({'tasks': tasks}))\n"
    )
    (tmp_path / "python").chmod(0o755)
    monkeypatch.setenv(judge.PYTHON, str(tmp_path / "python"))
    monkeypatch.setattr(judge.sys, "executable", str(tmp_path / "python"))
    return made


def test_a_policy_is_served_and_judged(run, tmp_path):
    found = judge.judge("ml5", 2, 7, run)
    assert found["outcomes"] == {"door-lock": "10"}
    assert found["active_rank"] == {"vision": 3.25}
    assert 0 < found["trainable_parameters"] < found["total_parameters"]
    options = judging.parser("").parse_args(json.loads((tmp_path / "judge.txt").read_text()))
    assert (options.tasks, options.episodes, options.seed) == ([*HELD_OUT], 2, 7)
    assert options.out == run.folder / "judged.json"
    assert judge.judge("ml5", 2, 7, run) == found  # again, although there is a file
    (tmp_path / "judge.txt").unlink()
    assert judge.judge("ml45", 0, 0, run)["outcomes"] == {}
    assert not (tmp_path / "judge.txt").exists()


def test_failures_are_named(run, monkeypatch):
    monkeypatch.setenv(judge.PYTHON, "false")
    with pytest.raises(ValueError, match="judging failed with exit code 1"):
        judge.judge("ml5", 2, 7, run)
    monkeypatch.delenv(judge.PYTHON)
    with pytest.raises(ValueError, match=judge.PYTHON):
        judge.judge("ml5", 2, 7, run)
