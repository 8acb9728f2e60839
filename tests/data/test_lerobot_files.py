"""LeRobot's files are read as LeRobot reads them; a refusal names the file and the field."""

import io
import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image, ImageOps

from lorasp_jax.data.lerobot import LeRobot
from lorasp_jax.data.video import VideoReader, check_same_size, decode_image
from tests.data.lerobots import VERSIONS, copied, edit_info, edit_rows, golden, replaced
from tests.malformed import check_refusal

INFO, ROWS, EPISODES = "meta/info.json", "data", "meta/episodes"
SIDE = "observation.images.side"
START = f"videos/{SIDE}/from_timestamp"


def field(name, value):
    """Set a field of info.json, such as features/action/shape; ... removes it."""

    def change(info):
        *owners, key = name.split("/")
        for owner in owners:
            info = info[owner]
        info.pop(key) if value is ... else info.update({key: value})

    return lambda folder: edit_info(folder, change)


def column(name, values, of=ROWS):
    """Replace a column by the values of a function of its values; None drops it."""

    def change(table):
        if values is None:
            return table.drop_columns([name])
        return replaced(table, name, pa.array([values(x) for x in table[name].to_pylist()]))

    return lambda folder: edit_rows(folder, change, of)


def write(name, text):
    return lambda folder: (folder / name).write_text(text)


BOTH = [
    (write(INFO, "[]"), "info.json is damaged .it must be an object, got"),
    (field("codebase_version", "v1.6"), "info.json has the codebase_version 'v1.6'; convert it"),
    (field("fps", "10"), "info.json is damaged .fps must be a number, got '10'"),
    (field("fps", None), "info.json is damaged .fps must be a number, got None"),
    (field("fps", -10), "info.json is damaged .fps must be positive"),
    (field("features", None), "info.json is damaged .features must be an object"),
    (field("features/action", None), "features.action must be an object, got None"),
    (field("features/action/dtype", ...), "features.action lacks 'dtype'"),
    (field("features/action/shape", None), "action must be one vector per frame, .* shape None"),
    (field("features/action/shape", 7), "features.action.shape must be a list, got 7"),
    (field(f"features/{SIDE}/info", "x"), f"features.{SIDE}.info must be an object"),
    (field("video_path", None), "info.json: video_path must be a path .* got None"),
    (field("video_path", "{nope}"), "info.json: video_path must be .* video_key, .* got '{nope}'"),
    (field("data_path", "{0}"), "info.json: data_path must be a path with the fields"),
    (column("action", None), "lacks 'action'"),
    (column("timestamp", None), "lacks 'timestamp'"),
    (column("action", lambda x: {"a": x[0]}), "its rows have 1 values, not 7, of the type struct"),
    (column("action", lambda x: "x"), "its rows have 1 values, not 7, of the type string"),
    (column("action", lambda x: [b"x"] * 7), "its values are binary, not numbers"),
    (column("action", lambda x: [1e300] * 7), "episode 0 is damaged .action is not finite at step"),
]
ONLY = {
    "v21": [
        (write("meta/tasks.jsonl", "null\n"), "tasks.jsonl is damaged .each line must be an obj"),
        (write("meta/tasks.jsonl", '{"task": "\\ud800"}'), "tasks.jsonl is damaged .*surrogates"),
        (field("chunks_size", ...), "info.json lacks 'chunks_size'"),
        (field("chunks_size", 0), "info.json is damaged .chunks_size must be at least 1"),
        (field("data_path", ...), "info.json is damaged .it lacks 'data_path'"),
    ],
    "v3": [
        (column(START, lambda x: None, EPISODES), "from_timestamp must be a number, got None"),
        (column(START, lambda x: -1.0, EPISODES), "episode 0 starts at -1.0 s in its obs"),
    ],
}


@pytest.mark.parametrize("version", VERSIONS)
def test_refusals_name_file_and_field(version, tmp_path):
    for number, (damage, words) in enumerate(BOTH + ONLY[version]):
        (to := tmp_path / str(number)).mkdir()
        damage(folder := copied(version, to))
        with pytest.raises(ValueError, match=words) as caught:
            [LeRobot(folder).episode(i) for i in range(2)]
        check_refusal(caught.value, str(folder))


def test_the_episode_with_a_bad_value_is_named(tmp_path):
    folder = copied("v3", tmp_path)
    rows = iter(range(1000))
    column("action", lambda x: [np.nan] * 7 if next(rows) == 40 else x)(folder)
    dataset = LeRobot(folder)
    dataset.episode(0, ())
    with pytest.raises(ValueError, match=r"parquet: episode 1 is .* at step 15, dimension 0"):
        dataset.episode(1, ())


def test_episodes_are_in_the_order_of_their_numbers(tmp_path):
    """LeRobot sorts them (load_episodes of 0.3.3 and 0.6.1)."""
    lines = (golden("v21") / "meta" / "episodes.jsonl").read_text().splitlines()
    write("meta/episodes.jsonl", "\n".join(reversed(lines)))(old := copied("v21", tmp_path))
    (tmp_path / "new").mkdir()
    new = copied("v3", tmp_path / "new")
    edit_rows(new, lambda table: table.take(list(range(len(table)))[::-1]), EPISODES)
    for folder in (old, new):
        assert [entry.number for entry in LeRobot(folder).index.episodes] == list(range(len(lines)))


@pytest.mark.parametrize("name", ["task", "instruction", None])
def test_instructions_are_the_index_of_a_table(name, tmp_path):
    """LeRobot renames whatever index pandas finds (load_tasks of 0.6.1)."""
    path = (folder := copied("v3", tmp_path)) / "meta" / "tasks.parquet"
    stored = name or "__index_level_0__"
    table = pa.table({"task_index": [1, 0], "kind": ["x", "y"], stored: ["open", "press"]})
    if name != "task":
        table = table.append_column("task", pa.array(["not", "these"]))
    pandas = {"index_columns": [stored], "columns": [], "pandas_version": "2.2.3"}
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path)
    assert LeRobot(folder).index.tasks == {1: "open", 0: "press"}


def test_what_is_not_said_or_not_meant(tmp_path):
    """Paths of 3.0 have defaults; macOS leaves hidden files, and Windows byte order marks."""
    folder = copied("v3", tmp_path)
    field("data_path", ...)(folder)
    field("video_path", ...)(folder)
    (folder / "meta" / "episodes" / "chunk-000" / "._file-000.parquet").write_bytes(b"\0\5\26\7")
    info = folder / INFO
    info.write_bytes(b"\xef\xbb\xbf" + info.read_bytes().replace(b",", b",\r\n"))
    expected = LeRobot(golden("v3")).episode(1)
    np.testing.assert_array_equal(LeRobot(folder).episode(1).image["side"], expected.image["side"])


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_pictures_are_turned_as_they_say(kind):
    """Hugging Face's datasets, which LeRobot reads with, obeys EXIF (features/image.py)."""
    picture = Image.fromarray(
        np.kron(np.eye(4, 6)[..., None] * 200, np.ones((8, 8, 3))).astype("u1")
    )
    for orientation in range(1, 9):
        exif = picture.getexif()
        exif[0x112] = orientation
        picture.save(file := io.BytesIO(), kind, exif=exif, quality=95)
        expected = np.asarray(ImageOps.exif_transpose(Image.open(file)).convert("RGB"))
        np.testing.assert_array_equal(decode_image(file.getvalue(), "it"), expected)


def test_types_and_sizes_of_pictures(tmp_path):
    folder = copied("v21", tmp_path)
    found = LeRobot(folder).episode(0, ["side"]).image["side"][0]
    field(f"features/{SIDE}/dtype", "image")(folder)

    def store(cells, kind=None):
        def change(table):
            table = table.drop_columns([SIDE]) if SIDE in table.column_names else table
            return table.append_column(SIDE, pa.array(cells, kind))

        edit_rows(folder, change)

    def encoded(picture):
        Image.fromarray(picture).save(file := io.BytesIO(), "PNG")
        return file.getvalue()

    store([encoded(picture) for picture in found], pa.large_binary())
    np.testing.assert_array_equal(LeRobot(folder).episode(0).image["side"][0], found)
    store([encoded(picture[: 50 - number]) for number, picture in enumerate(found)])
    with pytest.raises(ValueError, match="has pictures of several sizes, 128 x 50 and 128 x 49"):
        LeRobot(folder).episode(0)
    store([{"bytes": "text", "path": None}] * 25)
    with pytest.raises(ValueError, match=f"picture of {SIDE} must be bytes, got str"):
        LeRobot(folder).episode(0)


def test_a_film_without_pictures_or_of_several_sizes(tmp_path):
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / "a.mp4"), "w") as file:
        sound = file.add_stream("aac", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.rate = 8000
        file.mux([*sound.encode(frame), *sound.encode()])
    with pytest.raises(ValueError, match=r"a\.mp4 is damaged .it has no video"):
        VideoReader(tmp_path / "a.mp4")
    with pytest.raises(ValueError, match="several sizes, 3 x 2 and 4 x 2"):
        check_same_size(np.empty((2, 4, 3)), np.empty((2, 3, 3)), tmp_path)
