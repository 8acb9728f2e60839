"""Render a run's policy before and after adaptation as one animation with a column per task.

    python docs/figures/films.py runs/multitask --out docs/figures/films.webp

Each column shows two episodes from the same initial state: the frozen base (top) and the trained
policy (bottom). Out of `WORLDS` initial states per task, the column uses the first one from which
the base fails and the trained policy succeeds, or the very first if there is none.
"""

import argparse
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import envs
from envs.rendering.renderer import RayRenderer
from lorasp_jax import models
from lorasp_jax.base import compilation_cache as cache
from lorasp_jax.base import hub
from lorasp_jax.evaluation import make_rollout
from lorasp_jax.evaluation.programs import Rollout
from lorasp_jax.policies import Policy
from lorasp_jax.training import load_policy
from lorasp_jax.training.export import denoise_steps
from lorasp_jax.training.run_folder import read_json

WORLDS = 8
"""Initial states per task; a rollout records the poses of this many worlds."""
TILE, GAP, BAR = 216, 6, 26
"""Video side, space between videos, caption height [pixels]."""
SPEED, EVERY = 2.0, 2
"""Playback speed relative to real time, and control steps per frame."""
HOLD = 8
"""Number of frames that repeat the last image."""
INK, PAPER = (110, 118, 129), (255, 255, 255, 0)
"""Gray text, legible on light and dark pages, and a transparent background."""
SUCCESS = (18, 184, 134)
"""Color of the border around a successful episode."""


def main() -> None:
    """Write the animation requested on the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument("--out", type=Path, default=Path("docs/figures/films.webp"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quality", type=int, default=60, help="WebP quality, 0 to 100")
    options = parser.parse_args()
    cache.enable()
    columns = record_run(options.run, jax.random.key(options.seed))
    frames = draw_frames(columns)
    seconds = EVERY * columns[0].control_dt / SPEED
    first, *rest = frames
    options.out.parent.mkdir(parents=True, exist_ok=True)
    first.save(
        options.out,
        save_all=True,
        append_images=rest,
        quality=options.quality,
        method=6,
        duration=round(1000 * seconds),
        loop=0,
    )
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.2f} MB, {len(frames)} frames")


class Video(NamedTuple):
    """One episode: images uint8 `[T, TILE, TILE, 3]`, and whether it succeeded."""

    images: np.ndarray
    success: bool


class Column(NamedTuple):
    """One task, before and after adaptation."""

    task: str
    before: Video
    after: Video
    control_dt: float


def record_run(run: Path, key: jax.Array) -> list[Column]:
    """Record every task of a run.

    Raises:
        ValueError: the run is not finished, or it trained the base itself.
    """
    trained, metadata = load_policy(run), read_json(run / "adapter.json")["metadata"]
    base = models.load(hub.resolve_portable(metadata["base"]), trained.model.config)
    policies = [policy.with_sampler() for policy in (Policy(base, trained.processor), trained)]
    steps = denoise_steps(run)
    return [record_task(policies, metadata, task, key, steps) for task in metadata["tasks"]]


def record_task(
    policies: list[Policy], metadata: dict, task: str, key: jax.Array, steps: int
) -> Column:
    """Record one task with both policies from the same initial state."""
    env = envs.make(
        task,
        robot=metadata["robot"],
        num_envs=WORLDS,
        image_size=policies[0].processor.image_size,
        control_dt=metadata["control_dt"],
    )
    rollout = make_rollout(env, denoise_steps=steps)
    before, after = (rollout(with_prompts(policy, env), key) for policy in policies)
    improved = np.asarray(after.success & ~before.success)
    world = int(np.argmax(improved))
    first, last = (int(rollout.success.sum()) for rollout in (before, after))
    print(f"{task}: {first} successes before and {last} after adaptation, of {WORLDS}")
    camera = RayRenderer(env.render_model, 2 * TILE, 1)
    render = jax.jit(dataclasses.replace(env, renderer=camera).render)
    base, adapted = (render_video(render, rollout, world) for rollout in (before, after))
    return Column(task, base, adapted, env.control_dt)


def with_prompts(policy: Policy, env: envs.Env) -> Policy:
    """Return the policy with the instructions of one environment."""
    prompts = policy.processor.prompts.select(env.instructions)
    return Policy(policy.model, dataclasses.replace(policy.processor, prompts=prompts))


def render_video(render: Callable, rollout: Rollout, world: int) -> Video:
    """Render one world from the side camera until it is done."""
    steps = max(int(rollout.steps[world]), 1)
    poses = jax.tree.map(lambda x: x[:steps:EVERY, world : world + 1], rollout.poses)
    images = []
    for i in range(len(poses.geom_xpos)):
        large = np.asarray(render(jax.tree.map(lambda x, i=i: x[i], poses))["side"][0])
        images.append(np.asarray(Image.fromarray(large).resize((TILE, TILE))))
    return Video(np.stack(images), bool(rollout.success[world]))


def draw_frames(columns: list[Column]) -> list[Image.Image]:
    """Draw all columns side by side; shorter videos hold their last image."""
    videos = [video for column in columns for video in (column.before, column.after)]
    length = max(len(video.images) for video in videos) + HOLD
    return [draw_frame(columns, index) for index in range(length)]


def draw_frame(columns: list[Column], index: int) -> Image.Image:
    """Draw one frame of the animation."""
    left = 3 * BAR
    size = left + len(columns) * (TILE + GAP), BAR + 2 * (TILE + GAP)
    sheet = Image.new("RGBA", size, PAPER)
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=15)
    for row, label in enumerate(("base", "LoRA-SP")):
        middle = BAR + row * (TILE + GAP) + TILE // 2
        pen.text((left - 10, middle), label, INK, font, anchor="rm")
    for i, column in enumerate(columns):
        x = left + i * (TILE + GAP)
        pen.text((x + TILE // 2, BAR // 2), column.task.replace("_", " "), INK, font, anchor="mm")
        for row, video in enumerate((column.before, column.after)):
            y, done = BAR + row * (TILE + GAP), index >= len(video.images) - 1
            sheet.paste(Image.fromarray(video.images[-1 if done else index]), (x, y))
            if done and video.success:
                pen.rectangle((x, y, x + TILE - 1, y + TILE - 1), outline=SUCCESS, width=4)
    return sheet


if __name__ == "__main__":
    main()
