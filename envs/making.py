"""Make environments from the names of a task and a robot."""

import importlib
import os
from typing import Any, Literal, get_args

import mujoco

from envs import checks, mjcf
from envs.actions import TARGET_DT
from envs.env import Env
from envs.names import MODES, Mode, check
from envs.physics import physics
from envs.physics.physics import Backend
from envs.rendering.model import build as build_render_model
from envs.rendering.renderer import RayRenderer, Renderer
from envs.rewards import REWARDS, Reward
from envs.robots import Robot
from envs.scene import scene
from envs.scene.distractors import MAX_COUNT
from envs.scene.distractors import mjcf as distractor_mjcf
from lorasp_jax.base import fast_cpu

AnyRobot = str | os.PathLike[str] | Robot
RendererName = Literal["rays", "warp"]
RENDERERS: tuple[str, ...] = get_args(RendererName)
# Upper bounds beyond any practical use, which only catch typos.
_MAX_ENVS, _MAX_IMAGE_SIZE, _MAX_ANTIALIAS = 2**20, 2**12, 16


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
    """Make an environment.

    Args:
        task: name of a file in `envs/tasks`.
        robot: name of a file in `envs/robots`, path of an MJCF file, or a robot from
            `envs.mjcf.load`.
        num_envs: number of parallel worlds W.
        image_size: height and width of images [px].
        antialias: n, for n x n rays per pixel: smoother edges at n² times the cost.
        control_dt: time between actions [s], a multiple of 0.02.
        actions: action mode: joint, delta_joint or end_effector, see `envs.actions`.
        reward: sparse (1 on success) or dense (shaped by progress), see `envs.rewards`.
        discount: the learner's discount in (0, 1], for the dense reward.
        distractors: number of unrelated objects on the table, up to 4.
        backend: physics engine, jax, warp or mujoco (on CPU); None: warp or jax, by device.
        renderer: rays (runs everywhere) or warp (MuJoCo Warp's, draws meshes and textures, too).

    Raises:
        TypeError: `robot`, `control_dt` or an integer argument has the wrong type.
        ValueError: a name is unknown (the message lists the known ones), the robot is unsuitable,
            the discount is invalid, or another number is out of range.
    """
    fast_cpu.warn_if_late()
    task_definition, robot_model = _find("task", task), _find_robot(robot)
    num_envs = checks.count("num_envs", num_envs, _MAX_ENVS)
    image_size = checks.count("image_size", image_size, _MAX_IMAGE_SIZE)
    antialias = checks.count("antialias", antialias, _MAX_ANTIALIAS)
    distractors = checks.count("distractors", distractors, MAX_COUNT, minimum=0)
    control_dt = _check_dt(control_dt, task_definition.time_limit)
    checks.choice("actions", actions, MODES)
    _check_reward(reward, discount)
    model = scene.build(task_definition.scene + distractor_mjcf(distractors), robot_model)
    return Env(
        task=task_definition,
        robot=robot_model,
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


def _check_reward(reward: str, discount: float) -> None:
    checks.choice("reward", reward, REWARDS)
    if not 0 < checks.number("discount", discount) <= 1:
        raise ValueError(f"discount must be above 0 and at most 1, got {discount!r}")


def _renderer(
    name: str, model: mujoco.MjModel, image_size: int, antialias: int, num_envs: int
) -> Renderer:
    """Make the renderer; Warp's takes cameras and appearance from the ray caster."""
    checks.choice("renderer", name, RENDERERS)
    rays = RayRenderer(build_render_model(model, scene.CAMERAS), image_size, antialias)
    if name == "rays":
        return rays
    physics.require_warp("renderer")
    from envs.rendering.warp import WarpRenderer

    return WarpRenderer(model, rays, num_envs)


def _check_dt(value: float, time_limit: float) -> float:
    """Check the control period [s], and return it as a float."""
    control_dt = checks.number("control_dt", value)
    if control_dt > time_limit:
        raise ValueError(f"control_dt must be at most {time_limit} s, got {control_dt}")
    targets = control_dt / TARGET_DT
    if round(targets) < 1 or abs(targets - round(targets)) > 1e-6:
        raise ValueError(f"control_dt must be a multiple of {TARGET_DT} s, got {control_dt}")
    return control_dt


def _find_robot(robot: AnyRobot) -> Robot:
    if isinstance(robot, Robot):
        return robot
    path = os.fspath(robot)
    return mjcf.load(path) if path.endswith(".xml") else _find("robot", path)


def _find(kind: str, name: str) -> Any:
    check(kind, name)
    return getattr(importlib.import_module(f"envs.{kind}s.{name}"), kind.upper())
