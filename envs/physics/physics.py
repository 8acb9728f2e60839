"""Simulate physics with MJX in JAX, with MuJoCo Warp or with MuJoCo's C engine.

Worlds are batched by `jax.vmap`. Between steps, all engines describe a world by the same `Data`.
"""

import contextlib
import copy
import dataclasses
import functools
import importlib.util
import io
import types
from collections.abc import Sequence
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs import checks
from envs.physics.kinematics import Kinematics
from envs.scene.ranges import MAX_GROWTH
from envs.state import MOVING, Changes, Data

Backend = Literal["jax", "warp", "mujoco"]
BACKENDS: tuple[str, ...] = get_args(Backend)
"""jax runs everywhere; warp is much faster on NVIDIA GPUs, and runs on CPU, slowly, for tests;
mujoco, the C engine, is much faster on CPU."""


@functools.cache
def _mjx() -> Any:
    """Import MJX late, since importing it with `envs` would delay `--help` by seconds."""
    if importlib.util.find_spec("warp"):
        import warp

        warp.config.log_level = warp.LOG_WARNING  # otherwise every loaded kernel prints a line
    with contextlib.redirect_stdout(io.StringIO()):  # MJX prints two lines if warp-lang is missing
        from mujoco import mjx
    # MJX sums over a body's children with scatters. Their order of addition is undefined on GPU: on
    # an H200, two calls with the same input differed in the last bits.
    ordered = types.SimpleNamespace(**vars(jax))
    ordered.ops = types.SimpleNamespace(segment_sum=_sum_in_order)
    mujoco.mjx._src.scan.jax = ordered
    return mjx


def _sum_in_order(values: jax.Array, segments: np.ndarray, num_segments: int) -> jax.Array:
    """Replace `jax.ops.segment_sum` for a few static segments, adding from first to last."""
    rows = [np.flatnonzero(segments == segment) for segment in range(num_segments)]
    if all(len(row) == 1 for row in rows):
        return values[np.concatenate(rows)]
    return jnp.stack([sum((values[i] for i in row), jnp.zeros_like(values[0])) for row in rows])


def default_backend() -> str:
    """Choose warp on a single NVIDIA GPU if warp-lang is installed, else jax."""
    nvidia = jax.default_backend() == "gpu" and "cuda" in jax.devices()[0].client.platform_version
    single = jax.device_count() == 1  # Warp's CUDA graphs are bound to one GPU
    return "warp" if nvidia and single and importlib.util.find_spec("warp") else "jax"


class Physics:
    """Simulator of one MuJoCo model; methods are pure and take one world each.

    Poses are always computed in JAX, which is cheap and makes `reset` independent of the engine.
    """

    def __init__(self, model: mujoco.MjModel, backend: str) -> None:
        """Put a model on the device.

        Raises:
            ValueError: the backend is unknown, not installed, or not for JAX's devices.
        """
        checks.choice("backend", backend, BACKENDS)
        if backend == "warp":
            require_warp("backend")
        if backend == "mujoco" and jax.default_backend() != "cpu":
            raise ValueError(f"backend 'mujoco' needs JAX on a CPU, not a {jax.default_backend()}")
        self.model: mujoco.MjModel = model
        self.backend: str = backend
        mjx = _mjx()
        device = jax.local_devices()[0]  # MJX's default is the first device of all processes
        self._model = mjx.put_model(model, impl="jax", device=device)
        data = mjx.make_data(model, impl="jax", device=device)
        self._data = jax.device_put(jax.tree.map(np.asarray, data))  # without weak types
        self._kinematics = Kinematics(model)
        self._with_poses = jax.jit(self._with_poses)  # traced once for `start` and `advance`
        self._simulate = self._mjx_steps
        if backend == "warp":
            from envs.physics.warp import WarpSteps

            # MJX-JAX sizes its arrays for the most contacts and constraints a world can have.
            most = {"contacts": max(data._impl.ncon, 1), "rows": data._impl.nefc}
            self._simulate = WarpSteps(_with_larger_bounds(model), **most)
        elif backend == "mujoco":
            from envs.physics.c_engine import MujocoSteps

            self._simulate = MujocoSteps(_with_larger_bounds(model))

    def start(self, changes: Changes, qpos: jax.Array) -> Data:
        """Return a world at rest at these joint positions."""
        zero = jnp.zeros_like(self._data.qvel)
        return self._with_poses(changes, [qpos, zero, zero])

    def advance(self, changes: Changes, data: Data, controls: jax.Array) -> Data:
        """Simulate one world for S physics steps; return it with all poses up to date.

        Args:
            changes: fields of the model that differ in this world.
            data: the world before these steps.
            controls: `[S, nu]` actuator targets, one row per physics step.
        """
        return self._with_poses(changes, self._simulate(changes, data, controls))

    def _mjx_steps(self, changes: Changes, start: Data, controls: jax.Array) -> Sequence[jax.Array]:
        """Return the `MOVING` fields of a world after S physics steps."""
        model = self._model.replace(**changes)

        def body(moving: Sequence[jax.Array], control: jax.Array) -> tuple[Any, None]:
            now = dict(zip(MOVING, moving, strict=True))
            data = self._step(model, self._data.replace(ctrl=control, **now))
            return [getattr(data, name) for name in MOVING], None

        # Carry nothing else: `vmap` retraces a scan if part of its carry starts out unbatched.
        with _full_precision():
            return jax.lax.scan(body, [getattr(start, name) for name in MOVING], controls)[0]

    def _step(self, model: Any, data: Any) -> Any:
        """Run `mjx.step` without tendons, sensors and mocap bodies, which our scenes lack."""
        mjx = _mjx()
        data = mjx.com_pos(model, self._kinematics(model, data))
        data = mjx.factor_m(model, mjx.crb(model, data))
        data = mjx.make_constraint(model, mjx.collision(model, data))
        data = mjx.transmission(model, data)
        data = mjx.fwd_velocity(model, data)
        data = mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data))
        return mjx.implicit(model, mjx.solve(model, data))

    def _with_poses(self, changes: Changes, moving: Sequence[jax.Array]) -> Data:
        """Compute all poses from the joint positions."""
        model = self._model.replace(**changes)
        data = self._data.replace(**dict(zip(MOVING, moving, strict=True)))
        mjx = _mjx()
        with _full_precision():
            data = mjx.camlight(model, mjx.com_pos(model, self._kinematics(model, data)))
        return Data(**{field.name: getattr(data, field.name) for field in dataclasses.fields(Data)})


def _with_larger_bounds(model: mujoco.MjModel) -> mujoco.MjModel:
    """Copy the model with bounding volumes for the largest geoms that a world may have."""
    model = copy.copy(model)
    bounded = model.geom_rbound > 0  # planes have none
    model.geom_rbound[bounded] *= MAX_GROWTH
    model.geom_aabb[bounded, 3:] *= MAX_GROWTH
    return model


def require_warp(option: str) -> None:
    """Check that warp-lang, which `option` asks for, is installed and can run here.

    Raises:
        ValueError: warp-lang is missing, or JAX sees more than one GPU.
    """
    if not importlib.util.find_spec("warp"):
        raise ValueError(f"{option} 'warp' needs warp-lang: pip install -e '.[warp]'")
    if jax.default_backend() == "gpu" and jax.device_count() > 1:
        raise ValueError(
            f"{option} 'warp' needs a single GPU, but JAX sees {jax.device_count()}: "
            "set CUDA_VISIBLE_DEVICES to one of them"
        )


def _full_precision() -> Any:
    # The default on GPU (TF32) and TPU (bf16) is too coarse for the constraint solver.
    return jax.default_matmul_precision("highest")
