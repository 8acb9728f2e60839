"""The console command: one name for `python train.py` and the modules."""

import importlib
import os
import subprocess
import sys

import pytest

from lorasp_jax.cli import commands
from lorasp_jax.report import __main__ as report
from tests import ROOT
from tests.runs import finish

CONSOLE = "from lorasp_jax.cli.commands import main; main()"


def console(*arguments, cwd=None):
    command = [sys.executable, "-c", CONSOLE, *arguments]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


def test_unknown_commands_are_rejected():
    result = console("trian")
    assert result.returncode == 2
    assert "'trian' (choose from" in result.stderr
    assert "Traceback" not in result.stderr


def test_interrupt_during_imports_prints_nothing(tmp_path, monkeypatch):
    """A stand-in for JAX sends SIGINT as soon as it is imported."""
    interrupt = "import os, signal, time; os.kill(os.getpid(), signal.SIGINT); time.sleep(60)"
    (tmp_path / "jax.py").write_text(interrupt)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{ROOT}")
    stopped = console("train")
    assert (stopped.returncode, stopped.stdout, stopped.stderr) == (commands.INTERRUPTED, "", "")


@pytest.mark.parametrize("name", commands.COMMANDS)
def test_every_command_has_help_under_its_own_name(name, capsys):
    module = importlib.import_module(commands.COMMANDS[name][0])
    with pytest.raises(SystemExit, match="0"):
        module.main(["--help"], f"lorasp-jax {name}")
    printed = capsys.readouterr().out
    assert f"usage: lorasp-jax {name}" in printed
    assert "python " not in printed.partition("\n")[0]


def test_train_is_the_same_program(tmp_path):
    bad = ["--config", "configs/multitask.py", "--scale", "smoke", "--method", "lorra"]
    result = console("train", *bad, cwd=tmp_path)
    script = [sys.executable, str(ROOT / "train.py"), *bad]
    other = subprocess.run(script, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == other.returncode == 2
    assert result.stderr == other.stderr
    assert "'lorra'" in result.stderr
    assert not list(tmp_path.iterdir())


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


def test_a_command_without_its_dependencies_says_how_to_install_them():
    code = "import sys; sys.modules['mujoco'] = None; from lorasp_jax.cli import commands\n"
    code += "commands.run('envs', ['collect'], 'lorasp-jax envs')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert done.stderr.strip().endswith('pip install "lorasp_jax[train]"')
