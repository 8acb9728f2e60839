"""Call MuJoCo's C engine inside jit, on CPU, where it is several times faster than MJX.

All physics steps between two actions are one callback with all worlds, which the engine spreads
over the CPU's cores. It computes in double precision.
"""

import contextlib
import copy
import threading
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import mujoco
import numpy as np
from jax.experimental.buffer_callback import buffer_callback
from mujoco.batch import Batch

from envs.state import MOVING, Changes, Data

_FLAGS = mujoco.mjtDisableBit
# Diverged worlds must not restart, and the tree of bounding boxes in a body does not scale with it.
_DISABLED = _FLAGS.mjDSBL_AUTORESET | _FLAGS.mjDSBL_MIDPHASE
_LOCK = threading.Lock()  # programs of several threads may call back at once


class MujocoSteps:
    """Simulator of batches of worlds with one MuJoCo model. Thread-safe and deterministic."""

    def __init__(self, model: mujoco.MjModel) -> None:
        """Prepare a model, whose bounding spheres suffice for all worlds."""
        self._model = copy.copy(model)
        self._model.opt.disableflags |= _DISABLED
        self._batches: dict[tuple[Any, ...], Batch] = {}

    def __call__(self, changes: Changes, start: Data, controls: jax.Array) -> Sequence[jax.Array]:
        """Return the `MOVING` fields of one world after S physics steps."""
        moving = [getattr(start, name) for name in MOVING]
        like = [jax.ShapeDtypeStruct(x.shape, np.float32) for x in moving]
        # `jax.pure_callback` would wait for copies of its inputs in JAX's threads, which may all be
        # busy with callbacks: on one core, four threads with 300 worlds each stopped forever.
        run = buffer_callback(self._run, like, vmap_method="broadcast_all")
        return run(changes, moving, controls)

    def _run(self, _: Any, ends: Any, changes: Any, moving: Any, controls: Any) -> None:
        """Simulate worlds with any leading axes, the same for all buffers; call no JAX."""
        axes = np.ndim(controls) - 2

        def flat(x: Any) -> np.ndarray:
            x = np.asarray(x)
            return x.reshape(-1, *x.shape[axes:])

        controls = flat(controls)
        with _LOCK, _without_log():
            batch = self._batch(len(controls), tuple(sorted(changes)))
            for name, value in changes.items():
                batch.expand(name)[:] = flat(value)
            for name, value in zip(MOVING, moving, strict=True):
                batch.bind(name)[:] = flat(value)
            batch.warning[:] = 0
            batch.rollout(controls.shape[1], controls, record=())
            # A world with a warning has diverged; the engine does not finish its steps.
            warned = batch.warning.any(axis=(1, 2))
            for name, end in zip(MOVING, ends, strict=True):
                flat(end)[:] = np.where(warned[:, None], np.nan, batch.bind(name))

    def _batch(self, num_worlds: int, names: tuple[str, ...]) -> Batch:
        """Return a batch in which the fields `names` of the model differ between worlds."""
        key = num_worlds, names
        if key not in self._batches:
            self._batches[key] = Batch(self._model, num_worlds)
        return self._batches[key]


@contextlib.contextmanager
def _without_log() -> Iterator[None]:
    """Let MuJoCo count its warnings without writing each to a file in the working directory."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
