"""Test the command that compares this project with other programs, with stand-ins for them."""

import argparse
import json
import os
import stat
import sys
import types

import jax
import pytest

from benchmarks.peers import __main__ as peers
from benchmarks.peers import cases, report, worker
from benchmarks.peers.worker import Job

FAKE = """#!{python}
import json, sys
arguments = dict(zip(sys.argv[3::2], sys.argv[4::2]))
{body}
rows = [{{"item": "batch 2", "median_s": {seconds}, "samples": 2}}]
result = {{"device": "cpu", "versions": {{"openpi": "1.2"}}, "rows": rows}}
open(arguments["--result"], "w").write(json.dumps(result))
"""


def job(table, variant="none", **options):
    size, steps = options.pop("size", "tiny"), options.pop("steps", 2)
    return Job(table, variant, size, 1, steps, compile=False, denoise_steps=[3, 10])


def interpreter(folder, name, body="", seconds=1.0):
    """Write a stand-in for a program's interpreter, which answers at once."""
    path = folder / name
    path.write_text(FAKE.format(python=sys.executable, body=body, seconds=seconds))
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


def run(tmp_path, capsys, *arguments):
    """Run the command on the sampling table of pi0; return exit status, file and output."""
    out = tmp_path / "out.json"
    options = ["--out", str(out), "--tables", "pi0-sample", "--size", "tiny", *arguments]
    status = peers.main(options)
    return status, json.loads(out.read_text()), capsys.readouterr().out


@pytest.fixture
def fakes(tmp_path):
    def make(**programs):
        values = [f"{name}={interpreter(tmp_path, name, **o)}" for name, o in programs.items()]
        return ["--python", *values]

    return make


def test_ratios_refer_to_the_first_program(tmp_path, capsys, fakes):
    command = fakes(ours={"seconds": 0.5}, openpi={"seconds": 2.0})
    status, content, printed = run(tmp_path, capsys, *command)
    lines = content["tables"]["pi0-sample"]
    assert status == 0
    assert [line["program"] for line in lines] == ["ours", "ours", "openpi", "ours"]
    assert [line["ratio"] for line in lines] == [1, 1, 4, 1]
    assert [line["samples/s"] for line in lines] == [4, 4, 1, 4]
    assert content["versions"]["openpi"] == {"openpi": "1.2"}
    assert "openpi: openpi 1.2" in printed


@pytest.mark.parametrize("body", ["import nothing_of_this_name", None])
def test_missing_programs_are_named_and_do_not_stop_others(body, tmp_path, capsys, fakes):
    command = fakes(ours={}, openpi={"body": body or ""})
    if body is None:
        (tmp_path / "openpi").unlink()
    status, content, printed = run(tmp_path, capsys, *command)
    assert status == 0
    assert [line["program"] for line in content["tables"]["pi0-sample"]] == ["ours"] * 3
    assert "to install: pip install --no-deps git+https://github.com/Phys" in printed


def test_failures_are_reported_and_give_an_exit_status(tmp_path, capsys, fakes):
    command = fakes(ours={}, openpi={"body": "raise ValueError('out of memory')"})
    status, content, printed = run(tmp_path, capsys, *command)
    assert status == 1
    assert content["results"][2]["error"] == "ValueError: out of memory"
    assert "to install" not in printed


def test_a_failed_reference_leaves_no_ratio(tmp_path, capsys, fakes):
    command = fakes(ours={"body": "sys.exit(3)"}, openpi={})
    status, content, _ = run(tmp_path, capsys, *command)
    assert status == 1
    assert [line["ratio"] for line in content["tables"]["pi0-sample"]] == [""]
    assert content["results"][0]["error"] == "exit status 3"


@pytest.mark.slow
def test_ours_runs_as_a_process(tmp_path, capsys, fakes):
    """The real worker, beside a stand-in."""
    command = ["--warmup", "1", "--steps", "2", "--once", "--denoise-steps", "2", "10"]
    command += fakes(openpi={})
    status, content, _ = run(tmp_path, capsys, *command)
    assert status == 0
    result = content["results"][0]
    items = [f"batch {b}, {n} denoising steps" for b in (1, 2) for n in (2, 10)]
    assert [row["item"] for row in result["rows"]] == items
    assert result["versions"]["jax"] == jax.__version__


@pytest.mark.parametrize("text", ["openpi", "openpi=", "someone=python"])
def test_options_name_a_program(text):
    with pytest.raises(argparse.ArgumentTypeError, match="PROGRAM=VALUE"):
        peers.named(text)


def test_paths_come_before_the_search_path(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "others")
    options = argparse.Namespace(path=[("openpi", "a:b")], size="tiny")
    openpi, qwix = (
        peers.environment(cases.Case("stack", name, ""), options, "cache")
        for name in ("openpi", "qwix")
    )
    assert openpi["PYTHONPATH"] == os.pathsep.join(("a:b", "others"))
    assert qwix["PYTHONPATH"] == "others"


def test_compilation_that_is_measured_is_not_cached():
    options = argparse.Namespace(path=[], size="base")
    cached = {
        table: "JAX_COMPILATION_CACHE_DIR"
        in peers.environment(cases.Case(table, "qwix", ""), options, "cache")
        for table in cases.TABLES
    }
    assert cached == {table: not table.startswith("stack") for table in cases.TABLES} | {
        name: True for name in cached if "JAX_COMPILATION_CACHE_DIR" in os.environ
    }


def test_times_are_medians_after_warm_up(monkeypatch):
    seconds, clock = iter([0.5, 0.0, 0.02, 0.3]), [0.0]
    monkeypatch.setattr(worker, "time", types.SimpleNamespace(perf_counter=lambda: sum(clock)))
    row = worker.timed("x", lambda: next(seconds), clock.append, job("pi0-sample", steps=3))
    assert row["median_s"] == pytest.approx(0.02, abs=0.015)
    assert row["min_s"] < 0.01
    assert 0.3 <= row["max_s"] < 0.5


def test_ratios_use_the_mean_of_both_reference_runs():
    def result(program, seconds):
        rows = [{"item": "batch 1", "median_s": seconds}]
        return {"table": "pi0-sample", "program": program, "variant": "none", "rows": rows}

    lines = report.rows(
        [result("ours", 1.0), result("openpi", 4.0), result("ours", 3.0)], "pi0-sample"
    )
    assert [line["ratio"] for line in lines] == [0.5, 2.0, 1.5]


@pytest.mark.parametrize(
    ("stderr", "expected"),
    [
        ("Traceback\n  File\nValueError: no\n--------\nJAX has removed frames", "ValueError: no"),
        ("killed", "killed"),
        ("", "exit status 9"),
        ("warning: x\nModuleNotFoundError: No module named 'a'\n", "ModuleNotFoundError: No mo"),
    ],
)
def test_the_cause_is_the_line_with_the_error(stderr, expected):
    assert peers.cause(stderr, 9).startswith(expected)


def test_versions_name_the_commit_of_a_repository(tmp_path, monkeypatch):
    folder = tmp_path / "someone-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: someone\nVersion: 1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert worker.version("someone") == "1.0"
    origin = {"url": "https://host/x", "vcs_info": {"vcs": "git", "commit_id": "15a9616a00943a"}}
    (folder / "direct_url.json").write_text(json.dumps(origin))
    assert worker.version("someone") == "1.0 (15a9616a)"
    assert worker.version("not-installed") == "unknown"
    monkeypatch.setitem(sys.modules, "checkout", types.SimpleNamespace(__version__="0.2"))
    assert worker.version("checkout") == "0.2"


@pytest.mark.parametrize("program", ["openpi", "lerobot", "qwix", "peft"])
def test_installed_programs_run(program, tmp_path, capsys):
    """Each program that happens to be installed beside this one."""
    pytest.importorskip(program)
    tables = [t for t, entries in cases.TABLES.items() if program in dict(entries)]
    out = tmp_path / "out.json"
    options = ["--out", str(out), "--size", "tiny", "--steps", "2", "--once", "--tables"]
    assert peers.main([*options, tables[-1]]) == 0
    results = json.loads(out.read_text())["results"]
    assert any(r["program"] == program and r["rows"] for r in results)
