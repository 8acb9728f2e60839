"""Untrusted files are refused before they are opened; valid ones are read."""

import json
import os
import re
import socket

import pytest

from lorasp_jax.base import files


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "dataset"
    (folder / "data").mkdir(parents=True)
    (folder / "data" / "a.json").write_text('{"a": 1}')
    (tmp_path / "secret.json").write_text("{}")
    return folder


@pytest.mark.parametrize("name", ["data/a.json", "a b", "...", "a..b/c", "ä"])
def test_names_inside_the_folder(name, tmp_path):
    assert files.join_inside(tmp_path, name) == tmp_path / name


@pytest.mark.parametrize(
    "name",
    [
        *("/etc/passwd", "../x", "a/../../x", "a\\..\\x", "http://h/x", "file:x", "C:\\x"),
        *("", None, 3, "a\0b", ["x"]),
    ],
)
def test_names_outside_the_folder(name, tmp_path):
    with pytest.raises(files.RefusedError, match=re.escape(repr(name))):
        files.join_inside(tmp_path, name)


def test_links(folder, tmp_path):
    """Links within the folder, and a folder that is a link itself, are fine; others are not."""
    (folder / "b.json").symlink_to("data/a.json")
    (tmp_path / "link").symlink_to(folder)
    for place in (folder, tmp_path / "link"):
        assert files.read_json(place / "b.json", place) == {"a": 1}
    (folder / "c.json").symlink_to("../secret.json")
    (folder / "out").symlink_to("..")
    for path in (folder / "c.json", folder / "out" / "secret.json"):
        with pytest.raises(files.RefusedError, match=r"secret.json.* outside of .*dataset"):
            files.check_regular(path, folder)
        assert files.check_regular(path) == path
    (folder / "loop").symlink_to("loop")
    for name in ("loop", "nothing"):
        with pytest.raises(OSError, match=name):
            files.check_regular(folder / name, folder)


@pytest.mark.parametrize("shared", [False, True])
def test_a_snapshot_of_the_hub(shared, tmp_path):
    """In the layout of huggingface_hub, also if the cache is behind a link."""
    snapshot = tmp_path / "hub" / "datasets--owner--name" / "snapshots" / "0123"
    blobs = snapshot.parent.parent / "blobs"
    for folder in (snapshot / "meta", blobs, tmp_path / "hub" / "blobs" / "ab"):
        folder.mkdir(parents=True)
    if shared:
        (blobs / "f00").symlink_to("../../blobs/ab/abcd")
    (blobs / "f00").write_text("[1]")
    (snapshot / "meta" / "info.json").symlink_to("../../../blobs/f00")
    (tmp_path / "elsewhere").symlink_to(tmp_path / "hub")
    for root in ("hub", "elsewhere"):
        place = tmp_path / root / snapshot.relative_to(tmp_path / "hub")
        assert files.read_json(place / "meta" / "info.json", place) == [1]
        assert files.read_json(place / "meta" / "info.json", place / "meta") == [1]
    (snapshot / "other").symlink_to(tmp_path / "hub" / "datasets--owner--name")
    (snapshot.parent.parent / "refs").write_text("x")
    with pytest.raises(files.RefusedError, match="outside of"):
        files.check_regular(snapshot / "other" / "refs", snapshot)


def test_special_files_are_refused(folder, monkeypatch):
    """They are never opened: that would block forever."""
    os.mkfifo(folder / "pipe")
    with socket.socket(socket.AF_UNIX) as server:
        monkeypatch.chdir(folder)  # names of sockets must be short
        server.bind("socket")
    for path in (folder / "pipe", folder / "data", folder / "socket", files.Path("/dev/zero")):
        with pytest.raises(files.RefusedError, match=str(path)):
            files.read_text(path)


def test_sizes(folder):
    large = folder / "large.json"
    with large.open("wb") as file:
        file.truncate(files.TEXT_BYTES + 1)  # sparse, takes no disk space
    with pytest.raises(files.RefusedError, match=r"large.json .* 1073741825"):
        files.read_json(large)
    deep = folder / "deep.json"
    deep.write_text("[" * 100_000)
    with pytest.raises(ValueError, match=r"deep.json"), files.as_value_error(deep):
        files.read_json(deep)
    files.check_memory(10**6, "this")
    with pytest.raises(files.RefusedError, match="film"):
        files.check_memory(10**20, "the film")


def test_lines_of_json(tmp_path):
    """Line ends of Unicode may be part of a string; a key must not appear twice."""
    texts = ["a\u2028b", "\u2029", "\u0085", "\x7f"]
    lines = [json.dumps({"text": text}, ensure_ascii=False) for text in texts]
    (path := tmp_path / "lines").write_bytes("\r\n\n".join(lines).encode())
    assert [row["text"] for row in files.read_json_lines(path)] == texts
    path.write_text('{"a": {"b": 1, "c": 2, "b": 3}}')
    for read in (files.read_json, files.read_json_lines):
        with pytest.raises(ValueError, match="key 'b' twice"):
            read(path)


def test_integers():
    assert [files.as_int(n) for n in (3, 3.0, -1, 2**62)] == [3, 3, -1, 2**62]
    for bad in (2.5, float("nan"), float("inf"), -1e300, 10**30, True, None, "3", [3]):
        with pytest.raises(ValueError, match="integer"):
            files.as_int(bad)


def test_only_files(folder, tmp_path):
    files.check_only_files(folder, folder)
    for name, target in (("file", "../../secret.json"), ("folder", "../..")):
        (folder / "data" / name).symlink_to(target)
        files.check_only_files(folder)
        with pytest.raises(files.RefusedError, match=rf"{name} .* outside of"):
            files.check_only_files(folder, folder)
        (folder / "data" / name).unlink()
    os.mkfifo(folder / "data" / "pipe")
    with pytest.raises(files.RefusedError, match="pipe"):
        files.check_only_files(folder)


@pytest.mark.parametrize(
    ("error", "word"),
    [
        (ValueError("it is odd\nand more"), "odd"),
        (KeyError("a"), "'a'"),
        (FileNotFoundError(2, "", "x/y"), "/y"),
        (RecursionError(), "RecursionError"),
        (UserWarning("of a library"), "library"),
    ],
)
def test_damage_is_one_line_with_the_path_and_the_remedy(error, word):
    with (
        pytest.raises(ValueError, match=f"^x.*{word}.*: mend it$") as caught,
        files.as_value_error(files.Path("x"), UserWarning, remedy=": mend it"),
    ):
        raise error
    assert "\n" not in str(caught.value)


def test_refusals_and_bugs_pass_unchanged():
    with pytest.raises(files.RefusedError, match=r"^pipe$"), files.as_value_error(files.Path("x")):
        raise files.RefusedError("pipe")
    with pytest.raises(AssertionError), files.as_value_error(files.Path("x")):
        raise AssertionError  # a bug
