"""Scenes and expert episodes shared by tests; each is compiled once per session."""

import functools
import itertools

import jax
import numpy as np
import pytest

import envs
from envs.names import names

NAMES = {"task_name": names("task"), "robot_name": names("robot")}
EPISODES = 16
SHORT = ("press", "piper")  # episodes of these are tested in every run


def pytest_generate_tests(metafunc):
    """Parametrize tests with a task or robot over all of them, unless they choose themselves.

    Every scene compiles anew, so the fast tests have one episode, and each task and robot once.
    """
    chosen = {mark.args[0] for mark in metafunc.definition.iter_markers("parametrize")}
    free = [name for name in NAMES if name in metafunc.fixturenames and name not in chosen]
    enough = all if "episodes" in metafunc.fixturenames else any
    cases = []
    for case in itertools.product(*(NAMES[name] for name in free)):
        fast = len(case) < 2 or enough(map(SHORT.__contains__, case))
        cases.append(pytest.param(*case, marks=() if fast else pytest.mark.slow))
    if free:
        metafunc.parametrize(free, cases)


@functools.cache
def _make(task: str, robot: str, num_envs: int) -> envs.Env:
    return envs.make(task, robot, num_envs=num_envs, image_size=16)


@functools.cache
def _collect(task: str, robot: str) -> envs.Episodes:
    key = jax.random.key(7)
    found = envs.collect(
        task, robot, num_episodes=EPISODES, num_envs=EPISODES, key=key, image_size=16
    )
    return jax.tree.map(np.asarray, found)


@pytest.fixture
def scene(task_name, robot_name) -> envs.Env:
    """An environment that is inspected, never stepped or compiled."""
    return _make(task_name, robot_name, 1)


@pytest.fixture
def episodes(task_name, robot_name) -> envs.Episodes:
    """Successful expert episodes, as NumPy arrays."""
    return _collect(task_name, robot_name)


@pytest.fixture(scope="session")
def env() -> envs.Env:
    """An environment with four worlds of one task."""
    return _make("press", "piper", 4)
