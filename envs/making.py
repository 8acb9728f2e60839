"""Making an environment from the names of a task and a robot, which are those of their files."""

import importlib
import numbers
import os
from collections.abc import Iterator, Sequence
from typing import Any, Literal, get_args

import mujoco

import envs.scene.distractors
from envs import checks, mjcf
from envs.actions import MODES, TARGET_DT, Mode
from envs.compilation import fast_cpu
from envs.env import Env
from envs.names import check, names
from envs.physics import physics
from envs.physics.physics import Backend
from envs.rendering import renderer as render
from envs.rewards import REWARDS, Reward
from envs.robots import Robot
from envs.scene import scene

AnyRobot = str | os.PathLike[str] | Robot
RendererName = Literal["rays", "warp"]
RENDERERS: tuple[str, ...] = get_args(RendererName)
# Largest, which nobody means and no device has memory for, and least where that is not 1.
_RANGES: dict[str, tuple[int, ...]] = {
    "num_envs": (2**20,),
    "image_size": (2**12,),
    "antialias": (16,),
    "distractors": (envs.scene.distractors.MOST, 0),
}


def make(
    task: str,
    robot: AnyRobot = "piper",
    *,
    num_envs: int = 1,
    image_size: int = 64,
    antialias: int = 1,
    control_dt: float = 0.1,
    actions: Mode = "joint",
    reward: Reward = "sparse",
    discount: float = 0.99,
    distractors: int = 0,
    backend: Backend | None = None,
    renderer: RendererName = "rays",
) -> Env:
    """An environment.

    Args:
        task: name of a file in `envs/tasks`.
        robot: name of a file in `envs/robots`, path of a user's MJCF file, or what `envs.mjcf.load`
            made of one.
        num_envs: parallel worlds W.
        image_size: height and width of the pictures in pixels.
        antialias: n for smooth edges by n x n rays a pixel, which take n squared times as long.
        control_dt: seconds between two actions, a multiple of 0.02.
        actions: what an action means: joint, delta_joint or end_effector, see `envs.actions`.
        reward: sparse, 1 for success, or dense, which also says how far the task has come: see
            `envs.rewards`.
        discount: of the learner, for the dense reward, 0 to 1.
        distractors: other things on the table, up to 4.
        backend: of the physics, jax or warp; None takes the fastest there is.
        renderer: rays, the ray caster that runs anywhere, or warp, MuJoCo Warp's, which also draws
            meshes and textures.

    Raises:
        TypeError: for what is no number, or no robot.
        ValueError: for an unknown name (the known ones are listed), a robot that lacks something,
            or a number out of range.
    """
    fast_cpu.warn_if_late()
    found_task, found_robot = _find("task", task), _find_robot(robot)
    num_envs, image_size, antialias, distractors = _counts(
        num_envs=num_envs, image_size=image_size, antialias=antialias, distractors=distractors
    )
    control_dt = _checked_dt(control_dt, found_task.time_limit)
    _check_learning(actions, reward, discount)
    model = scene.build(found_task.scene + envs.scene.distractors.mjcf(distractors), found_robot)
    return Env(
        task=found_task,
        robot=found_robot,
        num_envs=num_envs,
        control_dt=control_dt,
        actions=actions,
        reward=reward,
        discount=discount,
        distractors=distractors,
        model=model,
        physics=physics.Physics(model, physics.default_backend() if backend is None else backend),
        renderer=_renderer(renderer, model, image_size, antialias, num_envs),
    )


def _renderer(
    name: str, model: mujoco.MjModel, image_size: int, antialias: int, num_envs: int
) -> render.Renderer:
    """A renderer by its name, with the pictures of the ray caster."""
    _check_choices(renderer=(name, RENDERERS))
    rays = render.RayRenderer(render.build(model, scene.CAMERAS), image_size, antialias)
    if name == "rays":
        return rays
    physics.need_warp("renderer")
    from envs.rendering.warp import WarpRenderer

    return WarpRenderer(model, rays, num_envs)


def _checked_dt(given: float, time_limit: float) -> float:
    control_dt = checks.number("control_dt", given)
    if control_dt > time_limit:
        limit = f"the time limit of the task, {time_limit} s"
        raise ValueError(f"control_dt must be at most {limit}, got {control_dt}")
    moves = control_dt / TARGET_DT
    if round(moves) < 1 or abs(moves - round(moves)) > 1e-6:
        raise ValueError(
            f"control_dt must be a positive multiple of {TARGET_DT} s, got {control_dt}"
        )
    return control_dt


def _counts(**given: Any) -> Iterator[int]:
    """Whole numbers by their names, each checked."""
    return (checks.count(name, value, *_RANGES[name]) for name, value in given.items())


def _check_choices(**given: tuple[Any, Sequence[str]]) -> None:
    """Values by their names, each with what it may be."""
    for name, (value, known) in given.items():
        if value not in known:
            raise ValueError(f"unknown {name} {value!r}: choose from {', '.join(known)}")


def _check_learning(actions: Mode, reward: Reward, discount: float) -> None:
    """What a learner sees of the worlds."""
    _check_choices(actions=(actions, MODES), reward=(reward, REWARDS))
    real = isinstance(discount, numbers.Real) and not isinstance(discount, bool)
    if not real or not 0 < discount <= 1:
        raise ValueError(f"discount must be a number above 0 and at most 1, got {discount!r}")


def _find_robot(robot: AnyRobot) -> Robot:
    if isinstance(robot, Robot):
        return robot
    path = os.fspath(robot) if isinstance(robot, str | os.PathLike) else None
    if not isinstance(path, str):
        what = f"one of {', '.join(names('robot'))}, the path of an MJCF file or a Robot"
        raise TypeError(f"robot must be {what}, got {checks.short(robot)}")
    return mjcf.load(path) if path.endswith(".xml") else _find("robot", path)


def _find(kind: str, name: str) -> Any:
    check(kind, name)
    return getattr(importlib.import_module(f"envs.{kind}s.{name}"), kind.upper())
