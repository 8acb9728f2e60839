"""Physics agrees with MuJoCo's and sums in a fixed order, so that results are reproducible."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs import actions
from envs.physics import physics
from envs.scene import placing
from tests.envs.demonstrations import demonstration
from tests.jaxprs import equations


@pytest.mark.parametrize(
    ("segments", "number"),
    [([0], 1), ([1, 0, 2], 3), ([0, 0, 0], 1), ([2, 0, 2, 0], 4), ([1], 2)],
    ids=str,
)
def test_sums_in_order(segments, number):
    segments = np.array(segments)
    for values in (
        np.random.default_rng(0).normal(size=(len(segments), 3)).astype(np.float32),
        np.arange(len(segments), dtype=np.int32) + 1,
    ):
        found = jax.jit(lambda x: physics._sum_in_order(x, segments, number))(values)
        expected = np.zeros((number, *values.shape[1:]), values.dtype)
        np.add.at(expected, segments, values)
        assert found.dtype == expected.dtype
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    order = np.array([1e8, 1.0, -1e8], np.float32)  # the sum depends on the order
    assert physics._sum_in_order(jnp.array(order), np.zeros(3, int), 1)[0] == 0.0


def unordered(function, *arguments):
    """Find scatters that add floats, possibly to the same index, in any order on a GPU."""
    return [
        equation
        for equation in equations(jax.make_jaxpr(function)(*arguments).jaxpr)
        if equation.primitive.name in ("scatter-add", "scatter_add", "scatter-mul", "scatter_mul")
        and jnp.issubdtype(equation.invars[0].aval.dtype, jnp.floating)
        and not equation.params["unique_indices"]
    ]


def test_a_step_sums_in_a_fixed_order(env):
    state = jax.eval_shape(env.reset, jax.random.key(0))
    assert not unordered(env.step, state, state.info["command"])


def test_models_are_on_a_device_of_this_process(monkeypatch):
    """MJX's default is the first device of all processes."""
    monkeypatch.setattr(jax, "local_devices", lambda: jax.devices()[3:])
    env = envs.make("press", num_envs=2, image_size=16)
    assert env.physics._model.opt.timestep.devices() == {jax.devices()[3]}


def test_unordered_sums_are_detected(env):
    def loop(x):
        return jax.lax.scan(
            lambda c, _: (jax.ops.segment_sum(c, jnp.zeros(3, int), 3), 0), x, length=2
        )

    assert len(unordered(jax.jit(loop), jnp.ones(3))) == 1


def test_a_control_step_matches_mujoco(env):
    """Everything in `mj_step` that our scenes use: forces, limits, contacts, the equality."""
    start = env.reset(jax.random.key(3))
    touched = start.metrics["button_depth"][0] + 0.002
    walk = demonstration(env, start)
    state, _, after = next(step for step in walk if step[2].metrics["button_depth"][0] > touched)
    assert not after.done[0]
    model = placing.world_model(env.model, start.info["layout"], 0)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = state.data.qpos[0], state.data.qvel[0]
    data.qacc_warmstart[:] = state.data.qacc_warmstart[0]
    commands = np.stack([s.info["command"][0] for s in (state, state, after)])
    contacts = 0
    interpolate = jax.jit(actions.interpolate, static_argnums=1)
    for control in np.asarray(interpolate(commands, env.control_dt, 0.0)):
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
        contacts += data.ncon
    assert contacts
    np.testing.assert_allclose(after.data.qpos[0], data.qpos, atol=2e-5)
    np.testing.assert_allclose(after.data.qvel[0], data.qvel, atol=2e-3)
