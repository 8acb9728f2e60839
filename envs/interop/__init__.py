"""The environments in the forms that other libraries expect, each behind an optional dependency.

from envs.interop.gymnasium import VectorEnv  # pip install -e ".[gymnasium]"
from envs.interop.brax import BraxEnv  # pip install -e ".[brax]"
"""
