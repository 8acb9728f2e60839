"""The report is updated during a run."""

import io
import json
from types import SimpleNamespace

import pytest
from rich.console import Console

from lorasp_jax.report import callback
from lorasp_jax.training.run_folder import write_json
from tests.report.test_html import folder  # noqa: F401
from tests.runs import RESULTS


@pytest.fixture
def run(folder, monkeypatch):  # noqa: F811
    (folder / "results.json").unlink()
    monkeypatch.setattr(callback, "INTERVAL", 0.0)
    return SimpleNamespace(folder=folder, console=Console(file=io.StringIO(), width=150))


def test_report_is_updated(run):
    report, path = callback.Report(), run.folder / "report.html"
    report.on_start(run)
    assert "step 4 of 4" in path.read_text()
    with (run.folder / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({"step": 5, "task": 0.125}) + "\n")
    report.on_log(run, 5, {})
    assert "step 5 of 4" in path.read_text()
    write_json(run.folder / "results.json", RESULTS)
    report.on_end(run)
    assert "75.0 %" in path.read_text()


def test_a_stopped_run_has_a_final_report(run):
    report, path = callback.Report(), run.folder / "report.html"
    report.on_start(run)
    report.on_stop(run, "the loss was nan")
    assert "The run stopped:</b> the loss was nan" in path.read_text()
    assert f"report up to this step: {path}" in run.console.file.getvalue().replace("\n", "")
    resumed = callback.Report()
    resumed.on_log(run, 6, {})
    assert "Running: step" in path.read_text()


def test_a_report_is_written_only_if_the_latest_is_old(run, monkeypatch):
    report, written = callback.Report(), []
    monkeypatch.setattr(callback, "write_report", written.append)
    monkeypatch.setattr(callback, "INTERVAL", 100.0)
    report.on_start(run)
    report.on_log(run, 2, {})
    assert written == [run.folder]
    report.on_end(run)
    assert written == [run.folder] * 2
