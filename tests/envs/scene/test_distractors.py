"""Distractors stay clear of the task, are solid and visible, and change nothing else."""

import jax
import mujoco
import numpy as np
import pytest

import envs
from envs.scene import distractors


@pytest.mark.parametrize("robot_name", ["piper"])
def test_positions_are_clear_and_random(scene):
    @jax.jit
    @jax.vmap
    def draw(key):
        layout = scene.task.place(key)
        return layout, distractors.place(key, layout, 4)

    layout, found = draw(jax.random.split(jax.random.key(0), 256))
    assert list(found) == [f"distractor{i}" for i in range(4)]
    everything = np.stack([*layout.values(), *found.values()], axis=1)[..., :2]
    for i in range(len(layout), len(layout) + 4):
        gap = np.linalg.norm(everything[:, i : i + 1] - everything[:, :i], axis=-1).min(axis=1)
        assert gap.min() > 0.06
        assert np.mean(gap > 0.0999) > (0.4 if scene.task.name == "two_baskets" else 0.9)
        assert everything[:, i].std(axis=0).min() > 0.03


def test_only_the_chosen_number_is_there(robot_name):
    plain, full = envs.make("press", robot_name), envs.make("press", robot_name, distractors=3)
    names = {full.model.body(i).name for i in range(full.model.nbody)}
    assert names - {plain.model.body(i).name for i in range(plain.model.nbody)} == {
        f"distractor{i}" for i in range(3)
    }
    assert plain.model.nu == full.model.nu


def test_a_grape_does_not_fall_through(monkeypatch):
    model = envs.make("pick_place", distractors=1).model
    data = mujoco.MjData(model)
    model.body("distractor0").pos[:] = 0.36, 0.0, 0.016
    data.joint("grape").qpos[:3] = 0.36, 0.0, 0.06
    data.qpos[:6] = 0, 1.0, -0.6, 0, 0, 0
    data.ctrl[:6] = data.qpos[:6]
    for _ in range(200):
        mujoco.mj_step(model, data)
    assert data.body("grape").xpos[2] == pytest.approx(0.032 + 0.015, abs=2e-3)
