"""How a dataset is made: what must be the same for the same episodes to come out."""

import argparse
import dataclasses
import hashlib
from typing import Any

import jax
import mujoco
import numpy as np

import envs


def recipe(options: argparse.Namespace, env: envs.Env) -> dict[str, Any]:
    """All that the episodes depend on."""
    return {
        "task": env.task.name,
        "robot": options.robot,
        "model": _digest(env),
        "num_episodes": options.num_episodes,
        "num_envs": env.num_envs,
        "image_size": env.image_size,
        "antialias": env.antialias,
        "control_dt": env.control_dt,
        "actions": env.actions,
        "distractors": env.distractors,
        "action_noise": options.action_noise,
        "randomize": dataclasses.asdict(drawn) if (drawn := ranges(options)) else None,
        "seed": options.seed,
        "physics": env.physics.backend,
        "device": jax.default_backend(),
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
    }


def ranges(options: argparse.Namespace) -> envs.Randomization | None:
    """What differs from world to world."""
    return envs.Randomization.typical() if options.randomize else None


def _digest(env: envs.Env) -> str:
    """SHA-256 of the scene and of how its robot may move: a user may edit the robot's file."""
    scene = np.empty(mujoco.mj_sizeModel(env.model), np.uint8)
    mujoco.mj_saveModel(env.model, None, scene)
    found = hashlib.sha256(scene.tobytes())
    for field in dataclasses.fields(env.robot):
        if field.name not in ("name", "body"):  # the body is in the scene
            found.update(np.asarray(getattr(env.robot, field.name)).tobytes())
    return found.hexdigest()
