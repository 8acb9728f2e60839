"""Film a run's policy before and after adaptation, task by task, as one animated strip.

    python docs/figures/films.py runs/multitask --out docs/figures/films.webp

Each column is one episode, filmed twice from the same start: by the frozen base (above) and by the
policy that the run trained (below). Of `WORLDS` starts a task, the first one shown is one in which
the base fails and the trained policy succeeds, if there is one.
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
from envs.compilation import cache
from envs.rendering.renderer import RayRenderer
from lorasp_jax import models
from lorasp_jax.evaluation import make_rollout
from lorasp_jax.evaluation.rollout import Rollout
from lorasp_jax.policies import Policy
from lorasp_jax.storage import hub
from lorasp_jax.training import load_policy
from lorasp_jax.training.run_folder import read_json

WORLDS = 8
"""Starts per task; a rollout keeps the poses of as many."""
TILE, GAP, BAR = 216, 6, 26
"""Side of a film, space between two, height of a caption [pixels]."""
SPEED, EVERY = 2.0, 2
"""How much faster than life, and every how many control steps there is a frame."""
HOLD = 8
"""Frames that the last picture stays."""
INK, PAPER = (110, 118, 129), (255, 255, 255, 0)
"""Grey that reads on a light and on a dark page."""
SUCCESS = (18, 184, 134)
"""Color of the frame around an episode that succeeded."""


def main() -> None:
    """Write the strip that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument("--out", type=Path, default=Path("docs/figures/films.webp"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quality", type=int, default=60, help="of the pictures, 0 to 100")
    options = parser.parse_args()
    cache.enable()
    columns = films(options.run, jax.random.key(options.seed))
    frames = strip(columns)
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


class Film(NamedTuple):
    """Pictures uint8 `[T, TILE, TILE, 3]` of an episode."""

    pictures: np.ndarray
    success: bool


class Column(NamedTuple):
    """One task, filmed before and after."""

    task: str
    before: Film
    after: Film
    control_dt: float


def films(run: Path, key: jax.Array) -> list[Column]:
    """A column per task of a run.

    Raises:
        ValueError: no run finished there, or it trained the base itself.
    """
    trained, told = load_policy(run), read_json(run / "adapter.json")["metadata"]
    base = models.load(hub.found_again(told["base"]), trained.model.config)
    policies = [policy.with_sampler() for policy in (Policy(base, trained.processor), trained)]
    return [column(policies, told, task, key) for task in told["tasks"]]


def column(policies: list[Policy], told: dict, task: str, key: jax.Array) -> Column:
    """Film one task twice from the same start."""
    env = envs.make(
        task,
        robot=told["robot"],
        num_envs=WORLDS,
        image_size=policies[0].processor.image_size,
        control_dt=told["control_dt"],
    )
    rollout = jax.jit(make_rollout(env))
    before, after = (rollout(prompted(policy, env), key) for policy in policies)
    better = np.asarray(after.success & ~before.success)
    world = int(np.argmax(better))
    print(f"{task}: {int(before.success.sum())} and {int(after.success.sum())} of {WORLDS}")
    camera = RayRenderer(env.render_model, 2 * TILE, 1)
    render = jax.jit(dataclasses.replace(env, renderer=camera).render)
    films = [film(render, one, world) for one in (before, after)]
    return Column(task, films[0], films[1], env.control_dt)


def prompted(policy: Policy, env: envs.Env) -> Policy:
    """The policy with the instructions of one environment."""
    prompts = policy.processor.prompts.select(env.instructions)
    return Policy(policy.model, dataclasses.replace(policy.processor, prompts=prompts))


def film(render: Callable, rollout: Rollout, world: int) -> Film:
    """What the side camera saw of one world until it was done."""
    steps = max(int(rollout.steps[world]), 1)
    poses = jax.tree.map(lambda x: x[:steps:EVERY, world : world + 1], rollout.poses)
    pictures = []
    for i in range(len(poses.geom_xpos)):
        large = np.asarray(render(jax.tree.map(lambda x, i=i: x[i], poses))["side"][0])
        pictures.append(np.asarray(Image.fromarray(large).resize((TILE, TILE))))
    return Film(np.stack(pictures), bool(rollout.success[world]))


def strip(columns: list[Column]) -> list[Image.Image]:
    """All columns side by side, frame by frame; short ones wait at their end."""
    films = [film for column in columns for film in (column.before, column.after)]
    return [draw(columns, i) for i in range(max(len(film.pictures) for film in films) + HOLD)]


def draw(columns: list[Column], frame: int) -> Image.Image:
    """One frame of the strip."""
    left = 3 * BAR
    size = left + len(columns) * (TILE + GAP), BAR + 2 * (TILE + GAP)
    sheet = Image.new("RGBA", size, PAPER)
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=15)
    for row, label in enumerate(("base", "LoRA-SP")):
        middle = BAR + row * (TILE + GAP) + TILE // 2
        pen.text((left - 10, middle), label, INK, font, anchor="rm")
    for i, one in enumerate(columns):
        x = left + i * (TILE + GAP)
        pen.text((x + TILE // 2, BAR // 2), one.task.replace("_", " "), INK, font, anchor="mm")
        for row, film in enumerate((one.before, one.after)):
            y, done = BAR + row * (TILE + GAP), frame >= len(film.pictures) - 1
            sheet.paste(Image.fromarray(film.pictures[-1 if done else frame]), (x, y))
            if done and film.success:
                pen.rectangle((x, y, x + TILE - 1, y + TILE - 1), outline=SUCCESS, width=4)
    return sheet


if __name__ == "__main__":
    main()
