"""Atomic writes of files and folders survive a kill and a full disk."""

import os
import signal
import subprocess
import sys

import pytest

from lorasp_jax.base import writing

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
