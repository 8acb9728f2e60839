"""Summarize a dataset: a text report and a contact sheet of images."""

import collections
import dataclasses
import functools
import hashlib
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from envs.datasets.episodes import Episodes, joint_names, labelled
from envs.rendering.video import side_by_side
from lorasp_jax.base.user_cache import user_cache
from lorasp_jax.base.writing import atomic_file
from lorasp_jax.config import AugmentConfig, Config
from lorasp_jax.data.augmentation import Augment, on_wrist, recipe
from lorasp_jax.data.source import Source, describe_left_out, grippers, hints, same_period
from lorasp_jax.data.video import downscale
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.policies.offline_tokenizer import num_tokens

EPISODES, FRAMES, TILE, LINE = 6, 5, 128, 14
"""Contact sheet: episodes, time steps per episode, longer image side, height of a line [px]."""
_MAX_INSTRUCTIONS = 10  # in the report
_END_EFFECTOR = ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")  # action dimensions


@dataclasses.dataclass(frozen=True)
class Summary:
    """The content of a dataset, except its images.

    Attributes:
        state: f32 `[N, J+1]`, all episodes concatenated.
        action: f32 `[N, A]`.
        length: int `[E]`, steps of each episode.
        names: "state" and "action" -> names of the dimensions.
        grippers: which of the state's dimensions are grippers.
        phrases: instruction -> number of episodes.
        robot: name of the robot.
        tasks: names of the tasks.
        outcomes: number of successes, of failures, and of episodes without a label.
        corrected: number of steps in which a person took over.
    """

    state: np.ndarray
    action: np.ndarray
    length: np.ndarray
    names: dict[str, list[str]]
    grippers: list[int]
    phrases: dict[str, int]
    robot: str
    tasks: tuple[str, ...]
    outcomes: tuple[int, int, int]
    corrected: int


def summarize(source: Source) -> Summary:
    """Read all episodes without their images.

    Raises:
        ValueError: an episode is damaged.
    """
    episodes = [source.episode(number, ()) for number in range(len(source))]
    phrases = collections.Counter(e.phrases[0] for e in episodes)
    labels = [labelled(e) for e in episodes]
    outcomes = [int(e.success[0]) for e in labels if e.success is not None]
    return Summary(
        state=np.concatenate([np.asarray(e.state[0]) for e in episodes]),
        action=np.concatenate([np.asarray(e.action[0]) for e in episodes]),
        length=np.array([e.num_steps for e in episodes]),
        names=getattr(source, "names", {}) or _names(episodes[0]),
        grippers=grippers(source, "state"),
        phrases=dict(phrases.most_common()),
        robot=episodes[0].robot,
        tasks=tuple(dict.fromkeys(e.task for e in episodes)),
        outcomes=(outcomes.count(1), outcomes.count(0), outcomes.count(-1)),
        corrected=sum(int(e.corrected.sum()) for e in labels if e.corrected is not None),
    )


def _names(episode: Episodes) -> dict[str, list[str]]:
    """Return the dimension names of an episode in this project's own formats."""
    state, action = (joint_names(array.shape[2] - 1) for array in (episode.state, episode.action))
    action = _END_EFFECTOR if episode.actions == "end_effector" else action
    return {"state": [*state, "gripper"], "action": [*action, "gripper"]}


def report(source: Source, console: Console) -> None:
    """Print a summary of a dataset."""
    summary = summarize(source)
    steps, hertz = int(summary.length.sum()), 1 / source.control_dt
    image = source.episode(0).image
    minutes = steps * source.control_dt / 60
    lines = {
        "format": source.kind,
        "robot": summary.robot,
        "tasks": ", ".join(summary.tasks),
        "cameras": ", ".join(f"{name} {x.shape[3]} x {x.shape[2]}" for name, x in image.items()),
        "episodes": f"{len(source)}, {summary.length.min()} to {summary.length.max()} steps each, "
        f"median {np.median(summary.length):g}",
        "steps": f"{steps} at {hertz:g} Hz, {minutes:.1f} minutes",
    }
    wins, failures, unknown = summary.outcomes
    if wins or failures:
        lines["outcomes"] = f"{wins} successes, {failures} failures, {unknown} without a label"
    if summary.corrected:
        lines["takeover"] = f"a person acts in {summary.corrected} steps"
    if not same_period(source.control_dt, Config.control_dt):
        lines["steps"] += f"; train with --control-dt {source.control_dt:.4g}, or see --every"
    if unused := describe_left_out(source):
        console.print(unused, style="yellow", soft_wrap=True, highlight=False, markup=False)
    for name, text in lines.items():
        console.print(f"{name:9}{text}", soft_wrap=True, highlight=False, markup=False)
    console.print("instructions", highlight=False)
    for phrase, count in list(summary.phrases.items())[:_MAX_INSTRUCTIONS]:
        console.print(f"{count:7}  {phrase}", soft_wrap=True, highlight=False, markup=False)
    if len(summary.phrases) > _MAX_INSTRUCTIONS:
        console.print(f"         and {len(summary.phrases) - _MAX_INSTRUCTIONS} more")
    console.print(_value_table(summary))
    for hint in [*hints(summary.state, summary.grippers), *prompt_hints(summary.phrases)]:
        console.print(hint, style="yellow", soft_wrap=True, highlight=False, markup=False)


def prompt_hints(phrases: Iterable[str]) -> list[str]:
    """Return a hint if instructions are longer than prompts of the bundled bases."""
    kept, lengths = Pi0Config.nano().max_tokens, {text: num_tokens(text) for text in phrases}
    longest = max(lengths, key=lambda text: lengths[text])
    if lengths[longest] <= kept:
        return []
    return [
        f"{longest!r} has {lengths[longest]} tokens, but the nano and small sizes keep {kept}: "
        f"train them with --model.max-tokens {lengths[longest]}"
    ]


def _value_table(summary: Summary) -> Table:
    table = Table(box=None, padding=(0, 1, 0, 0))
    table.add_column("")
    for title in ("min", "max", "mean", "std"):
        table.add_column(title, justify="right", no_wrap=True)
    for kind, rows in (("state", summary.state), ("action", summary.action)):
        values = rows.astype(np.float64)
        statistics = (values.min(0), values.max(0), values.mean(0), values.std(0))
        columns = zip(summary.names[kind], *statistics, strict=True)
        for number, (name, *column) in enumerate(columns):
            title = f"{kind}[{number}]" + f" {name}" * (name != str(number))
            table.add_row(escape(title), *(f"{value:.4f}" for value in column))
    return table


def contact_sheet(source: Source, preset: str = "none") -> np.ndarray:
    """Draw up to `EPISODES` episodes, one per row: frames over time, cameras side by side.

    With the preset of an `AugmentConfig`, a row shows one frame instead, followed by what training
    may make of it. The first row names the cameras and says which is which.

    Returns:
        uint8 `[H, W, 3]`.
    """
    numbers = _spread(len(source), EPISODES)
    rows = [_row(source, number, preset, titles=number == numbers[0]) for number in numbers]
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, [(0, 0), (0, width - row.shape[1]), (0, 0)]) for row in rows]
    return np.concatenate(padded)


def default_path(dataset: str) -> Path:
    """Return the default path of a dataset's contact sheet, in the user's cache folder.

    Args:
        dataset: path or URL of the dataset.
    """
    path = Path(os.path.realpath(dataset))
    digest = hashlib.sha256(str(path if path.exists() else dataset).encode()).hexdigest()[:8]
    return user_cache() / "inspect" / f"{path.name}-{digest}.png"


def write_contact_sheet(source: Source, path: Path, preset: str = "none") -> None:
    """Write `contact_sheet` to a PNG file atomically."""
    sheet = Image.fromarray(contact_sheet(source, preset))
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as temporary:
        sheet.save(temporary, format="png")


def _row(source: Source, number: int, preset: str, *, titles: bool) -> np.ndarray:
    """Draw frames of one episode, with its instruction as caption; `titles` are those of images."""
    episode = source.episode(number)
    frames = []
    steps = _spread(episode.num_steps, FRAMES)
    for column, step in enumerate(steps if preset == "none" else FRAMES * [steps[0]]):
        tiles = {name: downscale(np.asarray(x[0, step]), TILE) for name, x in episode.image.items()}
        if preset != "none" and column:
            tiles = {name: changed(x, name, preset, column) for name, x in tiles.items()}
        height = max(tile.shape[0] for tile in tiles.values())
        padded = {
            name: np.pad(tile, [(0, height - tile.shape[0]), (0, 0), (0, 0)])
            for name, tile in tiles.items()
        }
        if titles:
            kind = "" if preset == "none" else f"draw {column}, " if column else "original, "
            padded = {
                name: np.concatenate([_text(f"{kind}{name}", tile.shape[1]), tile])
                for name, tile in padded.items()
            }
        frames.append(np.pad(side_by_side(padded), [(0, 2), (0, 2), (0, 0)]))
    images = np.concatenate(frames, axis=1)
    text = f"{number}: {episode.phrases[0]} ({episode.num_steps} steps)"
    return np.concatenate([_text(text, images.shape[1]), images])


def _text(text: str, width: int) -> np.ndarray:
    """Draw a line of text, cut at `width` pixels."""
    line = Image.new("RGB", (width, LINE))
    printable = text.encode("latin-1", "replace").decode("latin-1")  # the font has no others
    ImageDraw.Draw(line).text((2, 1), printable, fill="white")
    return np.asarray(line)


def changed(image: np.ndarray, camera: str, preset: str, seed: int) -> np.ndarray:
    """Return one of the images `[H, W, 3]` uint8 that training makes of a camera's."""
    unit = _recipe(preset, on_wrist(camera))(
        jax.random.key(seed), jnp.asarray(image / 255, jnp.float32)
    )
    return np.asarray(255 * unit).round().astype(np.uint8)


@functools.cache
def _recipe(preset: str, wrist: bool) -> Augment:
    """Return the jitted recipe: all tiles of a size share its program."""
    settings: Any = AugmentConfig(preset).chosen(simulated=False)  # type: ignore[arg-type]
    return jax.jit(recipe(settings, wrist=wrist))


def _spread(count: int, number: int) -> list[int]:
    """Return up to `number` evenly spaced integers from 0 to count - 1, both ends included."""
    return sorted({round(x) for x in np.linspace(0, count - 1, min(count, number))})
