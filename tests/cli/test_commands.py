"""The console command: one name for `python train.py` and the modules."""

import importlib
import os
import runpy
import subprocess
import sys

import pytest

from lorasp_jax.cli import commands
from lorasp_jax.report import __main__ as report
from tests import ROOT
from tests.runs import finish


@pytest.fixture
def called(monkeypatch):
    """What the console command would run, without its signal handlers."""
    found = []
    monkeypatch.setattr(commands, "exit_on_signals", lambda: None)
    monkeypatch.setattr(commands, "run", lambda *arguments: found.append(arguments))
    return found


def test_unknown_commands_are_rejected(called, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["lorasp-jax", "trian"])
    with pytest.raises(SystemExit, match="2"):
        commands.main()
    assert "'trian' (choose from" in capsys.readouterr().err
    assert not called


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_interrupt_during_imports_prints_nothing(name, tmp_path):
    """A stand-in for JAX sends the signal as soon as it is imported."""
    interrupt = f"import os, signal, time; os.kill(os.getpid(), signal.{name}); time.sleep(60)"
    (tmp_path / "jax.py").write_text(interrupt)
    path = {"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}
    command = [sys.executable, str(ROOT / "train.py")]
    stopped = subprocess.run(command, env=os.environ | path, capture_output=True, check=False)
    assert (stopped.returncode, stopped.stdout, stopped.stderr) == (commands.INTERRUPTED, b"", b"")


@pytest.mark.parametrize("name", commands.COMMANDS)
def test_every_command_has_help_under_its_own_name(name, capsys):
    module = importlib.import_module(commands.COMMANDS[name][0])
    with pytest.raises(SystemExit, match="0"):
        module.main(["--help"], f"lorasp-jax {name}")
    printed = capsys.readouterr().out
    assert f"usage: lorasp-jax {name}" in printed
    assert "python " not in printed.partition("\n")[0]


def test_train_is_the_same_program(called, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["lorasp-jax", "train", "--seed", "3"])
    commands.main()
    monkeypatch.setattr(sys, "argv", ["train.py", "--seed", "3"])
    runpy.run_path(str(ROOT / "train.py"), run_name="__main__")
    expected = "train", ["--seed", "3"]
    assert called == [(*expected, "lorasp-jax train"), (*expected, "python train.py")]


def test_report_is_rebuilt(tmp_path, capsys):
    folder = finish(tmp_path)
    assert report.main([str(folder)]) == 0
    assert capsys.readouterr().out == f"report: {folder / 'report.html'}\n"
    first = (folder / "report.html").read_bytes()
    (folder / "report.html").unlink()
    assert report.main([str(folder)]) == 0
    assert (folder / "report.html").read_bytes() == first


def test_a_folder_without_a_run_has_no_report(tmp_path, capsys):
    assert report.main([str(tmp_path / "nowhere")]) == 2
    printed = capsys.readouterr().err
    assert "no run in" in printed
    assert printed.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_command_without_its_dependencies_says_how_to_install_them(monkeypatch, capsys):
    def cannot_import(_):
        raise ModuleNotFoundError(name="mujoco")

    monkeypatch.setattr(importlib, "import_module", cannot_import)
    with pytest.raises(SystemExit, match="2"):
        commands.run("envs", ["collect"], "lorasp-jax envs")
    assert capsys.readouterr().err.endswith('pip install "lorasp_jax[train]"\n')
