"""Adapt the environments to other libraries, each an optional dependency.

from envs.interop.gymnasium import VectorEnv  # pip install -e ".[gymnasium]"
from envs.interop.brax import BraxEnv  # pip install -e ".[brax]"
"""
