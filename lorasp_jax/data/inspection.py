"""What is in a dataset, in words, numbers and pictures."""

import collections
import dataclasses
import hashlib
import math
import os
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from envs.datasets.episodes import Episodes
from envs.datasets.writing import replacing
from envs.rendering.video import side_by_side
from lorasp_jax.data.lerobot import LeRobot
from lorasp_jax.data.source import Source
from lorasp_jax.data.video import reduced

EPISODES, FRAMES, TILE, LINE = 6, 5, 128, 14
"""Of the contact sheet: rows, pictures a row, a picture's longer side, a text's height [pixels]."""
_PHRASES = 10  # that are printed
_TOOL = ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")  # of end-effector actions


@dataclasses.dataclass(frozen=True)
class Summary:
    """All numbers of a dataset.

    Attributes:
        state: f32 `[N, J+1]` of all episodes, one after the other.
        action: f32 `[N, A]`.
        length: int `[E]` steps of each episode.
        names: "state" and "action" -> what its numbers are called.
        phrases: instruction -> number of episodes.
        robot: its name.
        tasks: their names.
    """

    state: np.ndarray
    action: np.ndarray
    length: np.ndarray
    names: dict[str, list[str]]
    phrases: dict[str, int]
    robot: str
    tasks: tuple[str, ...]


def summarise(source: Source) -> Summary:
    """Reads every episode but no picture.

    Raises:
        ValueError: an episode is damaged.
    """
    episodes = [source.episode(number, ()) for number in range(len(source))]
    phrases = collections.Counter(e.instructions[int(e.instruction[0])] for e in episodes)
    return Summary(
        state=np.concatenate([np.asarray(e.state[0]) for e in episodes]),
        action=np.concatenate([np.asarray(e.action[0]) for e in episodes]),
        length=np.array([e.num_steps for e in episodes]),
        names=source.names if isinstance(source, LeRobot) else _names(episodes[0]),
        phrases=dict(phrases.most_common()),
        robot=episodes[0].robot,
        tasks=tuple(dict.fromkeys(e.task for e in episodes)),
    )


def _names(episode: Episodes) -> dict[str, list[str]]:
    """What the numbers are called in datasets of this project's kinds."""
    joints = [f"joint_{i + 1}" for i in range(episode.state.shape[2] - 1)]
    moved = _TOOL if episode.actions == "end_effector" else joints
    return {"state": [*joints, "gripper"], "action": [*moved, "gripper"]}


def report(source: Source, console: Console) -> None:
    """Prints what is in a dataset."""
    found = summarise(source)
    steps, hertz = int(found.length.sum()), 1 / source.control_dt
    minutes = steps * source.control_dt / 60
    facts = {
        "format": source.kind,
        "robot": found.robot,
        "tasks": ", ".join(found.tasks),
        "cameras": ", ".join(_sizes(source)),
        "episodes": f"{len(source)}, of {found.length.min()} to {found.length.max()} steps, "
        f"median {np.median(found.length):g}",
        "steps": f"{steps} at {hertz:g} Hz, {minutes:.1f} minutes",
    }
    for name, text in facts.items():
        console.print(f"{name:9}{text}", soft_wrap=True, highlight=False, markup=False)
    console.print("instructions", highlight=False)
    for phrase, count in list(found.phrases.items())[:_PHRASES]:
        console.print(f"{count:7}  {phrase}", soft_wrap=True, highlight=False, markup=False)
    if len(found.phrases) > _PHRASES:
        console.print(f"         and {len(found.phrases) - _PHRASES} more")
    console.print(_numbers(found))
    for hint in hints(found):
        console.print(hint, style="yellow", soft_wrap=True, highlight=False, markup=False)


def hints(found: Summary) -> list[str]:
    """What is most likely wrong with units; simulated episodes give none."""
    joints, gripper = np.abs(found.state[:, :-1]).max(), np.abs(found.state[:, -1]).max()
    texts = []
    if joints > 2 * math.pi:
        texts.append(f"joints reach {joints:.4g}: if these are degrees, add --angles degrees")
    if gripper > 1:
        texts.append(f"the gripper opens to {gripper:.4g} m: if mm, add --gripper millimetres")
    return texts


def _sizes(source: Source) -> list[str]:
    """Cameras with the pixels of their pictures."""
    image = source.episode(0).image
    return [f"{name} {x.shape[3]} x {x.shape[2]}" for name, x in image.items()]


def _numbers(found: Summary) -> Table:
    """A line for each number of state and action."""
    table = Table(box=None, padding=(0, 1, 0, 0))
    table.add_column("")
    for title in ("min", "max", "mean", "std"):
        table.add_column(title, justify="right", no_wrap=True)
    for name, rows in (("state", found.state), ("action", found.action)):
        values = rows.astype(np.float64)
        statistics = (values.min(0), values.max(0), values.mean(0), values.std(0))
        columns = zip(found.names[name], *statistics, strict=True)
        for number, (called, *column) in enumerate(columns):
            title = f"{name}[{number}]" + f" {called}" * (called != str(number))
            table.add_row(escape(title), *(f"{value:.4f}" for value in column))
    return table


def contact_sheet(source: Source) -> np.ndarray:
    """Pictures of some episodes: a row each, in the order of time, all cameras side by side.

    Returns:
        uint8 `[H, W, 3]`.
    """
    rows = [_row(source, number) for number in _spread(len(source), EPISODES)]
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, [(0, 0), (0, width - row.shape[1]), (0, 0)]) for row in rows]
    return np.concatenate(padded)


def place(where: str) -> Path:
    """Where the pictures of a dataset go by default: a file for each, in the user's cache.

    Args:
        where: the dataset's path or id.
    """
    path = Path(os.path.realpath(where))
    known = hashlib.sha256(str(path if path.exists() else where).encode()).hexdigest()[:8]
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return cache / "lorasp_jax" / "inspect" / f"{path.name}-{known}.png"


def write_contact_sheet(source: Source, path: Path) -> None:
    """Writes `contact_sheet` as a PNG file; the file is replaced when all is written."""
    picture = Image.fromarray(contact_sheet(source))
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as unfinished:
        picture.save(unfinished, format="png")


def _row(source: Source, number: int) -> np.ndarray:
    """One episode, with its instruction above."""
    episode = source.episode(number)
    pictures = []
    for step in _spread(episode.num_steps, FRAMES):
        tiles = {name: reduced(np.asarray(x[0, step]), TILE) for name, x in episode.image.items()}
        height = max(tile.shape[0] for tile in tiles.values())
        level = {
            name: np.pad(tile, [(0, height - tile.shape[0]), (0, 0), (0, 0)])
            for name, tile in tiles.items()
        }
        pictures.append(np.pad(side_by_side(level), [(0, 2), (0, 2), (0, 0)]))
    films = np.concatenate(pictures, axis=1)
    title = Image.new("RGB", (films.shape[1], LINE))
    phrase = episode.instructions[int(episode.instruction[0])]
    text = f"{number}: {phrase} ({episode.num_steps} steps)"
    printable = text.encode("latin-1", "replace").decode("latin-1")  # what the font has
    ImageDraw.Draw(title).text((2, 1), printable, fill="white")
    return np.concatenate([np.asarray(title), films])


def _spread(count: int, wanted: int) -> list[int]:
    """Up to so many numbers from 0 to count - 1, the first and the last among them."""
    return sorted({round(x) for x in np.linspace(0, count - 1, min(count, wanted))})
