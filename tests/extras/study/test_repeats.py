"""Finished cells run again beside their results."""

import dataclasses
import shutil

import pytest

from lorasp_jax.extras.study import repeats, results
from lorasp_jax.training.run_folder import to_json
from tests.extras.study import fakes
from tests.extras.study.conftest import InProcess
from tests.extras.study.fakes import CONFIG, NAMES, failing, ran, study


def run_again(job):
    """Like `fakes.run`, but succeed once more in every round of repeats."""
    result, parts = fakes.run(job), job.study_folder.parts
    more = int(parts[-1]) if "repeats" in parts else 0
    outcomes = {task: "1" * more + text[more:] for task, text in result["outcomes"].items()}
    origin = {"device": f"device {more}", "commit": "abc" * (1 - more), "code": "def"}
    return {**result, "outcomes": outcomes, "provenance": origin, "seconds": {"total": more + 0.1}}


@pytest.fixture(autouse=True)
def _run_again(monkeypatch, start):
    monkeypatch.setattr(InProcess, "run_cell", staticmethod(run_again))


def counts(file):
    found = {name: len(cell.get("repeats", [])) for name, cell in results.load(file).items()}
    return {name: count for name, count in found.items() if count}


def test_every_repeat_is_kept_beside_the_first_result(start, folder, committed):
    first = results.load(committed)
    for count in (1, 2):
        code, text = start("--results", str(committed), "--rerun", "sp/s0", "lr")
        assert code == 0
        assert "fake: 2 finished" in text
        assert ran(folder / f"repeats/{count}") == ["sp/s0", "lr"]
        assert counts(committed) == {"sp/s0": count, "lr": count}
    assert ran(folder) == []
    found = results.load(committed)
    for again in found["lr"]["repeats"]:
        assert "config" not in again
        assert again["outcomes"] != first["lr"]["outcomes"]
    for result in found.values():
        result.pop("repeats", None)
    assert found == first

    before = committed.read_bytes()
    shutil.rmtree(folder)  # the file has them all
    start("--results", str(committed), "--no-run")
    assert committed.read_bytes() == before
    start("--results", str(committed), "--rerun", "lr")
    assert counts(committed) == {"sp/s0": 2, "lr": 2}  # the first one again


def test_a_derived_cell_is_repeated_from_a_repeat_of_its_source(start, folder):
    start()
    with_first = results.load(folder / "results.json")["sp/s0"]["active_rank"]
    start("--rerun", "cut/*")
    assert ran(folder / "repeats/1") == ["lora/s0", "cut/s0"]
    again = results.load(folder / "results.json")
    assert again["sp/s0"]["active_rank"] == with_first
    assert counts(folder / "results.json") == {"lora/s0": 1, "cut/s0": 1}
    assert len(ran(folder)) == len(NAMES)


def test_settings_stay_those_of_the_first_runs(start, folder):
    """LoRA's rank comes from the active rank of other cells, which their repeats may change."""
    start()
    first, seen = results.load(folder / "results.json"), {}
    cut = dataclasses.replace(study()["cut/s0"], transform=lambda _, found, __: seen.update(found))
    whole = dataclasses.replace(study(), cells=(*study().cells[:-1], cut), finished=first)
    again = repeats.load(lambda: whole, folder)
    assert again["lora/s0"].config.peft == fakes.same_rank(first).peft
    assert {cell.name for cell in again.cells if cell.needs} == {"cut/s0"}
    again["cut/s0"].transform(None, {"lora/s0": "its repeat"}, None)
    assert seen == {"lora/s0": "its repeat", "sp/s0": first["sp/s0"]}


def test_a_stopped_round_goes_on(start, folder, monkeypatch):
    start()
    monkeypatch.setattr(InProcess, "run_cell", staticmethod(failing("lr")))
    code, text = start("--rerun", "sp/*", "lr")
    assert code == 2
    assert "lr: failed RuntimeError: boom" in text
    monkeypatch.setattr(InProcess, "run_cell", staticmethod(run_again))
    start("--rerun", "sp/*", "lr")
    assert sorted(ran(folder / "repeats/1")) == ["lr", "sp/s0", "sp/s1"]
    assert not (folder / "repeats/2").exists()
    assert counts(folder / "results.json") == {"sp/s0": 1, "sp/s1": 1, "lr": 1}


def test_runs_are_compared(start, folder):
    start()
    start("--rerun", "sp/s0")
    text = start("--rerun", "sp/s0")[1]
    first = results.load(folder / "results.json")["sp/s0"]["outcomes"]["press"]
    assert "sp/s0: repeat 1 (device 1, code def) minus first run (device 0, abc)" in text
    gained = 100 * (2 - first[:2].count("1")) / 16
    assert f"press +{gained:.1f} [" in text.split("repeat 2")[1]
    assert "mean +" in text
    assert "points of mean success, 2 degrees of freedom" in text
    assert start("--rerun", "sp/s0", "--no-run")[1].count("minus first run") == 2


def test_what_cannot_run_again_is_refused(start):
    code, text = start("--rerun", "lr")
    assert code == 2
    assert "none of lr can run again: it must be finished" in text
    with pytest.raises(SystemExit):
        start("--rerun", "lr", "--only", "lr")


def test_repeats_with_other_settings_are_not_counted(tmp_path):
    config = to_json(CONFIG)
    result = {"config": config, "outcomes": {"press": "01"}}
    earlier = {**result, "config": {**config, "seed": 9}, "repeats": [{"outcomes": {}}]}
    found = repeats.collect({"a": result}, {"a": earlier}, tmp_path)
    assert found == {"a": result}
    found = repeats.collect({"a": result}, {"a": {**earlier, "config": config}}, tmp_path)
    assert found["a"]["repeats"] == [{"outcomes": {}}]
