"""Test the comparison with other programs: what runs, what is compared, what is written."""

import argparse
import json
import os
import re
import stat
import sys
import time

import jax
import numpy as np
import pytest
from flax import nnx

from benchmarks.peers import __main__ as peers
from benchmarks.peers import cases, ours, report, worker, workloads
from benchmarks.peers.worker import Job
from lorasp_jax.adapters import adaptation
from tests import ROOT

FAKE = """#!{python}
import json, sys
arguments = dict(zip(sys.argv[3::2], sys.argv[4::2]))
{body}
rows = [{{"item": "batch 2", "median_s": {seconds}, "samples": 2}}]
result = {{"device": "cpu", "versions": {{"openpi": "1.2"}}, "rows": rows}}
open(arguments["--result"], "w").write(json.dumps(result))
"""


def job(table, variant="none", **options):
    return Job(table, variant, options.pop("size", "tiny"), 1, options.pop("steps", 2), False)


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
    assert [line["program"] for line in lines] == ["ours", "openpi", "ours"]
    assert [line["ratio"] for line in lines] == [1, 4, 1]
    assert [line["samples/s"] for line in lines] == [4, 1, 4]
    assert content["versions"]["openpi"] == {"openpi": "1.2"}
    assert "openpi: openpi 1.2" in printed


def test_once_runs_the_reference_once(tmp_path, capsys, fakes):
    content = run(tmp_path, capsys, "--once", *fakes(ours={}, openpi={}))[1]
    assert [line["program"] for line in content["tables"]["pi0-sample"]] == ["ours", "openpi"]


@pytest.mark.parametrize("body", ["import nothing_of_this_name", None])
def test_missing_programs_are_named_and_do_not_stop_others(body, tmp_path, capsys, fakes):
    command = fakes(ours={}, openpi={"body": body or ""})
    if body is None:
        (tmp_path / "openpi").unlink()
    status, content, printed = run(tmp_path, capsys, *command)
    assert status == 0
    assert [line["program"] for line in content["tables"]["pi0-sample"]] == ["ours", "ours"]
    assert "to install: pip install --no-deps git+https://github.com/Phys" in printed


def test_failures_are_reported_and_give_an_exit_status(tmp_path, capsys, fakes):
    command = fakes(ours={}, openpi={"body": "raise ValueError('out of memory')"})
    status, content, printed = run(tmp_path, capsys, *command)
    assert status == 1
    assert content["results"][1]["error"] == "ValueError: out of memory"
    assert "to install" not in printed


def test_a_failed_reference_leaves_no_ratio(tmp_path, capsys, fakes):
    command = fakes(ours={"body": "sys.exit(3)"}, openpi={})
    status, content, _ = run(tmp_path, capsys, *command)
    assert status == 1
    assert [line["ratio"] for line in content["tables"]["pi0-sample"]] == [""]
    assert content["results"][0]["error"] == "exit status 3"


def test_ours_runs_as_a_process(tmp_path, capsys, fakes):
    """The real worker, beside a stand-in."""
    command = ["--warmup", "1", "--steps", "2", "--once", *fakes(openpi={})]
    status, content, _ = run(tmp_path, capsys, *command)
    assert status == 0
    result = content["results"][0]
    assert [row["item"] for row in result["rows"]] == ["batch 1", "batch 2"]
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


def test_times_are_medians_after_warm_up():
    seconds = iter([0.5, 0.0, 0.02, 0.3])
    row = worker.timed("x", lambda: next(seconds), time.sleep, job("pi0-sample", steps=3))
    assert row["median_s"] == pytest.approx(0.02, abs=0.015)
    assert row["min_s"] < 0.01
    assert 0.3 <= row["max_s"] < 0.5


def test_every_variant_has_a_module_and_an_install_command():
    for table, entries in cases.TABLES.items():
        assert entries[0][0] == cases.OURS, table
        for program, _ in entries:
            assert (ROOT / "benchmarks" / "peers" / f"{program}.py").is_file()
            assert program in cases.INSTALL


def test_the_guide_names_every_table_and_the_pinned_versions():
    text = (ROOT / "benchmarks" / "peers.md").read_text()
    assert set(re.findall(r"^\| `([a-z0-9-]+)` \|", text, re.MULTILINE)) == set(cases.TABLES)
    for command in cases.INSTALL.values():
        for pin in re.findall(r"[a-z\]]+==[\d.]+", command):
            assert pin.partition("==")[2] in text


def test_all_programs_get_the_same_numbers():
    one, two = (workloads.policy_batch(workloads.PI0["tiny"], 2) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, one, two)
    batch = ours.batch(job("pi0-sample"), 2)
    images = batch.observation.images
    np.testing.assert_array_equal(images["left_wrist_0_rgb"], one["images"][1])
    np.testing.assert_array_equal(batch.actions, one["actions"])
    assert len(images) == workloads.PI0["tiny"].cameras
    assert np.abs(one["images"][0]).max() <= 1


@pytest.mark.parametrize("table", ["pi0-train", "smolvla-train"])
def test_published_sizes_are_the_defaults(table):
    config = ours.model_config(job(table, size="base"))
    shape = ours.workload(job(table, size="base"))[1]
    published = type(config).base()
    assert (config.vision, config.language, config.action) == (
        published.vision,
        published.language,
        published.action,
    )
    assert (shape.batch, shape.chunk, shape.tokens) == (32, published.chunk, published.max_tokens)
    assert (shape.image, shape.dim) == (published.image_size, published.action_dim)


TRAINED = {
    # All that openpi trains but its LoRA (models/pi0_config.py), and LoRA without pairs per head.
    ("pi0-train", ours.OPENPI): 468_039_440 - 49_987_584 + 1_225_728 * 16 + 433_152 * 32,
    # What LeRobot trains by default.
    ("smolvla-expert", "expert only"): 99_880_992,
}


@pytest.mark.parametrize(("case", "expected"), TRAINED.items(), ids=str)
def test_the_same_parameters_are_trained_as_elsewhere(case, expected):
    chosen = job(*case, size="base")
    config = ours.model_config(chosen)

    def model():
        return adaptation.adapt(config.create(nnx.Rngs(0)), ours.rules(chosen)[0], rngs=nnx.Rngs(1))

    trained = adaptation.split(nnx.eval_shape(model))[1]
    assert sum(leaf.size for leaf in jax.tree.leaves(trained)) == expected


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [(t, v) for t, entries in cases.TABLES.items() for p, v in entries if p == cases.OURS],
    ids="-".join,
)
def test_every_variant_of_ours_runs(case):
    rows = list(ours.measure(job(*case)))
    assert rows
    assert all(row["median_s"] > 0 for row in rows)


def test_ratios_use_the_mean_of_both_reference_runs():
    def result(program, seconds):
        rows = [{"item": "batch 1", "median_s": seconds}]
        return {"table": "pi0-sample", "program": program, "variant": "none", "rows": rows}

    lines = report.rows(
        [result("ours", 1.0), result("openpi", 4.0), result("ours", 3.0)], "pi0-sample"
    )
    assert [line["ratio"] for line in lines] == [0.5, 2.0, 1.5]
