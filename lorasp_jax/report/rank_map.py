"""Film where rank goes: an episode in which each image patch is tinted by its active rank."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

import envs
from envs.env import Env
from envs.rendering.video import write_gif, write_video
from lorasp_jax.adapters.io import native
from lorasp_jax.base.files import check_local
from lorasp_jax.base.writing import atomic_file
from lorasp_jax.evaluation.video import render_episode
from lorasp_jax.report import rank_film
from lorasp_jax.report.rank_episode import RankEpisode, RankRecorder
from lorasp_jax.training import records
from lorasp_jax.training.export import load_policy
from lorasp_jax.training.run_folder import CONFIG_FILE, read_json

MAX_GIF_BYTES = 3_000_000
_PIXELS = 256
"""Height and width of a rendered camera [pixels]."""
_HOLD = 8
"""Number of frames for which a GIF shows the end."""
_CONFIG: records.Schema = records.CONFIG | {
    "image_size": int,
    "control_dt": float,
    "seed": int,
    "evaluation": {"episodes": int, "num_envs": int, "execute_steps": int, "denoise_steps": int},
}


def write(run: Path, task: str | None = None, gif: Path | None = None) -> Iterator[Path]:
    """Write rank_map_<task>.mp4 into the folder of a finished run; yield each file when complete.

    Args:
        run: folder of the run.
        task: None films every task.
        gif: also write the first film to this file, with at most `MAX_GIF_BYTES`.

    Raises:
        ValueError: the run is unfinished, cannot be simulated, lacks the task, or has no active
            ranks in its vision tower; or `gif` exists.
    """
    tasks = _tasks(run, task)
    if gif:
        check_local(gif)
        if gif.exists():
            raise ValueError(f"{gif} already exists: choose another --gif")
        gif.parent.mkdir(parents=True, exist_ok=True)
    config = read_json(run / CONFIG_FILE, _CONFIG)
    recorder = RankRecorder(load_policy(run), config)
    robot = native.read_description(run)["metadata"]["robot"]
    sizes = {"image_size": config["image_size"], "control_dt": config["control_dt"]}
    for task in tasks:
        env = envs.make(task, robot=robot, num_envs=1, **sizes)
        frames = film(env, recorder.record(env))
        with atomic_file(run / f"rank_map_{task}.mp4") as unfinished:
            write_video(unfinished, frames, fps=1 / env.control_dt)
        yield run / f"rank_map_{task}.mp4"
        if gif and task == tasks[0]:
            with atomic_file(gif) as unfinished:
                write_small_gif(unfinished, frames, env.control_dt)
            yield gif


def _tasks(run: Path, task: str | None) -> list[str]:
    """Return the tasks to film; see `write` for errors."""
    results = read_json(run / "results.json", records.RESULTS)
    if not results:
        raise ValueError(f"no finished run in {run}: results.json is missing")
    tasks = [*results["tasks"]]
    if not tasks:
        raise ValueError(f"cannot film {run}: its tasks cannot be simulated")
    if "vision" not in results["active_rank"]:
        raise ValueError(f"cannot film {run}: its vision tower has no active ranks")
    if task and task not in tasks:
        raise ValueError(f"the tasks of {run} are {', '.join(tasks)}, got {task!r}")
    return [task] if task else tasks


def film(env: Env, episode: RankEpisode) -> np.ndarray:
    """Draw an episode, uint8 `[T, H, W, 3]`."""
    images = render_episode(env, episode.poses, episode.draw, _PIXELS)
    outcome = "success" if episode.success else "failure"
    return rank_film.draw(
        images,
        episode.patches,
        episode.towers,
        title=f"{episode.instruction} ({outcome})",
        control_dt=env.control_dt,
    )


def write_small_gif(path: Path, frames: np.ndarray, control_dt: float) -> None:
    """Write frames `[T, H, W, 3]` as a GIF, of as many of them as fit in `MAX_GIF_BYTES`."""
    for every in range(1, len(frames) + 1):
        end = np.repeat(frames[-1:], -(-_HOLD // every), axis=0)
        write_gif(path, np.concatenate([frames[::every], end]), every * control_dt)
        if path.stat().st_size <= MAX_GIF_BYTES:
            return
