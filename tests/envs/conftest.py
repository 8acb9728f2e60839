"""Scenes and expert episodes shared by tests; each is compiled once per session."""

import functools

import jax
import numpy as np
import pytest

import envs
from envs.names import names

TASKS = names("task")
ROBOTS = names("robot")
EPISODES = 32
SHORT = ("press", "piper")  # episodes of these are tested in every run


def pytest_generate_tests(metafunc):
    """Parametrize tests with a task or robot over all of them, unless they choose themselves."""
    chosen = {mark.args[0] for mark in metafunc.definition.iter_markers("parametrize")}
    for name, values in (("task_name", TASKS), ("robot_name", ROBOTS)):
        if name in metafunc.fixturenames and name not in chosen:
            # Compiling episodes takes a minute per scene, so most of these tests are slow.
            long = values if "episodes" in metafunc.fixturenames else []
            marks = {v: [] if v in SHORT else [pytest.mark.slow] for v in long}
            metafunc.parametrize(name, [pytest.param(v, marks=marks.get(v, [])) for v in values])


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
