"""What a step is called in RLDS, and how an episode becomes one record of tensorflow-datasets.

The names are those of Open X-Embodiment.
"""

import io
from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import av
import numpy as np
import tensorflow_datasets as tfds
from PIL import Image

from envs.episodes import Episodes

_MAIN = {"side": "image"}  # the main camera's pictures; those of the others are <name>_image
# ffmpeg's encoder. Measured on pictures of 128 px, the default takes 3 times as long and saves a
# third of the bytes; PIL takes 4 times as long at its level 1, and its Python part is 8 times as
# long, which counts where many threads share one lock.
_COMPRESSION = "1"
_THREADS = 4
_ACTION = {
    "joint": "targets of {joints} [rad], gripper opening [m]",
    "delta_joint": "changes of the targets of {joints} [rad], gripper opening [m]",
    "end_effector": "change of the tool's position x, y, z [m] and its rotation vector x, y, z "
    "[rad] along the axes of the base, gripper opening [m]",
}


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


def record(
    form: tfds.features.FeaturesDict, episodes: Episodes, number: int, episode_id: int
) -> bytes:
    """One of the episodes, whose arrays lie in host memory, as the bytes of a record."""
    steps, phrase = int(episodes.length[number]), int(episodes.instruction[number])
    pictures = {
        picture_name(camera): _encode(images[number, :steps])
        for camera, images in episodes.image.items()
    }
    last = np.arange(steps) == steps - 1
    columns = {
        "action": episodes.action[number, :steps],
        "language_instruction": [episodes.instructions[phrase]] * steps,
        "reward": last.astype(np.float32),
        "discount": np.ones(steps, np.float32),
        "is_first": np.arange(steps) == 0,
        "is_last": last,
        "is_terminal": last,
    }
    seen = pictures | {"state": episodes.state[number, :steps]}
    metadata = {
        "episode_id": episode_id,
        "instruction": phrase,
        **{name: getattr(episodes, name) for name in ("task", "robot", "control_dt", "physics_dt")},
    }
    rows = [
        {name: column[t] for name, column in columns.items()}
        | {"observation": {name: column[t] for name, column in seen.items()}}
        for t in range(steps)
    ]
    return form.serialize_example({"steps": rows, "episode_metadata": metadata})


def episode(
    example: Mapping[str, Any], cameras: Mapping[str, str], facts: Mapping[str, Any]
) -> Episodes:
    """One episode, in host memory.

    Args:
        example: what tfds gives, pictures not decoded.
        cameras: name of a camera -> name of its pictures.
        facts: what the episode does not hold itself: the facts of `Episodes`.
    """
    steps = list(example["steps"])
    seen = [step["observation"] for step in steps]
    return Episodes(
        image={
            camera: np.stack([_decode(observation[name]) for observation in seen])[None]
            for camera, name in cameras.items()
        },
        state=np.stack([observation["state"] for observation in seen])[None],
        action=np.stack([step["action"] for step in steps])[None],
        length=np.array([len(steps)], np.int32),
        instruction=np.array([example["episode_metadata"]["instruction"]], np.int32),
        **facts,
    )


def picture_name(camera: str) -> str:
    """What the pictures of a camera are called."""
    return _MAIN.get(camera, f"{camera}_image")


def _encode(images: Any) -> list[bytes]:
    """PNG files of uint8 `[T, H, W, 3]` pictures in host memory."""
    encoder: Any = av.CodecContext.create("png", "w")
    encoder.height, encoder.width = images.shape[1:3]
    encoder.pix_fmt, encoder.time_base = "rgb24", Fraction(1)
    encoder.options = {"compression_level": _COMPRESSION}
    # PyAV holds Python's lock while a picture is encoded, so threads of Python's own would not help
    # (measured: 2 are as fast as 1); ffmpeg's are free of it.
    encoder.thread_type, encoder.thread_count = "FRAME", _THREADS
    frames = [av.VideoFrame.from_numpy_buffer(image, format="rgb24") for image in images]
    return [bytes(packet) for frame in [*frames, None] for packet in encoder.encode(frame)]


def _decode(file: bytes) -> np.ndarray:
    """A uint8 `[H, W, 3]` picture."""
    with Image.open(io.BytesIO(file)) as picture:
        return np.asarray(picture)
