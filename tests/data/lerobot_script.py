"""Run by the tests in an environment with LeRobot, without this project.

    python lerobot_script.py FOLDER

Writes two datasets with LeRobot, of videos and of pictures, and what LeRobot reads from them and
from the dataset `ours`.
"""

import os
import sys
from pathlib import Path

import numpy as np

os.environ["HF_HUB_OFFLINE"] = "1"
from lerobot.datasets.lerobot_dataset import LeRobotDataset

LENGTHS, TASKS = (12, 7, 9), ("pour", "press")
NAMES = [*(f"joint_{i}.pos" for i in range(1, 7)), "gripper.pos"]
CAMERAS = ("side", "wrist")


def features(kind):
    vector = {"dtype": "float32", "shape": (7,), "names": NAMES}
    picture = {"dtype": kind, "shape": (96, 128, 3), "names": ["height", "width", "channels"]}
    pictures = {f"observation.images.{camera}": picture for camera in CAMERAS}
    return {"observation.state": vector, "action": vector, **pictures}


def picture(rng, step):
    """Smooth colors, which videos keep, in which every frame differs."""
    image = np.full((96, 128, 3), rng.integers(60, 190, 3), np.uint8)
    image[:, : 10 * step + 4] += 40
    return image


def write(root, kind):
    rng = np.random.default_rng(0)
    dataset = LeRobotDataset.create(
        "me/test", 10, features(kind), root=root, robot_type="piper", use_videos=kind == "video"
    )
    for episode, length in enumerate(LENGTHS):
        for step in range(length):
            state, action = rng.normal(size=(2, 7)).astype(np.float32)
            pictures = {f"observation.images.{camera}": picture(rng, step) for camera in CAMERAS}
            frame = {"observation.state": state, "action": action, **pictures}
            dataset.add_frame(frame | {"task": TASKS[episode % 2]})
        dataset.save_episode()
    dataset.finalize()


def read(root, file):
    dataset = LeRobotDataset("me/test", root=root, video_backend="pyav")
    frames = [dataset[number] for number in range(len(dataset))]
    keys = ["observation.state", "action", *(f"observation.images.{c}" for c in CAMERAS)]
    arrays = {key: np.stack([frame[key].numpy() for frame in frames]) for key in keys}
    windows = LeRobotDataset(
        "me/test", root=root, video_backend="pyav", delta_timestamps={"action": [0.0, 0.1, 0.2]}
    )
    chunks = np.stack([windows[number]["action"].numpy() for number in range(len(windows))])
    mean = {key: dataset.meta.stats[key]["mean"] for key in keys}
    arrays |= {f"mean/{key}": value for key, value in mean.items()}
    np.savez(file, task=[frame["task"] for frame in frames], chunks=chunks, **arrays)


folder = Path(sys.argv[1])
for kind in ("video", "image"):
    write(folder / kind, kind)
for kind in ("video", "image", "ours"):
    read(folder / kind, folder / f"{kind}.npz")
