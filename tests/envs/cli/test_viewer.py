"""Replay an episode in a window, replaced by a fake."""

import argparse
import contextlib
import types

import jax
import numpy as np
import pytest
from rich.console import Console

import envs
from envs.cli import commands, viewer

PLAY = argparse.Namespace(task="press", robot="piper", out=None, seed=0)


class Window:
    """Fake of MuJoCo's window that closes after some frames."""

    def __init__(self, model, data, pictures):
        self.model, self.data, self.left = model, data, pictures
        self.seen = []
        self.closed = False

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.closed = True

    def lock(self):
        return contextlib.nullcontext()

    def sync(self):
        self.left -= 1
        self.seen.append(self.data.qpos.copy())

    def is_running(self):
        return self.left > 0


@pytest.mark.slow
def test_play_repeats_an_episode_until_the_window_closes(env, monkeypatch):
    opened, slept = [], []

    def launch(model, data, *, show_left_ui, show_right_ui):
        assert not show_left_ui
        assert not show_right_ui
        opened.append(Window(model, data, pictures=60))
        return opened[0]

    monkeypatch.setattr(envs, "make", lambda *arguments, **options: env)
    monkeypatch.setattr(viewer.glfw, "init", lambda: True)
    monkeypatch.setattr(viewer.mujoco.viewer, "launch_passive", launch)
    monkeypatch.setattr(viewer.time, "sleep", slept.append)
    commands.play(PLAY, Console())
    (window,) = opened
    assert window.closed
    seen = np.array(window.seen)
    assert len(seen) == len(slept) == 60
    assert 0 < np.median(slept) < env.control_dt  # in real time
    # The button is where this world has it, and goes down; then the replay restarts.
    assert not np.allclose(window.model.body("button").pos, env.model.body("button").pos)
    length = int(np.flatnonzero((seen == seen[0]).all(axis=1))[1])
    (button,) = env.model.joint("button").qposadr
    assert seen[0, button] < 0.001
    assert seen[:length, button].max() > 0.009
    np.testing.assert_array_equal(seen[length:], seen[: 60 - length])


def test_without_a_display_the_error_suggests_a_file(monkeypatch):
    monkeypatch.setattr(viewer.glfw, "init", lambda: False)
    with pytest.raises(ValueError, match="--out"):
        commands.play(PLAY, Console())


def test_windows_that_need_another_interpreter(env, monkeypatch):
    def launch(model, data, **panels):
        raise RuntimeError("`launch_passive` requires mjpython on macOS")

    monkeypatch.setattr(viewer.mujoco.viewer, "launch_passive", launch)
    with pytest.raises(ValueError, match=r"mjpython .*--out"):
        viewer.show(env.model, np.zeros((1, env.model.nq)), 0.1)


def test_an_expert_that_never_succeeds_is_an_error(monkeypatch):
    monkeypatch.setattr(viewer, "_plan", lambda *_: None)
    monkeypatch.setattr(viewer, "_act", lambda *_: None)
    state = types.SimpleNamespace(info={"success": np.zeros(4, bool)})
    rest = {"reset": lambda key: state, "step": lambda *_: state}
    with pytest.raises(ValueError, match="32 layouts"):
        viewer.episode(types.SimpleNamespace(num_envs=4, expert_steps=2, **rest), jax.random.key(0))
