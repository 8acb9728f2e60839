"""A LeRobot dataset opens no URLs, stays in its folder, and takes bounded memory."""

import os
import shutil
import socket

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lorasp_jax.data.lerobot import LeRobot
from lorasp_jax.data.lerobot_files import read_table
from lorasp_jax.data.video import VideoReader, decode_image
from tests.data.lerobots import VERSIONS, copied, edit_info, edit_rows, golden


@pytest.fixture(autouse=True)
def _offline(monkeypatch):
    def refuse(*arguments, **options):
        raise AssertionError("a request")

    monkeypatch.setattr(socket.socket, "connect", refuse)


def read(folder):
    found = LeRobot(folder)
    return [found.episode(number) for number in range(len(found))]


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("of", ["video_path", "data_path"])
def test_paths(version, of, tmp_path):
    folder = copied(version, tmp_path)
    for path in (
        *("http://localhost:9/x.mp4", "/etc/passwd", "../../{episode_index}", "", {"a": 1}),
        *("{chunk_index:0999999999d}", "{video_key.__class__}", "{episode_index!r}", "{0}", "{{}}"),
    ):
        edit_info(folder, lambda info, path=path: info.update({of: path}))
        with pytest.raises(ValueError, match=str(folder)):
            LeRobot(folder)


def test_the_name_of_a_camera(tmp_path):
    """It becomes part of the paths of its videos."""
    folder = copied("v21", tmp_path)
    edit_info(folder, lambda i: i["features"].update({"../../x": {"dtype": "video"}}))
    with pytest.raises(ValueError, match=r"\.\./\.\./x"):
        LeRobot(folder)


@pytest.mark.parametrize("pattern", ["meta/info.json", "data/**/*.parquet", "videos/**/*.mp4"])
@pytest.mark.parametrize("version", VERSIONS)
def test_links_and_pipes(version, pattern, tmp_path):
    folder = copied(version, tmp_path)
    path = sorted(folder.glob(pattern))[0]
    (tmp_path / "outside").write_bytes(path.read_bytes())
    path.unlink()
    path.symlink_to(tmp_path / "outside")
    with pytest.raises(ValueError, match=f"{path.name} .*outside of"):
        read(folder)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(ValueError, match=path.name):
        read(folder) if "info" not in pattern else LeRobot(folder)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_snapshot_of_the_hub(version, tmp_path):
    """Its files are links into the cache's blobs."""
    folder = tmp_path / "datasets--owner--dataset" / "snapshots" / "0123"
    blobs = folder.parent.parent / "blobs"
    shutil.copytree(golden(version), folder)
    blobs.mkdir()
    for number, path in enumerate(sorted(p for p in folder.rglob("*") if p.is_file())):
        path.rename(blobs / f"{number:x}")
        path.symlink_to(os.path.relpath(blobs / f"{number:x}", path.parent))
    wanted = LeRobot(golden(version))
    found = LeRobot(folder, name="dataset")
    np.testing.assert_array_equal(found.episode(1).action, wanted.episode(1).action)
    np.testing.assert_array_equal(found.episode(1).image["side"], wanted.episode(1).image["side"])


def test_playlists_are_refused(tmp_path):
    """FFmpeg would open the files and URLs that they list."""
    for number, text in enumerate(
        (
            "#EXTM3U\n#EXTINF:1,\nhttp://localhost:9/x.ts\n#EXT-X-ENDLIST\n",
            f"ffconcat version 1.0\nfile '{golden('v21')}'\n",
        )
    ):
        path = tmp_path / f"{number}.mp4"
        path.write_text(text)
        with pytest.raises(ValueError, match=f"{number}.mp4"):
            VideoReader(path)


def test_image_formats():
    """Pillow would run a program for PostScript."""
    with pytest.raises(ValueError, match="neither PNG nor JPEG"):
        decode_image(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", "a picture")


@pytest.mark.parametrize(
    ("name", "is_list"), [("action", False), ("action", True), ("observation.state", True)]
)
def test_many_equal_rows(name, is_list, tmp_path):
    """A small file that takes much memory."""
    column = pa.DictionaryArray.from_arrays(pa.array([0] * 10**6, pa.int8()), pa.array([1.5]))
    if is_list:
        column = pa.FixedSizeListArray.from_arrays(column, 1)
    path = tmp_path / "many.parquet"
    table = pa.table({name: column})
    with pq.ParquetWriter(path, table.schema) as writer:
        for _ in range(10):
            writer.write_table(table)
    assert path.stat().st_size < 10**5
    monkey = pytest.MonkeyPatch()
    with monkey.context() as patch:
        patch.setattr(os, "sysconf", lambda name: 7000)  # 47 MiB of memory
        with pytest.raises(ValueError, match=r"many.parquet .* memory"):
            read_table(path, tmp_path)
    assert read_table(path, tmp_path).num_rows == 10**7


def test_lengths_and_sizes_larger_than_memory(tmp_path):
    folder = copied("v3", tmp_path)

    def change(table):
        place, rows = table.column_names.index("length"), pa.array([10**12] * table.num_rows)
        return table.set_column(place, "length", rows)

    edit_rows(folder, change, of="meta/episodes")
    edit_info(folder, lambda info: info.pop("total_frames"))
    with pytest.raises(ValueError, match=str(folder)):
        read(folder)
    edit_info(folder, lambda i: i["features"]["action"].update(shape=[10**12]))
    with pytest.raises(ValueError, match=str(folder)):
        LeRobot(folder)
