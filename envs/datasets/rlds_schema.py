"""The schema of RLDS datasets: each episode is one record of tensorflow-datasets (tfds).

Features have the names of Open X-Embodiment.
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
from lorasp_jax.base.files import RefusedError, read_json

FEATURES, INFO = "features.json", "dataset_info.json"
"""Files of tfds that describe a dataset, in the dataset's folder."""
FILES = "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_INDEX}"
"""Template of shard names, as used by tfds.core.SequentialWriter."""
_TFDS_FILES = "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}"  # of a copy that tfds wrote
_MAIN = {"side": "image"}  # feature of the main camera; the others are <name>_image
_COMPRESSION = 1  # level of zlib, the fastest
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
_ALLOWED = {
    "pythonClassName": _CLASSES,
    "python_class_name": _CLASSES,
    "filepathTemplate": [FILES, _TFDS_FILES],
    "filepath_template": [FILES, _TFDS_FILES],
    "dtype": ["float32", "int64", "bool", "uint8"],
    "encoding": ["none"],
    "encodingFormat": ["png"],
    "encoding_format": ["png"],
    "jsonFeature": [],
    "json_feature": [],
}
"""Allowed values of each field that tfds interprets in a description. Fields are spelled as by tfds
and as by protobuf. The last two fields, and "type" at the top level, are of older formats and are
refused: they name classes, too."""


def features(episodes: Episodes) -> tfds.features.FeaturesDict:
    """Define the features of a dataset of these episodes, documenting joint names and units."""
    types = tfds.features
    joints = ", ".join(f"joint_{i + 1}" for i in range(episodes.state.shape[2] - 1))
    images = {
        image_feature(camera): types.Image(
            shape=array.shape[2:], encoding_format="png", doc=f"{camera} camera, before the action"
        )
        for camera, array in episodes.image.items()
    }
    state = types.Tensor(
        shape=episodes.state.shape[2:],
        dtype=np.float32,
        doc=f"measured before the action: {joints} [rad], gripper opening [m]",
    )
    action = types.Tensor(
        shape=episodes.action.shape[2:],
        dtype=np.float32,
        doc=_ACTION[episodes.actions].format(joints=joints),
    )
    step = {
        "observation": types.FeaturesDict(images | {"state": state}),
        "action": action,
        "language_instruction": types.Text(),
        "reward": types.Scalar(np.float32, doc="1 on the last step, where the task is done"),
        "discount": types.Scalar(np.float32, doc="always 1"),
        "is_first": types.Scalar(np.bool_),
        "is_last": types.Scalar(np.bool_),
        "is_terminal": types.Scalar(np.bool_, doc="the same as is_last: the task is done"),
    }
    return types.FeaturesDict({"steps": types.Dataset(step), "episode_metadata": _metadata()})


def _metadata() -> tfds.features.FeaturesDict:
    types = tfds.features
    metadata = {
        "episode_id": types.Scalar(np.int64, doc="index of the episode in the dataset"),
        "instruction": types.Scalar(np.int64, doc="index of the phrasing in the metadata's list"),
        "task": types.Text(),
        "robot": types.Text(),
        "control_dt": types.Scalar(np.float32, doc="time between two actions [s]"),
        "physics_dt": types.Scalar(np.float32, doc="time step of the simulation [s]"),
    }
    return types.FeaturesDict(metadata)


def stored(folder: Path) -> tfds.features.FeaturesDict:
    """Read the features of a dataset in a folder.

    Raises:
        ValueError: they are damaged, or refused by `check_description`.
    """
    check_description(folder, FEATURES)
    loaded: Any = tfds.features.FeaturesDict.from_config(str(folder))
    return loaded


def check_description(folder: Path, *names: str) -> None:
    """Raise unless tfds, which imports the classes named in these files, can read them safely.

    Raises:
        RefusedError: a file names a class, data type or encoding that `features` does not use, or
            shards other than `FILES` and those of tfds.
        ValueError: a file is damaged.
        OSError: a file is missing.
    """
    for path in (folder / name for name in names):
        description = read_json(path, folder)
        fields = _ALLOWED | (
            {"type": ()} if path.name == FEATURES and "type" in description else {}
        )
        for field, value in _values(description, fields):
            if value not in fields[field]:
                allowed = " or ".join(fields[field]) or "absent"
                raise RefusedError(f"{path} has {field} {str(value)[:80]!r}; it must be {allowed}")


def _values(value: Any, fields: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the values of these fields anywhere in a JSON value."""
    if isinstance(value, dict):
        yield from ((field, value[field]) for field in fields if field in value)
        value = list(value.values())
    for item in value if isinstance(value, list) else ():
        yield from _values(item, fields)


def serializer(features: tfds.features.FeaturesDict) -> ExampleSerializer:
    """Make the serializer for `record`.

    It takes whole columns; `features.serialize_example` works step by step and takes twice as long.
    """
    columns: Any = features.get_serialized_info()
    return ExampleSerializer(columns)


def record(
    serializer: ExampleSerializer, episodes: Episodes, number: int, episode_id: int
) -> bytes:
    """Serialize episode `number` of `episodes`, whose arrays must be in host memory."""
    steps, phrase = int(episodes.length[number]), int(episodes.instruction[number])
    images = {
        image_feature(camera): _encode(array[number, :steps])
        for camera, array in episodes.image.items()
    }
    last = np.arange(steps) == steps - 1
    columns: dict[str, Any] = {
        "observation": images | {"state": episodes.state[number, :steps]},
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
    return serializer.serialize_example(example)


def episode(
    example: Mapping[str, Any],
    cameras: Mapping[str, str],
    sizes: Mapping[str, Any],
    metadata: Mapping[str, Any],
) -> Episodes:
    """Convert an example from tfds to an episode in host memory.

    Args:
        example: the example, with encoded images.
        cameras: camera -> feature of its images.
        sizes: camera -> height and width of its images.
        metadata: the metadata fields of `Episodes`.
    """
    steps = list(example["steps"])
    observations = [step["observation"] for step in steps]
    return Episodes(
        image={
            camera: np.stack([_decode(step[feature], sizes[camera]) for step in observations])[None]
            for camera, feature in cameras.items()
        },
        state=np.stack([step["state"] for step in observations])[None],
        action=np.stack([step["action"] for step in steps])[None],
        length=np.array([len(steps)], np.int32),
        instruction=np.array([int(example["episode_metadata"]["instruction"])], np.int32),
        **metadata,
    )


def image_feature(camera: str) -> str:
    """Return the name of the feature that holds a camera's images."""
    return _MAIN.get(camera, f"{camera}_image")


def _encode(images: Any) -> list[bytes]:
    """Encode uint8 `[T, H, W, 3]` images in host memory as PNG files (ISO/IEC 15948).

    No library is as fast: zlib releases the GIL, and rendered images compress best without a
    filter. On 16 cores, 8 threads take 56 us per image of 128 px (measured). At best, ffmpeg's
    encoder takes 88 us, OpenCV's 141 and PIL's 177, for files 15% larger.
    """
    count, height, width, _ = images.shape
    rows = np.zeros((count, height, 1 + 3 * width), np.uint8)  # each row begins with 0: no filter
    rows[..., 1:] = images.reshape(count, height, 3 * width)
    header = struct.pack(">2I5B", width, height, 8, 2, 0, 0, 0)  # 8 bits per channel, RGB
    start, end = b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header), _chunk(b"IEND", b"")
    return [
        start + _chunk(b"IDAT", zlib.compress(image.data, _COMPRESSION)) + end for image in rows
    ]


def _chunk(kind: bytes, data: bytes) -> bytes:
    """Make a chunk of a PNG file: length, type, data, checksum."""
    length, check = len(data), zlib.crc32(data, zlib.crc32(kind))
    return struct.pack(">I", length) + kind + data + struct.pack(">I", check)


def _decode(file: bytes, size: Any) -> np.ndarray:
    """Decode an image to uint8 `[H, W, 3]`; raise ValueError if its size is not `size`."""
    with Image.open(io.BytesIO(file), formats=("PNG",)) as image:
        if [image.height, image.width] != list(size):  # checked before decoding
            raise ValueError(f"an image has {image.height} x {image.width} pixels, not {size}")
        return np.asarray(image)
