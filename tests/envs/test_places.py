"""Where collections end up: nothing is taken from another process, nothing is lost by a kill."""

import os
import shutil
import signal
import subprocess
import sys

import pytest

from envs import places, rlds
from tests.envs.test_episodes import make

HOLD = """
import os, pathlib, sys
from envs import places

with places.alone(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def path(tmp_path):
    return tmp_path / "new folder" / "press"


def test_only_datasets_are_replaced(tmp_path, path):
    rlds.write(make(2), path)
    rlds.write(make(3), tmp_path / "better")
    (tmp_path / "photos").mkdir()
    with pytest.raises(ValueError, match="photos is not a folder of envs-rlds-1 episodes"):
        places.install(tmp_path / "better", tmp_path / "photos")
    places.install(tmp_path / "better", path)
    assert rlds.read(path).num_episodes == 3
    assert os.listdir(path.parent) == ["press"]


@pytest.mark.parametrize(("owner", "name"), [(os, "rename"), (shutil, "rmtree")])
def test_a_kill_while_a_dataset_is_replaced(tmp_path, path, monkeypatch, owner, name):
    rlds.write(make(2), path)
    rlds.write(make(3), tmp_path / "better")
    function = getattr(owner, name)

    def killed(*arguments):
        if name == "rmtree" or arguments[0] == tmp_path / "better":
            raise KeyboardInterrupt
        function(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(owner, name, killed)
        with pytest.raises(KeyboardInterrupt):
            places.install(tmp_path / "better", path)
    assert len(os.listdir(path.parent)) == (2 if name == "rmtree" else 1)
    places.recover(path)
    assert os.listdir(path.parent) == ["press"]
    assert rlds.read(path).num_episodes == (3 if name == "rmtree" else 2)
    places.recover(path)  # does nothing where all is well
    assert rlds.read(path).num_episodes == (3 if name == "rmtree" else 2)


def test_one_process_at_a_time(path):
    child = subprocess.Popen(
        [sys.executable, "-c", HOLD, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    with child:
        assert child.stdout
        assert child.stdout.readline() == b"held\n"
        with (
            pytest.raises(ValueError, match=r"another process is collecting into .*press$"),
            places.alone(path),
        ):
            pass
        child.send_signal(signal.SIGKILL)
    with places.alone(path):  # what a killed process leaves is in nobody's way
        assert path.parent.exists()
    assert not list(path.parent.iterdir())


def test_a_lock_that_was_deleted_meanwhile_is_none(path, monkeypatch):
    lock, flock = path.with_name(".press.lock"), places.fcntl.flock

    def late(file, how):
        lock.unlink()
        flock(file, how)

    monkeypatch.setattr(places.fcntl, "flock", late)
    with pytest.raises(ValueError, match="another process"), places.alone(path):
        pass
