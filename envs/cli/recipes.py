"""The recipe of a dataset: all settings that determine its episodes."""

import argparse
import dataclasses
from typing import Any

import jax
import mujoco

import envs
from envs import traced


def recipe(options: argparse.Namespace, env: envs.Env) -> dict[str, Any]:
    """Return everything that the episodes depend on, as JSON values."""
    return {
        "task": env.task.name,
        "robot": options.robot,
        "model": traced.digest(env),  # changes if the user edits the robot's file
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
    """Return the ranges of domain randomization, if any."""
    return envs.Randomization.typical() if options.randomize else None
