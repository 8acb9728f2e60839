"""Batched manipulation environments in MuJoCo MJX with cameras and scripted experts.

import envs
env = envs.make("press", robot="piper", num_envs=64, image_size=64)
episodes = envs.collect("press", robot="panda", num_episodes=512, key=jax.random.key(0))
"""

import envs.fast_cpu  # first: it must come before anything starts JAX
import envs.ids
import envs.robots.panda
import envs.robots.piper  # envs.robots.piper.forward_kinematics is public
from envs.collection import collect, expert_success
from envs.env import Env
from envs.episodes import Episodes
from envs.making import make
from envs.randomization import Randomization
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
]

envs.ids.register()
