"""Test the command: every kind of bad input gives a one-line error and exit code 2, and changes
nothing."""

import errno
import json
import os
import re
import shutil
from pathlib import Path

import pytest

from lorasp_jax.cli import train
from lorasp_jax.training.distributed import processes
from lorasp_jax.training.overrides import parse
from lorasp_jax.training.run_folder import open_run, write_json
from tests import ROOT
from tests.runs import RESULTS

MULTITASK = ["--config", str(ROOT / "configs" / "multitask.py"), "--scale", "smoke"]
MULTITASK += ["--tasks", "press"]  # a single environment
NANO = ["--model.checkpoint", str(ROOT / "assets" / "pi0_nano")]


def test_processes_compare_their_versions_before_their_options(monkeypatch, capsys):
    def agree(topic, facts):
        raise ValueError(f"{topic} of {sorted(facts)}")

    monkeypatch.setattr(processes, "initialize", lambda _: None)
    monkeypatch.setattr(processes, "agree", agree)
    assert train.main(["--distributed", "--no-such-option"]) == 2
    assert "versions of ['flax', 'jax', 'lorasp_jax']" in capsys.readouterr().err


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def files():
    return {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}


def begun():
    """Return the folder of a run that has begun."""
    config = parse([*MULTITASK, "--model.checkpoint", "nowhere"]).config
    with open_run(config, train.RUNS, resume=False) as folder:
        return folder


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([*MULTITASK, *NANO, "--peft.rnk", "3"], "Perhaps you meant: --peft.rank"),
        ([*MULTITASK, *NANO, "--model.size", "large"], "unknown size 'large': choose one of"),
        ([*MULTITASK, *NANO, "--model.size", "small"], "does not match the config"),
        (
            [*MULTITASK, *NANO, "--model.backbone", "pi5"],
            "unknown backbone 'pi5': choose one of pi0, smol",
        ),
        ([*MULTITASK, *NANO, "--model.backbone", "smolvla"], "does not match the config"),
        ([*MULTITASK, "--model.checkpoint", "nowhere"], "nowhere"),
        ([*MULTITASK, *NANO, "--targets", "[a-z]+_prj"], "rule '[a-z]+_prj' applies to nothing"),
        ([*MULTITASK, *NANO, "--targets", "expert-onyl"], "unknown preset 'expert-onyl'"),
        ([*MULTITASK, *NANO, "--control-dt", "0.2"], "0.1 s, but this run has 0.2 s"),
        (
            [*MULTITASK, *NANO, "--evaluation.execute-steps", "11"],
            "must be between 1 and the chunk length 10",
        ),
        ([*MULTITASK, *NANO, "--evaluation.episodes", "24"], "must be a multiple of num_envs"),
        ([*MULTITASK, *NANO, "--optim.batch-size", "9"], "multiple of 8 (8 devices), got 9"),
        ([*MULTITASK, *NANO, "--fsdp", "3"], "fsdp must divide the number of devices (8), got 3"),
        (
            [*MULTITASK, *NANO, "--optim.batch-size", "24", "--optim.accumulate", "2"],
            "multiple of 16 (8 devices x 2 micro-batches), got 24",
        ),
        ([*MULTITASK, *NANO, "--method", "ada_lora", "--optim.ema", "0.9"], "cannot be combined"),
    ],
)
def test_bad_input(arguments, message, capsys):
    try:
        code = train.main(arguments)
    except SystemExit as stop:  # tyro reports wrong values of fields
        code = stop.code
    printed = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert code == 2
    assert message in printed
    assert "Traceback" not in printed
    assert not os.listdir()


def test_folder_of_another_run_is_not_changed(capsys):
    folder = Path("runs/multitask")
    folder.mkdir(parents=True)
    (folder / "metrics.jsonl").write_text("precious\n")
    before = files()
    assert train.main([*MULTITASK, *NANO]) == 2
    assert "already contains a run: add --resume" in capsys.readouterr().err
    assert train.main([*MULTITASK, *NANO, "--resume"]) == 2
    assert "contains no run to resume" in capsys.readouterr().err
    assert files() == before


def test_full_disk(capsys, monkeypatch):
    def write(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(train, "run", write)
    assert train.main([*MULTITASK, *NANO]) == 2
    assert (
        capsys.readouterr().err
        == "error: No space left on device: free some memory or disk space and add --resume\n"
    )


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("results.json", '{"tasks": 5}'),
        ("results.json", "5"),
        ("metrics.jsonl", "5\n"),
        ("config.json", "[" * 100_000),
    ],
)
def test_damaged_files_of_a_finished_run(name, content, capsys):
    folder = begun()
    write_json(folder / "results.json", RESULTS)
    (folder / name).write_text(content)
    assert train.main([*MULTITASK, "--model.checkpoint", "nowhere", "--resume"]) == 2
    printed = capsys.readouterr().err
    assert f"{folder / name} is damaged" in printed
    assert printed.count("\n") == 1
    assert (folder / name).read_text() == content


@pytest.mark.parametrize("content", [None, {}, {"control_dt": 0.2}, "{", '{"control_dt": 0.1}'])
def test_base_without_its_control_period(content, capsys):
    shutil.copytree(ROOT / "assets" / "pi0_nano", "base")
    os.remove("base/training.json")
    if isinstance(content, str):
        Path("base/training.json").write_text(content)
    elif content is not None:
        write_json(Path("base/training.json"), content)
    assert train.main([*MULTITASK, "--model.checkpoint", "base"]) == 2
    message = r"is missing or lacks control_dt|training.json is damaged|trained with control_dt 0.2"
    assert re.search(message, capsys.readouterr().err)


def test_finished_run_is_not_repeated(capsys):
    record = json.loads((begun() / "config.json").read_text())
    assert record["peft"]["method"] == "LoRASP"
    write_json(Path("runs/multitask/results.json"), RESULTS)
    assert train.main([*MULTITASK, "--model.checkpoint", "nowhere", "--resume"]) == 0
    printed = capsys.readouterr().out
    assert "this run has already finished: see runs/multitask/report.html" in printed
    assert "Running: step" not in Path("runs/multitask/report.html").read_text()
