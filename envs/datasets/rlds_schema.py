"""The schema of RLDS datasets: each episode is one record of tensorflow-datasets (tfds).

Features have the names of Open X-Embodiment.
"""

import io
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import tensorflow_datasets as tfds
from PIL import Image, UnidentifiedImageError
from tensorflow_datasets.core.example_serializer import ExampleSerializer
from tensorflow_datasets.proto import tf_example_pb2

from envs.datasets.episodes import Episodes, joint_names

CORRECTED = "intervention"
"""Feature of the steps in which a person takes over, as LeRobot names it."""
_MAIN = {"side": "image"}  # feature of the main camera; the others are <name>_image
_COMPRESSION = 1  # level of zlib, the fastest
_ACTION = {
    "joint": "targets of {joints} [rad], gripper opening [m]",
    "delta_joint": "changes of the targets of {joints} [rad], gripper opening [m]",
    "end_effector": "change of the tool's position x, y, z [m] and its rotation vector x, y, z "
    "[rad] along the axes of the base, gripper opening [m]",
}


def features(metadata: Mapping[str, Any]) -> tfds.features.FeaturesDict:
    """Define the features of a dataset from its metadata, documenting joint names and units."""
    types = tfds.features
    state_width, action_width = metadata["widths"]
    names = metadata["options"].get("names", [])
    targets = metadata["options"].get("action_names", names)
    joints = ", ".join(joint_names(state_width - 1))
    images = {
        image_feature(camera): types.Image(
            shape=(*size, 3), encoding_format="png", doc=f"{camera} camera, before the action"
        )
        for camera, size in metadata["cameras"].items()
    }
    state = types.Tensor(
        shape=(state_width,),
        dtype=np.float32,
        doc=", ".join(names) or f"measured before the action: {joints} [rad], gripper opening [m]",
    )
    action = types.Tensor(
        shape=(action_width,),
        dtype=np.float32,
        doc=", ".join(targets) or _ACTION[metadata["actions"]].format(joints=joints),
    )
    step = {
        "observation": types.FeaturesDict(images | {"state": state}),
        "action": action,
        "language_instruction": types.Text(),
        "reward": types.Scalar(np.float32, doc="1 on the last step if the task is done"),
        "discount": types.Scalar(np.float32, doc="always 1"),
        "is_first": types.Scalar(np.bool_),
        "is_last": types.Scalar(np.bool_),
        "is_terminal": types.Scalar(
            np.bool_, doc="on the last step, unless the outcome is unknown"
        ),
    }
    if metadata.get("corrected"):
        step[CORRECTED] = types.Scalar(np.bool_, doc="a person acts in place of the policy")
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
    success = 1 if episodes.success is None else int(episodes.success[number])
    columns: dict[str, Any] = {
        "observation": images | {"state": episodes.state[number, :steps]},
        "action": episodes.action[number, :steps],
        "language_instruction": [episodes.instructions[phrase].encode()] * steps,
        "reward": (last & (success == 1)).astype(np.float32),
        "discount": np.ones(steps, np.float32),
        "is_first": np.arange(steps) == 0,
        "is_last": last,
        "is_terminal": last & (success >= 0),
    }
    if episodes.corrected is not None:
        columns[CORRECTED] = episodes.corrected[number, :steps]
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
    record: bytes,
    cameras: Mapping[str, str],
    sizes: Mapping[str, Any],
    widths: Sequence[int],
    metadata: Mapping[str, Any],
) -> Episodes:
    """Parse a record to an episode in host memory.

    tfds would import the classes that a dataset's description names. A record has no classes.

    Args:
        record: from `record`.
        cameras: camera -> feature of its images.
        sizes: camera -> height and width of its images.
        widths: number of values in a state and in an action; 0: any.
        metadata: the metadata fields of `Episodes`.
    """
    fields = tf_example_pb2.Example.FromString(record).features.feature
    steps = len(fields["steps/is_first"].int64_list.value)
    instruction = fields["episode_metadata/instruction"].int64_list.value
    if not steps or len(instruction) != 1:
        raise ValueError(f"it has {steps} steps and {len(instruction)} instructions")

    def flags(name: str) -> np.ndarray:
        values = np.array(fields[f"steps/{name}"].int64_list.value, bool)
        if values.size != steps:
            raise ValueError(f"{name} has {values.size} values in {steps} steps")
        return values

    def rows(name: str, width: int) -> np.ndarray:
        values = np.array(fields[f"steps/{name}"].float_list.value, np.float32)
        if values.size % steps or width not in (0, values.size // steps):
            raise ValueError(f"{name} has {values.size} numbers in {steps} steps, not {width} each")
        return values.reshape(1, steps, -1)

    def images(camera: str, feature: str) -> np.ndarray:
        files = fields[f"steps/observation/{feature}"].bytes_list.value
        if len(files) != steps:
            raise ValueError(f"{len(files)} images of {camera} in {steps} steps")
        return np.stack([_decode(file, sizes[camera]) for file in files])[None]

    failed = 0 if flags("is_terminal")[-1] else -1  # cut off, it has not failed
    success = 1 if rows("reward", 1)[0, -1, 0] > 0 else failed
    return Episodes(
        image={camera: images(camera, feature) for camera, feature in cameras.items()},
        state=rows("observation/state", widths[0]),
        action=rows("action", widths[1]),
        length=np.array([steps], np.int32),
        instruction=np.array([*instruction], np.int32),
        success=np.array([success], np.int32),
        corrected=flags(CORRECTED)[None] if f"steps/{CORRECTED}" in fields else None,
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
    """Decode an image to uint8 `[H, W, 3]`; raise ValueError if its size is not `size`,
    or if it has no colors."""
    try:
        image = Image.open(io.BytesIO(file), formats=("PNG",))
    except UnidentifiedImageError as error:
        raise ValueError(f"an image is no PNG file, it begins with {file[:8]}") from error
    with image:
        if [image.height, image.width] != list(size):  # checked before decoding
            raise ValueError(f"an image has {image.height} x {image.width} pixels, not {size}")
        if image.mode != "RGB":
            raise ValueError(f"an image has the mode {image.mode}, not RGB")
        return np.asarray(image)
