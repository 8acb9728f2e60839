"""The environment's contract: errors, determinism, latching, freezing, restarting, lowering."""

import dataclasses
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.experts import expert
from tests.envs.demonstrations import demonstration

W = 4


@pytest.fixture(scope="module")
def start(env):
    return env.reset(jax.random.key(0))


@pytest.fixture(scope="module")
def moved(env, start):
    return env.step(start, start.info["command"] + 0.05)


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def take(state, worlds):
    return jax.tree.map(lambda x: np.asarray(x)[worlds], state)


def test_time(env):
    assert (env.physics_dt, env.control_dt, env.max_steps) == (0.005, 0.1, 80)
    assert env.expert_steps <= env.max_steps


def test_reset_is_random_and_repeatable(env, start):
    assert_equal(start, env.reset(jax.random.key(0)))
    other = env.reset(jax.random.key(1))
    for a in (start.info["layout"]["button"], start.info["command"]):
        assert len(np.unique(np.asarray(a), axis=0)) == W
    assert not np.array_equal(start.info["command"], other.info["command"])
    assert set(np.asarray(start.info["instruction"])) <= set(range(len(env.instructions)))


def test_start_is_near_home(env, start):
    away = np.abs(np.asarray(start.info["command"])[:, :-1] - env.robot.home)
    assert 0.01 < away.max() <= 0.03 + 1e-6  # rad
    np.testing.assert_allclose(start.info["command"][:, -1], 0.04)  # m, gripper open
    assert np.all(start.data.qvel == 0)


def test_state_has_one_axis_and_strong_types(start, moved):
    """The output of a step must have the type of its input, or a second call recompiles."""

    def signature(state):
        leaves = jax.tree_util.tree_leaves_with_path(state)
        return {jax.tree_util.keystr(path): leaf.aval for path, leaf in leaves}

    assert signature(start) == signature(moved)
    for name, aval in signature(start).items():
        assert aval.shape[:1] == (W,), name
        assert not aval.weak_type, name


def test_step_is_repeatable_and_moves_the_robot(env, start, moved):
    again = env.step(start, start.info["command"] + 0.05)
    assert_equal(moved, again)
    change = np.asarray(env.proprio(moved) - env.proprio(start))[:, :6]
    assert np.all(change > 0.005)
    assert np.all(moved.info["steps"] == 1)
    assert not np.any(moved.done)


def test_worlds_are_independent(env, start, moved):
    action = (start.info["command"] + 0.05).at[2:].add(-0.1)
    assert_equal(take(env.step(start, action), [0, 1]), take(moved, [0, 1]))


def test_commands_are_limited(env, start):
    state = env.step(start, jnp.full((W, 7), 100.0))
    change = np.asarray(state.info["command"] - start.info["command"])
    np.testing.assert_allclose(change[:, 0], 0.3, atol=1e-6)  # 3 rad/s for 0.1 s
    for _ in range(15):
        state = env.step(state, jnp.full((W, 7), 100.0))
    np.testing.assert_allclose(state.info["command"], np.tile(env.action_high, (W, 1)), rtol=1e-6)


def test_time_limit_latches_and_freezes(env, start):
    late = dataclasses.replace(
        start, info=start.info | {"steps": jnp.array([78, 79, 0, 79], jnp.int32)}
    )
    state = env.step(late, start.info["command"])
    assert state.done.tolist() == [False, True, False, True]
    assert not np.any(state.info["success"])
    after = env.step(state, start.info["command"] + 0.1)
    assert_equal(take(after, [1, 3]), take(state, [1, 3]))
    assert after.done.tolist() == [True, True, False, True]
    assert after.info["steps"].tolist() == [80, 80, 2, 80]
    again = env.reset_done(after, jax.random.key(5))
    assert again.done.tolist() == [False] * W
    assert again.info["steps"].tolist() == [0, 0, 2, 0]
    assert_equal(take(again, [2]), take(after, [2]))
    assert_equal(take(again, [0, 1, 3]), take(env.reset(jax.random.key(5)), [0, 1, 3]))


def test_success_latches(env, start):
    history = [after for _, _, after in demonstration(env, start)]
    success = np.stack([s.info["success"] for s in history])
    np.testing.assert_array_equal(success, np.stack([s.done for s in history]))
    np.testing.assert_array_equal(success, np.stack([s.reward for s in history]))
    assert np.all(success[-1])
    assert np.all(np.diff(success.astype(int), axis=0) >= 0)
    first = int(success.any(axis=1).argmax())
    world = int(success[first].argmax())
    assert_equal(take(history[first], [world]), take(history[-1], [world]))


def test_broken_worlds_are_done(env, start):
    velocity = start.data.qvel.at[1, 0].set(jnp.nan)
    state = env.step(
        dataclasses.replace(start, data=start.data.replace(qvel=velocity)), start.info["command"]
    )
    assert state.done.tolist() == [False, True, False, False]
    assert not np.any(state.info["success"])
    np.testing.assert_array_equal(state.info["broken"], state.done)
    assert not env.reset_done(state, jax.random.key(5)).info["broken"].any()
    state = env.step(start, start.info["command"].at[2].set(jnp.nan))
    assert state.done.tolist() == [False, False, True, False]
    assert np.all(np.isfinite(env.proprio(state)))


def test_observation(env, start):
    found = env.observe(start)
    assert found["image"].keys() == set(env.cameras)
    for image in found["image"].values():
        assert image.shape == (W, 16, 16, 3)
        assert image.dtype == jnp.uint8
        assert image.std() > 5
    assert found["state"].dtype == jnp.float32
    np.testing.assert_allclose(found["state"], start.info["command"], atol=1e-6)


def test_images_belong_to_the_named_cameras(env, start):
    before = env.observe(start)["image"]
    assert tuple(before) == env.cameras == ("side", "wrist")
    for name in env.cameras:
        position = start.data.cam_xpos.at[:, env.model.camera(name).id].add(0.1)
        moved = dataclasses.replace(start, data=start.data.replace(cam_xpos=position))
        after = env.observe(moved)["image"]
        assert {n for n in after if np.any(after[n] != before[n])} == {name}


def test_lowers_for_every_accelerator(env):
    def episode(key):
        state = env.reset(key)
        plan = expert.plan(env, state, key)
        state = env.step(state, expert.act(env, plan, state))
        return env.observe(env.reset_done(state, key))

    traced = jax.jit(episode).trace(jax.random.key(0))
    assert "f64" not in traced.lower(lowering_platforms=("cpu", "cuda", "tpu")).as_text()


def test_import_is_fast():
    code = (
        "import envs, envs.__main__, jax, sys\n"
        "from jax._src import xla_bridge\n"
        "heavy = {'mujoco.mjx', 'warp', 'scipy.optimize'} & set(sys.modules)\n"
        "sys.exit(str(heavy or 'JAX') if heavy or xla_bridge.backends_are_initialized() else 0)"
    )
    root = os.path.dirname(os.path.dirname(envs.__file__))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, cwd=root, check=True)
    assert done.stdout == b""
