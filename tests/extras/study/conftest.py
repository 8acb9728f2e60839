"""The command of the fake study."""

import re
import shutil

import pytest

from lorasp_jax.extras.study import __main__ as command
from lorasp_jax.extras.study import runner, workers
from tests.extras.study import fakes

FILE = "from tests.extras.study.fakes import study\n\ndef get_study(scale):\n    return study()\n"


class InProcess:
    """Run the cells in this process."""

    run_cell = staticmethod(fakes.run)

    @classmethod
    def run(cls, load, folder, names, count):
        runner.work(load(), folder, names, cls.run_cell)


@pytest.fixture
def start(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(workers, "run_workers", InProcess.run)
    (tmp_path / "study.py").write_text(FILE)

    def start(*options):
        arguments = ["--config", str(tmp_path / "study.py"), "--out", str(tmp_path / "runs")]
        code = command.main([*arguments, *options])
        output = capsys.readouterr()
        return code, re.sub(r"\s+", " ", output.out + output.err)

    return start


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "runs/fake"


@pytest.fixture
def committed(start, folder, tmp_path):
    """Results of a finished study whose folder is gone."""
    start()
    file = tmp_path / "docs/study.json"
    file.parent.mkdir()
    (folder / "results.json").rename(file)
    shutil.rmtree(folder)
    return file
