"""Gymnasium ids of all tasks and robots: `lorasp_jax/<task>-<robot>-v0`.

import gymnasium, envs
worlds = gymnasium.make_vec("lorasp_jax/press-piper-v0", num_envs=4, reward="dense")
"""

import itertools

from envs.names import names


def register() -> None:
    """Register the ids if Gymnasium is installed; environments are imported on first use."""
    try:
        import gymnasium
    except ImportError:
        return
    for task, robot in itertools.product(names("task"), names("robot")):
        gymnasium.register(
            f"lorasp_jax/{task}-{robot}-v0",
            entry_point="envs.interop.gymnasium:make",
            vector_entry_point="envs.interop.gymnasium:make_vec",
            kwargs={"task": task, "robot": robot},
        )
