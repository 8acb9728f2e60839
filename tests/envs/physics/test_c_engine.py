"""MuJoCo's C engine inside jit against a loop of `mj_step`, and against MJX."""

import copy
import itertools
import subprocess
import sys
import textwrap

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs.physics.physics import Physics
from envs.scene.ranges import Randomization
from envs.state import MOVING
from tests.envs.demonstrations import demonstration, expert_success

WORLDS = 4
RANGES = Randomization(
    size=(0.8, 1.25),
    mass=(0.5, 2.0),
    friction=(0.5, 1.5),
    gains=(0.8, 1.2),
    table_height=(-0.04, 0.04),
)


@pytest.fixture(scope="module")
def fast() -> envs.Env:
    return envs.make("press", "piper", num_envs=WORLDS, image_size=16, backend="mujoco")


@pytest.fixture(scope="module")
def start(fast) -> envs.State:
    return fast.reset(jax.random.key(3))


def after(env, state, steps):
    """Return the worlds after some control steps of the expert."""
    return next(itertools.islice(demonstration(env, state), steps - 1, None))[2]


def moving(data):
    return {name: np.asarray(getattr(data, name)) for name in MOVING}


def assert_equal(a, b):
    for name, value in moving(a).items():
        np.testing.assert_array_equal(value, moving(b)[name])


def test_steps_are_those_of_mujoco():
    """In randomized worlds, whose model fields all differ."""
    env = envs.make("pour", "piper", num_envs=WORLDS, image_size=16, backend="mujoco")
    state = env.reset(jax.random.key(3), RANGES)
    changes = jax.jit(jax.vmap(env._changes))(state.info["draw"], state.info["layout"])
    rng = np.random.default_rng(0)
    command = np.asarray(state.info["command"])[:, None]
    controls = command + rng.normal(0, 0.02, (WORLDS, 60, command.shape[-1]))
    controls = np.asarray(controls, np.float32)
    found = jax.jit(jax.vmap(env.physics.advance))(changes, state.data, controls)
    contacts = 0
    for world in range(WORLDS):
        model = copy.copy(env.model)
        for name, value in changes.items():
            getattr(model, name)[:] = value[world]
        model.geom_rbound *= 1.25
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE  # its boxes are the model's
        data = mujoco.MjData(model)
        data.qpos[:] = state.data.qpos[world]
        for control in controls[world]:
            data.ctrl[:] = control
            mujoco.mj_step(model, data)
            contacts += data.ncon
        for name, value in moving(found).items():
            np.testing.assert_allclose(value[world], getattr(data, name), rtol=1e-6, atol=1e-6)
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(found.xpos[world], data.xpos, atol=1e-6)
    assert contacts
    assert not np.array_equal(changes["body_mass"][0], changes["body_mass"][1])


def test_agrees_with_mjx(env, fast):
    """For 30 control steps of the expert, at the end of which some buttons are pressed."""
    ours, theirs = (after(x, x.reset(jax.random.key(3)), 30) for x in (fast, env))
    assert np.ptp(ours.metrics["button_depth"]) > 0.001
    np.testing.assert_allclose(ours.data.qpos, theirs.data.qpos, atol=1e-4)
    np.testing.assert_allclose(ours.data.xpos, theirs.data.xpos, atol=1e-4)


@pytest.mark.slow
def test_agrees_with_mjx_in_randomized_worlds():
    """For 40 control steps, at the end of which most worlds have lifted the lid."""
    options = {"num_envs": WORLDS, "image_size": 16}
    pair = [envs.make("open_pot", **options, backend=b) for b in ("mujoco", "jax")]
    ours, theirs = (after(env, env.reset(jax.random.key(2), RANGES), 40) for env in pair)
    lid = pair[0].model.body("lid").id
    np.testing.assert_allclose(ours.data.qpos[:, :8], theirs.data.qpos[:, :8], atol=2e-3)
    np.testing.assert_allclose(ours.data.xpos[:, lid], theirs.data.xpos[:, lid], atol=3e-3)


@pytest.mark.slow
@pytest.mark.parametrize("robot_name", ["piper"])
def test_experts_succeed_as_often_as_in_mjx(task_name, robot_name):
    ours, theirs = (
        expert_success(task_name, robot_name, num_episodes=32, num_envs=32, backend=backend)
        for backend in ("mujoco", "jax")
    )
    assert abs(int(ours.sum()) - int(theirs.sum())) <= 1


@pytest.mark.filterwarnings("error")
def test_a_world_that_diverges_is_broken_alone(fast, start, tmp_path, monkeypatch, capfd):
    """By a velocity, or by an action: MuJoCo would restart the one and ignore the other."""
    monkeypatch.chdir(tmp_path)  # where MuJoCo would write its log
    action = start.info["command"] + 0.02
    fine = fast.step(start, action)
    fast_arm = start.data.replace(qvel=start.data.qvel.at[1, 0].set(1e12))
    state = fast.step(
        envs.State(fast_arm, start.reward, start.done, start.metrics, start.info),
        action.at[2].set(jnp.nan),
    )
    np.testing.assert_array_equal(state.info["broken"], [False, True, True, False])
    np.testing.assert_array_equal(state.done, state.info["broken"])
    for name, value in moving(state.data).items():
        np.testing.assert_array_equal(value[::3], moving(fine.data)[name][::3])
        np.testing.assert_array_equal(value[1:3], moving(fast_arm)[name][1:3])
    assert not list(tmp_path.iterdir())
    assert "unstable" not in capfd.readouterr().err
    assert_equal(fast.step(start, action).data, fine.data)  # nothing remains of it


def test_the_same_in_loops_batches_and_on_several_devices(fast, start):
    action = start.info["command"] + 0.02
    once = fast.step(start, action)
    twice = fast.step(once, action)

    def loop(state):
        return jax.lax.scan(lambda x, _: (fast.step(x, action), None), state, length=2)[0]

    assert_equal(jax.jit(loop)(start).data, twice.data)
    nested = jax.tree.map(lambda x: jnp.stack([x, x]), (start, action))
    both = jax.jit(jax.vmap(fast._batched_step))(*nested)
    assert_equal(jax.tree.map(lambda x: x[1], both.data), once.data)
    mesh = jax.sharding.Mesh(jax.devices()[:WORLDS], "data")
    worlds = jax.NamedSharding(mesh, jax.P("data"))
    spread = fast.step(*jax.device_put((start, action), worlds))
    assert len(spread.data.qpos.sharding.device_set) == WORLDS
    assert_equal(spread.data, once.data)


_THREADS = """
    import os
    os.sched_setaffinity(0, [0])
    import jax, threading, envs
    env = envs.make("press", num_envs=300, image_size=16, backend="mujoco")
    state = env.reset(jax.random.key(0))
    loop = lambda x, a: jax.lax.scan(lambda x, _: (env.step(x, a), None), x, length=5)[0]
    loop = jax.jit(loop)
    action = state.info["command"]
    jax.block_until_ready(loop(state, action))
    run = lambda: jax.block_until_ready(env.step(loop(loop(state, action), action), action))
    threads = [threading.Thread(target=run) for _ in range(4)]
    [x.start() for x in threads]
    [x.join() for x in threads]
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="needs CPU affinity")
def test_threads_on_one_core_do_not_wait_forever():
    """As they did with `jax.pure_callback`."""
    code = textwrap.dedent(_THREADS)
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_needs_a_cpu(env, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with pytest.raises(ValueError, match="'mujoco' needs JAX on a CPU, not a gpu"):
        Physics(env.model, "mujoco")
