"""Call MuJoCo Warp inside jit, on NVIDIA GPUs.

MJX can call MuJoCo Warp too, but with some 350 arrays and once per physics step. Passing them
through Python takes 2 ms, while the step itself takes 0.6 ms for 4,096 worlds (measured). Here all
physics steps between two actions are one call with a dozen arrays, and one CUDA graph.
"""

import copy
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import warp as wp
from mujoco.mjx.third_party import mujoco_warp

from envs.physics import warp_call
from envs.state import MOVING, Changes, Data

# A step of Warp does not compute the geom poses of fixed bodies. These differ between worlds, so
# they are copied into Warp's data before the first step.
_FIXED = ("geom_xpos", "geom_xmat")


class WarpSteps:
    """Simulator of batches of worlds with one MuJoCo model, on one device.

    Device memory is allocated when the first call with a number of worlds is traced, and is never
    freed. Not thread-safe: while one thread captures a graph, Warp operations of another thread
    would become part of it.
    """

    def __init__(self, model: mujoco.MjModel, *, contacts: int, rows: int) -> None:
        """Prepare a model.

        Args:
            model: the scene, shared by all worlds, whose bounding volumes suffice for each.
            contacts, rows: maximum number of contacts and of constraint rows per world.
        """
        self._mujoco = model
        self._sizes = {"nconmax": int(contacts), "njmax": int(rows)}
        with wp.ScopedDevice(warp_call.device()):
            self._model = mujoco_warp.put_model(self._mujoco)
        # Our scenes run the solver for a small, fixed number of iterations; do not warn about that.
        overflow = mujoco_warp.OverflowType
        self._model.opt.warn_overflow &= ~(overflow.ITERATIONS | overflow.LS_ITERATIONS)
        self._data: dict[int, Any] = {}
        self._callables: dict[tuple[str, ...], Any] = {}

    def __call__(self, changes: Changes, start: Data, controls: jax.Array) -> Sequence[jax.Array]:
        """Return the `MOVING` fields of one world after S physics steps."""
        names = tuple(sorted(changes))
        changed = [jnp.asarray(changes[name], jnp.float32) for name in names]
        state = [getattr(start, name) for name in (*_FIXED, *MOVING)]
        results = self._batch(names)(*(x[None] for x in (controls, *changed, *state)))
        return [x[0] for x in results]

    def _batch(self, names: tuple[str, ...]) -> Any:
        """Make the function for W worlds; all arrays have a leading axis W."""

        def run(controls: jax.Array, *arrays: jax.Array) -> list[jax.Array]:
            # Allocate before the graph is captured.
            with wp.ScopedDevice(warp_call.device()):
                self._worlds(len(controls))
            return self._callable(names)(jnp.swapaxes(controls, 0, 1), *arrays)

        return warp_call.flattening_vmap(run)

    def _callable(self, names: tuple[str, ...]) -> Any:
        """Make a JAX function of controls [S, W, nu] and fields `names`, `_FIXED` and `MOVING`."""
        if names not in self._callables:

            def simulate(*arrays: Any) -> None:
                by_name = dict(zip(like, arrays, strict=True))
                model = copy.copy(self._model)
                data = self._worlds(by_name["controls"].shape[1])
                for name in names:
                    setattr(model, name, by_name[name])
                for name in _FIXED:
                    wp.copy(getattr(data, name), by_name[name])
                for name in MOVING:
                    setattr(data, name, by_name[name])
                for step in range(by_name["controls"].shape[0]):
                    wp.copy(data.ctrl, by_name["controls"][step])
                    mujoco_warp.step(model, data)

            with wp.ScopedDevice(warp_call.device()):
                data = self._worlds(1)
            like = {"controls": wp.array(dtype=float, ndim=3)}
            like |= {name: getattr(self._model, name) for name in names}
            like |= {name: getattr(data, name) for name in (*_FIXED, *MOVING)}
            self._callables[names] = warp_call.from_jax(
                simulate, like, num_outputs=len(MOVING), in_out_argnames=MOVING
            )
        return self._callables[names]

    def _worlds(self, num_worlds: int) -> Any:
        """Return data for this many worlds, on Warp's current device."""
        if num_worlds not in self._data:
            data = mujoco_warp.make_data(self._mujoco, nworld=num_worlds, **self._sizes)
            self._data[num_worlds] = data
        return self._data[num_worlds]
