"""Physics behind one small class; the only file that names MJX, `warp_physics` being its guest.

Worlds are batched by `jax.vmap`. What a world keeps between two steps is the same for all engines.
"""

import contextlib
import dataclasses
import functools
import importlib.util
import io
import sys
import types
from collections.abc import Sequence
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics.kinematics import Kinematics
from envs.state import MOVING, Changes, Data

Backend = Literal["jax", "warp"]
BACKENDS: tuple[str, ...] = get_args(Backend)
"""jax runs everywhere; warp on NVIDIA, much faster there, and for tests on CPU, slowly."""

MOST_GROWTH = 1.25  # of a geom that differs in size from its model


@functools.cache
def _mjx() -> Any:
    """MJX, imported when the first environment is made: it takes seconds, which no help needs."""
    if importlib.util.find_spec("warp"):
        import warp

        warp.config.log_level = warp.LOG_WARNING  # else every kernel that is loaded prints a line
    # MJX prints two lines when the optional warp-lang is missing. Only these are dropped.
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        from mujoco import mjx
    for line in printed.getvalue().splitlines():
        if not line.startswith(("Failed to import warp:", "Failed to import mujoco_warp:")):
            print(line, file=sys.stdout)
    # Sums over the children of bodies. MJX leaves them to scatters, which GPUs add up in any order:
    # on an H200, two calls with the same input differed in the last bits.
    ordered = types.SimpleNamespace(**vars(jax))
    ordered.ops = types.SimpleNamespace(segment_sum=_sum_in_order)
    mujoco.mjx._src.scan.jax = ordered
    return mjx


def _sum_in_order(values: jax.Array, segments: np.ndarray, number: int) -> jax.Array:
    """`jax.ops.segment_sum` for few segments that are known, first to last."""
    rows = [np.flatnonzero(segments == segment) for segment in range(number)]
    if all(len(row) == 1 for row in rows):
        return values[np.concatenate(rows)]
    return jnp.stack([sum((values[i] for i in row), jnp.zeros_like(values[0])) for row in rows])


def default_backend() -> str:
    """warp on one NVIDIA GPU where warp-lang is installed, else jax."""
    nvidia = jax.default_backend() == "gpu" and "cuda" in jax.devices()[0].client.platform_version
    alone = jax.device_count() == 1  # Warp's graphs belong to one GPU
    return "warp" if nvidia and alone and importlib.util.find_spec("warp") else "jax"


class Physics:
    """A MuJoCo model that worlds share; functions are pure and for one world each.

    Poses always come from MJX-JAX: they are cheap, and that makes a reset the same everywhere.
    """

    def __init__(self, model: mujoco.MjModel, backend: str) -> None:
        """Put a model on the device.

        Raises:
            ValueError: for an unknown backend, or one that is not installed.
        """
        _check_backend(backend)
        self.backend = backend
        mjx = _mjx()
        own = jax.local_devices()[0]  # MJX would take the first of all processes
        self._model = mjx.put_model(model, impl="jax", device=own)
        data = mjx.make_data(model, impl="jax", device=own)
        self._data = jax.device_put(jax.tree.map(np.asarray, data))  # strongly typed
        self._kinematics = Kinematics(model)
        self._posed = jax.jit(self._posed)  # traced once for a start and a step
        self._simulate = self._mjx_steps
        if backend == "warp":
            from envs.physics.warp import WarpSteps

            # MJX-JAX has counted the most contacts and constraints that a world can have.
            most = {"contacts": max(data._impl.ncon, 1), "rows": data._impl.nefc}
            self._simulate = WarpSteps(model, growth=MOST_GROWTH, **most)

    def start(self, changes: Changes, qpos: jax.Array) -> Data:
        """A world at rest at these positions."""
        zero = jnp.zeros_like(self._data.qvel)
        return self._posed(changes, [qpos, zero, zero])

    def advance(self, changes: Changes, data: Data, controls: jax.Array) -> Data:
        """Simulate one world for S physics steps.

        Args:
            changes: how its model differs.
            data: where it is.
            controls: `[S, nu]` actuator targets, one row a physics step.

        Returns:
            The data after S steps, all poses up to date.
        """
        return self._posed(changes, self._simulate(changes, data, controls))

    def _mjx_steps(self, changes: Changes, start: Data, controls: jax.Array) -> Sequence[jax.Array]:
        """The `MOVING` of a world after S physics steps."""
        model = self._model.replace(**changes)

        def body(moving: Sequence[jax.Array], control: jax.Array) -> tuple[Any, None]:
            now = dict(zip(MOVING, moving, strict=True))
            data = self._step(model, self._data.replace(ctrl=control, **now))
            return [getattr(data, name) for name in MOVING], None

        # Nothing else is carried: `vmap` traces a scan once more if part of its carry starts out
        # the same in all worlds.
        with _full_precision():
            return jax.lax.scan(body, [getattr(start, name) for name in MOVING], controls)[0]

    def _step(self, model: Any, data: Any) -> Any:
        """`mjx.step`, of what the scenes have: no tendons, no sensors, no mocap bodies."""
        mjx = _mjx()
        data = mjx.com_pos(model, self._kinematics(model, data))
        data = mjx.factor_m(model, mjx.crb(model, data))
        data = mjx.make_constraint(model, mjx.collision(model, data))
        data = mjx.transmission(model, data)
        data = mjx.fwd_velocity(model, data)
        data = mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data))
        return mjx.implicit(model, mjx.solve(model, data))

    def _posed(self, changes: Changes, moving: Sequence[jax.Array]) -> Data:
        """A world with all poses that follow from its joint positions."""
        model = self._model.replace(**changes)
        data = self._data.replace(**dict(zip(MOVING, moving, strict=True)))
        mjx = _mjx()
        with _full_precision():
            data = mjx.camlight(model, mjx.com_pos(model, self._kinematics(model, data)))
        return Data(**{field.name: getattr(data, field.name) for field in dataclasses.fields(Data)})


def _check_backend(backend: str) -> None:
    if backend not in BACKENDS:
        raise ValueError(f"unknown backend {backend!r}: choose from {', '.join(BACKENDS)}")
    if backend == "warp":
        need_warp("backend")


def need_warp(option: str) -> None:
    """Raises a ValueError if warp-lang, which this option asks for, is not there or cannot work."""
    if not importlib.util.find_spec("warp"):
        raise ValueError(f"{option} 'warp' needs warp-lang: pip install -e '.[warp]'")
    if jax.default_backend() == "gpu" and jax.device_count() > 1:
        raise ValueError(
            f"{option} 'warp' works on one GPU, but JAX sees {jax.device_count()}: "
            "set CUDA_VISIBLE_DEVICES to one of them"
        )


def _full_precision() -> Any:
    # The default on GPU (TF32) and TPU (bf16) is too coarse for the constraint solver.
    return jax.default_matmul_precision("highest")
