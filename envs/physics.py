"""MuJoCo MJX behind a few functions; the only file that names one of its implementations.

Worlds are batched by `jax.vmap` over leading axes of the data; the model is shared.
"""

import contextlib
import io
import os
import sys
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax._src import xla_bridge  # there is no public way to ask whether a backend has started

_IMPL = "jax"  # runs on CPU, GPU and TPU
_FAST_CPU_FLAG = "--xla_cpu_use_fusion_emitters=false"


def _import_mjx() -> Any:
    # MJX prints two lines when the optional warp-lang is missing. Only these are dropped.
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        from mujoco import mjx
    for line in printed.getvalue().splitlines():
        if not line.startswith(("Failed to import warp:", "Failed to import mujoco_warp:")):
            print(line, file=sys.stdout)
    return mjx


mjx = _import_mjx()


def enable_fast_cpu() -> None:
    """Make MJX fast on CPU with JAX < 0.11 (measured: 15 times); does nothing on newer versions.

    Sets an XLA flag, which XLA reads when JAX starts its backend: call this first in a program. If
    a CPU backend has already started without the flag, one warning says so.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if jax.__version_info__ >= (0, 11) or _FAST_CPU_FLAG in flags:
        return  # newer versions need no flag and abort on this one
    if xla_bridge.backends_are_initialized():
        if jax.default_backend() == "cpu":
            warnings.warn(
                f"JAX started before envs.physics.enable_fast_cpu(): simulation on CPU will be "
                f"about 15 times slower; set XLA_FLAGS={_FAST_CPU_FLAG}",
                stacklevel=2,
            )
        return
    os.environ["XLA_FLAGS"] = f"{flags} {_FAST_CPU_FLAG}".strip()


def enable_compilation_cache() -> None:
    """Keep compiled programs between processes, in JAX_COMPILATION_CACHE_DIR or ~/.cache."""
    if jax.config.jax_compilation_cache_dir is None:
        folder = os.path.join(os.path.expanduser("~"), ".cache", "lorasp_jax", "xla")
        jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)


def put_model(model: mujoco.MjModel) -> Any:
    """The model as MJX arrays, with every array strongly typed."""
    return mjx.put_model(model, impl=_IMPL)


def make_data(model: mujoco.MjModel) -> Any:
    """Data of one world in the model's reference pose, strongly typed."""
    data = mjx.make_data(model, impl=_IMPL)
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)), data)


def kinematics(model: Any, data: Any) -> Any:
    """One world with its body, geom, site and camera poses brought up to date with qpos."""
    with _full_precision():
        return mjx.camlight(model, mjx.com_pos(model, mjx.kinematics(model, data)))


def advance(model: Any, data: Any, controls: jax.Array) -> Any:
    """Simulate one world for S physics steps.

    Args:
        model: what `put_model` gave.
        data: data of one world.
        controls: [S, nu] actuator targets, one row a physics step.

    Returns:
        The data after S steps, all poses up to date.
    """

    def body(data: Any, control: jax.Array) -> tuple[Any, None]:
        return mjx.step(model, data.replace(ctrl=control)), None

    with _full_precision():
        data = jax.lax.scan(body, data, controls)[0]
    return kinematics(model, data)


def _full_precision() -> Any:
    # The default on GPU (TF32) and TPU (bf16) is too coarse for the constraint solver.
    return jax.default_matmul_precision("highest")
