import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from lorasp_jax.extras.study import page, progress, results
from lorasp_jax.extras.study.study import select
from tests import ROOT
from tests.extras.study import fakes
from tests.extras.study.conftest import FILE, InProcess
from tests.extras.study.fakes import NAMES, failing, ran, study, without


def test_a_study_runs_once(start, folder):
    code, text = start()
    assert code == 0
    assert "fake: 6 finished" in text
    assert sorted(results.load(folder / "results.json")) == sorted(NAMES)
    before = (folder / "results.json").read_bytes()
    assert start()[0] == 0
    assert len(ran(folder)) == 6
    assert (folder / "results.json").read_bytes() == before


def test_parts_of_a_study(start, folder):
    code, text = start("--only", "lora/*")
    assert (code, ran(folder)) == (0, [])
    assert "lora/s0: waiting for sp/s0 (runnable), sp/s1 (runnable)" in text
    assert "waiting for" not in start("--only", "lora/*", "--no-run")[1]
    assert start("--only", "sp/*")[0] == 0
    assert ran(folder) == ["sp/s0", "sp/s1"]
    assert start("--shard", "2/2")[0] == 0
    assert ran(folder)[2:] == ["lora/s0", "lora/s1", "cut/s0"]
    assert start("--shard", "1/2")[0] == 0
    assert ran(folder)[5:] == ["lr"]


def test_a_failed_cell_is_reported_and_tried_again(start, folder, monkeypatch):
    monkeypatch.setattr(InProcess, "run_cell", staticmethod(failing("sp/s1")))
    code, text = start()
    assert code == 2
    assert "sp/s1: failed RuntimeError: boom" in text
    assert "fake: 2 finished, 3 waiting, 1 failed" in text
    monkeypatch.setattr(InProcess, "run_cell", staticmethod(fakes.run))
    assert start()[0] == 0
    assert sorted(ran(folder)) == sorted(NAMES)


def test_a_damaged_cell_is_reported(start, folder):
    start()
    (folder / "lr/cell.json").write_text("{")
    code, text = start()
    assert code == 2
    assert re.search(r"lr: damaged \S+/lr/cell.json", text)
    assert "5 finished, 1 damaged" in text
    assert sorted(results.load(folder / "results.json")) == sorted({*NAMES} - {"lr"})


def test_dry_run(start, folder):
    code, text = start("--dry-run", "--only", "lora/*", "s*")
    assert code == 0
    assert "sp/s0: runnable" in text
    assert "lora/s0: waiting for sp/s0" in text
    assert not folder.exists()
    start()
    code, text = start("--dry-run")
    assert "cut/s0: finished" in text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--only", "sp/*", "x*"], "error: no cell of fake matches 'x*'; the first cell is sp/s0"),
        (["--shard", "3/2"], "must be I/N with 1 <= I <= N, got '3/2'"),
        (["--shard", "1"], "must be I/N with 1 <= I <= N, got '1'"),
        (["--jobs", "0"], "must be a positive whole number, got '0'"),
        (["--config", "missing.py"], "error: config missing.py does not exist"),
    ],
)
def test_bad_options(start, options, message, capsys):
    try:
        code, text = start(*options)
    except SystemExit as error:
        code, text = error.code, re.sub(r"\s+", " ", capsys.readouterr().err)
    assert code == 2
    assert message in text


def test_every_cell_is_in_one_shard():
    shards = [select(study(), ["*"], (index, 3)) for index in (1, 2, 3)]
    assert sorted(shards[0] + shards[1] + shards[2]) == sorted(NAMES)
    assert shards[1] == ["lora/s0", "lora/s1", "cut/s0"]


def test_a_file_must_return_a_study(tmp_path):
    (tmp_path / "a.py").write_text("def get_study(scale): return 7\n")
    with pytest.raises(ValueError, match=r"get_study in .*a\.py must return a Study, got int"):
        results.load_study(tmp_path / "a.py", "smoke")


def test_a_finished_study_loads_no_model_and_no_simulation(start, tmp_path):
    start()
    program = (
        "import json, sys; from lorasp_jax.extras.study.__main__ import main; code = main({}); "
    )
    program += "print(json.dumps([code, [m for m in {} if m in sys.modules]]))"
    slow = ["mujoco", "lorasp_jax.models", "orbax", "matplotlib", "tyro", "scipy"]
    arguments = ["--config", str(tmp_path / "study.py"), "--out", str(tmp_path / "runs")]
    process = subprocess.run(
        [sys.executable, "-c", program.format(arguments, slow)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(process.stdout.splitlines()[-1]) == [0, []]


def test_a_study_starts_from_a_file_of_results(start, folder, committed):
    before = committed.read_bytes()
    for options in ([], ["--no-run"]):
        code, text = start("--results", str(committed), *options)
        assert (code, ran(folder)) == (0, [])
        assert "fake: 6 finished" in text
        assert committed.read_bytes() == before
    without(committed, "lora/s1", "lr")
    assert "4 finished" in start("--results", str(committed), "--no-run")[1]
    assert "4 finished" in start("--results", str(committed), "--dry-run")[1]
    assert ran(folder) == []
    start("--results", str(committed))
    assert ran(folder) == ["lora/s1", "lr"]
    assert committed.read_bytes() == before
    assert start()[0] == 0  # without the file, the others run
    assert sorted(ran(folder)) == sorted(NAMES)


def test_a_derived_cell_gets_its_source_again(start, folder, committed):
    before = committed.read_bytes()
    without(committed, "cut/s0")
    start("--results", str(committed))
    assert ran(folder) == ["lora/s0", "cut/s0"]
    assert committed.read_bytes() == before


def test_a_source_that_fails_again_keeps_its_results(start, folder, committed, monkeypatch):
    without(committed, "cut/s0")
    before = committed.read_bytes()
    monkeypatch.setattr(InProcess, "run_cell", staticmethod(failing("lora/s0")))
    code, text = start("--results", str(committed))
    assert code == 2
    assert "lora/s0: failed RuntimeError: boom" in text
    assert "cut/s0: waiting for lora/s0 (failed)" in text
    assert committed.read_bytes() == before


def test_no_result_of_the_file_is_lost(start, folder, committed, tmp_path):
    before = committed.read_bytes()
    (folder / "lr").mkdir(parents=True)
    (folder / "lr/cell.json").write_text("{")
    code, text = start("--results", str(committed))
    assert code == 2
    assert "study.json is left as it is: it has results of lr, which is damaged" in text
    shutil.rmtree(folder)
    changed = FILE.replace("study()", 'study(**{"lr": fakes.CONFIG})').replace(
        "from tests.extras.study.fakes import study",
        "from tests.extras.study import fakes\nstudy = fakes.study",
    )
    (tmp_path / "study.py").write_text(changed)
    code, text = start("--results", str(committed))
    assert code == 2
    assert "lr: changed it was run with other optim.steps" in text
    assert committed.read_bytes() == before


def test_results_of_another_study_are_refused(start, committed):
    results.write(committed, "other", {})
    code, text = start("--results", str(committed))
    assert code == 2
    assert "has the results of other, not of fake" in text
    committed.unlink()
    assert "study.json is missing" in start("--results", str(committed))[1]


def test_the_readme_beside_the_results_gets_the_tables(start, committed, tmp_path):
    page = 'page=lambda study, results, folder: {"count": f"{len(results)} cells"}'
    code = f"import dataclasses\n{FILE}".replace("study()", f"dataclasses.replace(study(), {page})")
    (tmp_path / "study.py").write_text(code)
    readme = committed.with_name("README.md")
    start("--results", str(committed), "--no-run")
    assert not readme.exists()
    text = "Before.\n<!-- begin: count -->\n{}<!-- end -->\nAfter.\n"
    readme.write_text(text.format("old\n"))
    without(committed, "lr")
    start("--results", str(committed), "--no-run")  # not all cells are finished
    assert readme.read_text() == text.format("old\n")
    (tmp_path / "study.py").write_text(code.replace(page, f"{page}, partial=True"))
    start("--results", str(committed), "--no-run")
    assert readme.read_text() == text.format("\n5 cells\n")
    start("--results", str(committed))
    assert readme.read_text() == text.format("\n6 cells\n")
    readme.write_text(text.format("").replace("count", "other"))
    assert "different parts" in start("--results", str(committed))[1]


def test_texts_are_utf8_whatever_the_locale(tmp_path, monkeypatch):
    def read(path, encoding="latin-1"):
        return path.read_bytes().decode(encoding)

    readme, mark = tmp_path / "README.md", "π0 – ü\n<!-- begin: a -->\n{}<!-- end -->\n"
    readme.write_text(mark.format(""), "utf-8")
    progress.record_failure(tmp_path, "no π0", "")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "read_text", read)
        page.fill(readme, {"a": "−"})
        assert progress._failure(tmp_path) == "no π0"
    assert readme.read_text("utf-8") == mark.format("\n−\n")
