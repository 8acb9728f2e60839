"""Batched manipulation environments in MuJoCo MJX with cameras and scripted experts.

import envs
env = envs.make("press", robot="piper", num_envs=64, image_size=64)
episodes = envs.collect("press", robot="panda", num_episodes=512, key=jax.random.key(0))
"""

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

import envs.compilation.fast_cpu  # first: it must run before anything starts JAX
import envs.interop.ids

if TYPE_CHECKING:
    from envs import robots  # noqa: F401  envs.robots.piper is public
    from envs.datasets import rlds
    from envs.datasets.episodes import Episodes
    from envs.env import Env
    from envs.experts.collection import collect, expert_success
    from envs.making import make
    from envs.scene.randomization import Randomization
    from envs.state import State, Trajectory

__all__ = [
    "Env",
    "Episodes",
    "Randomization",
    "State",
    "Trajectory",
    "collect",
    "expert_success",
    "make",
    "rlds",
]

_MODULES = {
    "Env": "env",
    "Episodes": "datasets.episodes",
    "Randomization": "scene.randomization",
    "State": "state",
    "Trajectory": "state",
    "collect": "experts.collection",
    "expert_success": "experts.collection",
    "make": "making",
}

envs.interop.ids.register()


def __getattr__(name: str) -> Any:
    """Import public names and modules lazily: importing MJX delays `--help` by seconds."""
    if name in _MODULES:
        return getattr(importlib.import_module(f"envs.{_MODULES[name]}"), name)
    if name == "rlds":
        return importlib.import_module("envs.datasets.rlds")
    if importlib.util.find_spec(f"envs.{name}") is None:
        raise AttributeError(f"module 'envs' has no attribute {name!r}")
    return importlib.import_module(f"envs.{name}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
