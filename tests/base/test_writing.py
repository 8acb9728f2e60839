"""Atomic writes of files and folders survive a kill and a full disk."""

import os
import shutil
import signal
import subprocess
import sys

import pytest

from envs.datasets import rlds
from lorasp_jax.base import writing
from tests.envs.datasets.test_episodes import make

KILLED = """
import os, pathlib, signal, sys
from lorasp_jax.base import writing

os.replace = os.rename = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
path = pathlib.Path(sys.argv[1])
if path.is_file():
    writing.write_text(path, "new")
with writing.atomic_folder(path) as folder:
    (folder / "part").write_text("new")
"""
FULL = """
import pathlib, resource, sys
from lorasp_jax.base import writing

resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))  # as a disk of so many bytes
try:
    if sys.argv[2] == "file":
        writing.write_bytes(pathlib.Path(sys.argv[1]), bytes(2000))
    with writing.atomic_folder(sys.argv[1]) as folder:
        (folder / "part").write_bytes(bytes(2000))
except OSError as error:
    print(error.strerror)
"""


def run(code, *arguments):
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_killed_before_a_file_is_renamed(tmp_path):
    file = tmp_path / "facts.json"
    writing.write_text(file, "old")
    assert run(KILLED, file).returncode == -signal.SIGKILL
    assert file.read_text() == "old"
    assert {path.read_text() for path in tmp_path.iterdir() if path != file} == {"new"}
    writing.write_text(file, "newer")
    assert file.read_text() == "newer"


def test_killed_before_a_folder_is_renamed(tmp_path):
    path = tmp_path / "folder"
    assert run(KILLED, path).returncode == -signal.SIGKILL
    assert not path.exists()
    with writing.atomic_folder(path) as folder:
        assert not os.listdir(folder)  # leftovers of the killed process are gone
    assert os.listdir(tmp_path) == ["folder"]


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_a_full_disk_leaves_nothing(tmp_path, kind):
    path = tmp_path / kind
    if kind == "file":
        path.write_text("old")
    before = os.listdir(tmp_path)
    assert run(FULL, path, kind).stdout == "File too large\n"
    assert os.listdir(tmp_path) == before
    assert kind == "folder" or path.read_text() == "old"


def test_contents_are_synced_before_the_rename(tmp_path, monkeypatch):
    fsync, synced = os.fsync, []

    def noted(descriptor):
        synced.append(os.path.basename(os.readlink(f"/proc/self/fd/{descriptor}")))
        fsync(descriptor)

    for name in ("replace", "rename"):
        function = getattr(os, name)
        monkeypatch.setattr(
            os, name, lambda *paths, move=function: (synced.append("renamed"), move(*paths))
        )
    monkeypatch.setattr(os, "fsync", noted)
    writing.write_text(tmp_path / "file", "")
    aside, *rest = synced
    assert aside.startswith(".file.")
    assert rest == ["renamed", tmp_path.name]
    synced.clear()
    with writing.atomic_folder(tmp_path / "folder") as folder:
        (folder / "part").touch()
    assert synced == ["part", ".folder.tmp", "renamed", tmp_path.name]


def test_a_write_that_fails_keeps_the_old_file(tmp_path):
    file = tmp_path / "file"
    file.write_text("old")
    with (
        pytest.raises(TypeError),
        writing.atomic_file(file) as unfinished,
        unfinished.open("w") as half,
    ):
        half.writelines(["half", b"no text"])
    assert [path.read_text() for path in tmp_path.iterdir()] == ["old"]


def test_existing_folders_are_refused(tmp_path):
    refused = pytest.raises(ValueError, match="already exists")
    with refused, writing.atomic_folder(tmp_path):
        pass


@pytest.fixture
def path(tmp_path):
    return tmp_path / "new folder" / "press"


def test_only_datasets_are_replaced(tmp_path, path):
    rlds.write(make(2), path)
    rlds.write(make(3), tmp_path / "better")
    (tmp_path / "photos").mkdir()
    with pytest.raises(ValueError, match="photos"):
        writing.replace_folder(tmp_path / "better", tmp_path / "photos", rlds.metadata)
    writing.replace_folder(tmp_path / "better", path, rlds.metadata)
    assert rlds.read(path).num_episodes == 3
    assert os.listdir(path.parent) == ["press"]


@pytest.mark.parametrize(("owner", "name"), [(os, "rename"), (shutil, "rmtree")])
def test_a_kill_while_a_folder_is_replaced(tmp_path, monkeypatch, owner, name):
    path, better = tmp_path / "in" / "press", tmp_path / "better"
    for folder, content in ((path, "old"), (better, "new")):
        folder.mkdir(parents=True)
        (folder / content).touch()
    function = getattr(owner, name)

    def killed(*arguments):
        if name == "rmtree" or arguments[0] == better:
            raise KeyboardInterrupt
        function(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(owner, name, killed)
        with pytest.raises(KeyboardInterrupt):
            writing.replace_folder(better, path, lambda _: None)
    assert len(os.listdir(path.parent)) == (2 if name == "rmtree" else 1)
    for _ in range(2):  # the second time there is nothing to do
        writing.recover_folder(path)
        assert os.listdir(path.parent) == ["press"]
        assert os.listdir(path) == ["new" if name == "rmtree" else "old"]
