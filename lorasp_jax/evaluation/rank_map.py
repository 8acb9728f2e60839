"""Film where rank goes: an episode in which each image patch is tinted by its active rank."""

from collections.abc import Iterator
from pathlib import Path

import envs
from envs.rendering.video import write_video
from lorasp_jax.base.writing import atomic_file
from lorasp_jax.evaluation import rank_film
from lorasp_jax.evaluation.rank_episode import record
from lorasp_jax.evaluation.video import render_episode
from lorasp_jax.training import records
from lorasp_jax.training.export import describe, load_policy
from lorasp_jax.training.run_folder import CONFIG_FILE, read_json

_PIXELS = 256
"""Height and width of a rendered camera [pixels]."""
_CONFIG: records.Schema = records.CONFIG | {
    "image_size": int,
    "control_dt": float,
    "seed": int,
    "evaluation": {"execute_steps": int, "denoise_steps": int},
}


def write(run: Path, task: str | None = None) -> Iterator[Path]:
    """Write rank_map_<task>.mp4 into the folder of a finished run; yield each file when complete.

    Without `task`, it films every task.

    Raises:
        ValueError: the run is unfinished, cannot be simulated, lacks the task, or has no active
            ranks in its vision tower.
    """
    tasks = _tasks(run, task)
    config = read_json(run / CONFIG_FILE, _CONFIG)
    policy, robot = load_policy(run).with_sampler(), describe(run)["robot"]
    sizes = {"image_size": config["image_size"], "control_dt": config["control_dt"]}
    for task in tasks:
        env = envs.make(task, robot=robot, num_envs=1, **sizes)
        episode = record(policy, env, config)
        images = render_episode(env, episode.poses, episode.draw, _PIXELS)
        title = f"{episode.instruction} ({'success' if episode.success else 'failure'})"
        labels = {"title": title, "control_dt": env.control_dt}
        frames = rank_film.draw(images, episode.patches, episode.towers, **labels)
        with atomic_file(run / f"rank_map_{task}.mp4") as unfinished:
            write_video(unfinished, frames, fps=1 / env.control_dt)
        yield run / f"rank_map_{task}.mp4"


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
