"""What a step is called in RLDS, and how an episode becomes one record of tensorflow-datasets.

The names are those of Open X-Embodiment.
"""

import io
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tensorflow_datasets as tfds
from PIL import Image
from tensorflow_datasets.core.example_serializer import ExampleSerializer

from envs.datasets.episodes import Episodes
from envs.datasets.files import RefusedError, read_json

FEATURES, INFO = "features.json", "dataset_info.json"
"""Files in a dataset's folder in which tfds keeps its description."""
FILES = "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_INDEX}"
"""What the files of records are called, as tfds.core.SequentialWriter calls them."""
_MAIN = {"side": "image"}  # the main camera's pictures; those of the others are <name>_image
_COMPRESSION = 1  # of zlib, the fastest
_ACTION = {
    "joint": "targets of {joints} [rad], gripper opening [m]",
    "delta_joint": "changes of the targets of {joints} [rad], gripper opening [m]",
    "end_effector": "change of the tool's position x, y, z [m] and its rotation vector x, y, z "
    "[rad] along the axes of the base, gripper opening [m]",
}


_CLASSES = [
    f"{kind.__module__}.{kind.__name__}"
    for kind in (
        tfds.features.FeaturesDict,
        tfds.features.Dataset,
        tfds.features.Image,
        tfds.features.Tensor,
        tfds.features.Text,
        tfds.features.Scalar,
    )
]
_NAMES = {
    "pythonClassName": _CLASSES,
    "python_class_name": _CLASSES,
    "filepathTemplate": [FILES],
    "filepath_template": [FILES],
    "dtype": ["float32", "int64", "bool", "uint8"],
    "encoding": ["none"],
    "encodingFormat": ["png"],
    "encoding_format": ["png"],
    "jsonFeature": [],
    "json_feature": [],
}
"""Fields by which a description names something, as tfds and protobuf spell them -> what they may
say. The last two, and an outermost "type", hold features of older forms, which name classes too."""


def features(episodes: Episodes) -> tfds.features.FeaturesDict:
    """The features of a dataset of such episodes, with joint names and units as documentation."""
    of = tfds.features
    joints = ", ".join(f"joint_{i + 1}" for i in range(episodes.state.shape[2] - 1))
    pictures = {
        picture_name(camera): of.Image(
            shape=images.shape[2:], encoding_format="png", doc=f"{camera} camera, before the action"
        )
        for camera, images in episodes.image.items()
    }
    state = of.Tensor(
        shape=episodes.state.shape[2:],
        dtype=np.float32,
        doc=f"measured before the action: {joints} [rad], gripper opening [m]",
    )
    action = of.Tensor(
        shape=episodes.action.shape[2:],
        dtype=np.float32,
        doc=_ACTION[episodes.actions].format(joints=joints),
    )
    step = {
        "observation": of.FeaturesDict(pictures | {"state": state}),
        "action": action,
        "language_instruction": of.Text(),
        "reward": of.Scalar(np.float32, doc="1 on the last step, where the task is done"),
        "discount": of.Scalar(np.float32, doc="always 1"),
        "is_first": of.Scalar(np.bool_),
        "is_last": of.Scalar(np.bool_),
        "is_terminal": of.Scalar(np.bool_, doc="the same as is_last: the task is done"),
    }
    return of.FeaturesDict({"steps": of.Dataset(step), "episode_metadata": _metadata()})


def _metadata() -> tfds.features.FeaturesDict:
    """What is said of every episode."""
    of = tfds.features
    metadata = {
        "episode_id": of.Scalar(np.int64, doc="number of the episode in the dataset, from 0"),
        "instruction": of.Scalar(np.int64, doc="number of the phrasing in the metadata's list"),
        "task": of.Text(),
        "robot": of.Text(),
        "control_dt": of.Scalar(np.float32, doc="time between two actions [s]"),
        "physics_dt": of.Scalar(np.float32, doc="time step of the simulation [s]"),
    }
    return of.FeaturesDict(metadata)


def stored(folder: Path) -> tfds.features.FeaturesDict:
    """The features that a folder describes.

    Raises:
        ValueError: as `check_description`, or they are damaged.
    """
    check_description(folder, FEATURES)
    found: Any = tfds.features.FeaturesDict.from_config(str(folder))
    return found


def check_description(folder: Path, *names: str) -> None:
    """Raise unless tfds may read these files: it imports the modules and formats the names in them.

    Raises:
        RefusedError: a file names another class than those of `features`, or other files of records
            than `FILES`.
        ValueError: a file is damaged.
        OSError: there is none.
    """
    for path in (folder / name for name in names):
        description = read_json(path, folder)
        fields = _NAMES | ({"type": ()} if path.name == FEATURES and "type" in description else {})
        for field, value in _named(description, fields):
            if value not in fields[field]:
                raise RefusedError(
                    f"{path} has {field} {str(value)[:80]!r}: it may be "
                    f"{' or '.join(fields[field]) or 'absent only'}"
                )


def _named(value: Any, fields: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Values of these fields anywhere in a JSON value."""
    if isinstance(value, dict):
        yield from ((field, value[field]) for field in fields if field in value)
        value = list(value.values())
    for item in value if isinstance(value, list) else ():
        yield from _named(item, fields)


def serializer(form: tfds.features.FeaturesDict) -> ExampleSerializer:
    """What `record` needs of the features.

    It takes whole columns; `form.serialize_example` takes a step at a time and twice as long.
    """
    columns: Any = form.get_serialized_info()
    return ExampleSerializer(columns)


def record(to: ExampleSerializer, episodes: Episodes, number: int, episode_id: int) -> bytes:
    """One of the episodes, whose arrays lie in host memory, as the bytes of a record."""
    steps, phrase = int(episodes.length[number]), int(episodes.instruction[number])
    pictures = {
        picture_name(camera): _encode(images[number, :steps])
        for camera, images in episodes.image.items()
    }
    last = np.arange(steps) == steps - 1
    columns: dict[str, Any] = {
        "observation": pictures | {"state": episodes.state[number, :steps]},
        "action": episodes.action[number, :steps],
        "language_instruction": [episodes.instructions[phrase].encode()] * steps,
        "reward": last.astype(np.float32),
        "discount": np.ones(steps, np.float32),
        "is_first": np.arange(steps) == 0,
        "is_last": last,
        "is_terminal": last,
    }
    metadata: dict[str, Any] = {
        "episode_id": np.int64(episode_id),
        "instruction": np.int64(phrase),
        "task": episodes.task.encode(),
        "robot": episodes.robot.encode(),
        "control_dt": np.float32(episodes.control_dt),
        "physics_dt": np.float32(episodes.physics_dt),
    }
    example: dict[str, Any] = {"steps": columns, "episode_metadata": metadata}
    return to.serialize_example(example)


def episode(
    example: Mapping[str, Any],
    cameras: Mapping[str, str],
    sizes: Mapping[str, Any],
    facts: Mapping[str, Any],
) -> Episodes:
    """One episode, in host memory.

    Args:
        example: what tfds gives, pictures not decoded.
        cameras: name of a camera -> name of its pictures.
        sizes: name of a camera -> height and width of its pictures.
        facts: what the episode does not hold itself: the facts of `Episodes`.
    """
    steps = list(example["steps"])
    seen = [step["observation"] for step in steps]
    return Episodes(
        image={
            camera: np.stack([_decode(observation[name], sizes[camera]) for observation in seen])[
                None
            ]
            for camera, name in cameras.items()
        },
        state=np.stack([observation["state"] for observation in seen])[None],
        action=np.stack([step["action"] for step in steps])[None],
        length=np.array([len(steps)], np.int32),
        instruction=np.array([int(example["episode_metadata"]["instruction"])], np.int32),
        **facts,
    )


def picture_name(camera: str) -> str:
    """What the pictures of a camera are called."""
    return _MAIN.get(camera, f"{camera}_image")


def _encode(images: Any) -> list[bytes]:
    """PNG files (ISO/IEC 15948) of uint8 `[T, H, W, 3]` pictures in host memory.

    Written here because no library is as fast: zlib's work needs no lock of Python's, and rendered
    pictures shrink most without a filter. Measured on pictures of 128 px and 16 cores, 8 threads
    take 56 us a picture; ffmpeg's encoder 88 at best, OpenCV's 141 and PIL's 177, larger by 15 %.
    """
    count, height, width, _ = images.shape
    rows = np.zeros((count, height, 1 + 3 * width), np.uint8)  # each begins with 0: no filter
    rows[..., 1:] = images.reshape(count, height, 3 * width)
    kind = struct.pack(">2I5B", width, height, 8, 2, 0, 0, 0)  # 8 bits a channel, RGB
    start, end = b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", kind), _chunk(b"IEND", b"")
    return [
        start + _chunk(b"IDAT", zlib.compress(picture.data, _COMPRESSION)) + end for picture in rows
    ]


def _chunk(kind: bytes, data: bytes) -> bytes:
    """A piece of a PNG file: length, kind, data, checksum."""
    length, check = len(data), zlib.crc32(data, zlib.crc32(kind))
    return struct.pack(">I", length) + kind + data + struct.pack(">I", check)


def _decode(file: bytes, size: Any) -> np.ndarray:
    """A uint8 `[H, W, 3]` picture; raises a ValueError if its H and W are others than these."""
    with Image.open(io.BytesIO(file), formats=("PNG",)) as picture:
        if [picture.height, picture.width] != list(size):  # nothing is decoded so far
            raise ValueError(f"a picture has {picture.height} x {picture.width} pixels, not {size}")
        return np.asarray(picture)
