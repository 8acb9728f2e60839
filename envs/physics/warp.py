"""MuJoCo Warp inside jit, for NVIDIA GPUs.

MJX can call MuJoCo Warp as well, one physics step a call, which passes some 350 arrays through
Python every time: 2 ms, measured, for 0.6 ms of work in 4,096 worlds. Here all physics steps
between two actions are one call with a dozen arrays, and one CUDA graph.
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

# Warp computes where the geoms of fixed bodies are but once, for the model that all worlds share.
_FIXED = ("geom_xpos", "geom_xmat")


class WarpSteps:
    """A MuJoCo model that simulates batches of worlds.

    Device memory for each number of worlds is taken when its first call is traced, and kept until
    the process ends. Not for threads: what one traces while another's graph is captured would
    become part of that graph.
    """

    def __init__(self, model: mujoco.MjModel, *, contacts: int, rows: int, growth: float) -> None:
        """Prepare a model.

        Args:
            model: what all worlds share.
            contacts, rows: at most so many contacts and rows of constraints in each world.
            growth: of geoms, at most, where a world has its own sizes.
        """
        self._mujoco = _with_room(model, growth)
        self._sizes = {"nconmax": int(contacts), "njmax": int(rows)}
        self._made: dict[tuple[str, int], tuple[Any, Any]] = {}
        self._callables: dict[tuple[str, ...], Any] = {}

    def __call__(self, changes: Changes, start: Data, controls: jax.Array) -> Sequence[jax.Array]:
        """The `MOVING` of one world after S physics steps, as `Physics.advance` gives them."""
        names = tuple(sorted(changes))
        differing = [jnp.asarray(changes[name], jnp.float32) for name in names]
        state = [getattr(start, name) for name in (*_FIXED, *MOVING)]
        results = self._batch(names)(*(x[None] for x in (controls, *differing, *state)))
        return [x[0] for x in results]

    def _batch(self, names: tuple[str, ...]) -> Any:
        """The same for W worlds, all arrays with a leading axis."""

        def run(controls: jax.Array, *arrays: jax.Array) -> list[jax.Array]:
            # Memory must be there before a graph is captured; steps follow one another in memory.
            with wp.ScopedDevice(warp_call.device()):
                self._worlds(len(controls))
            return self._callable(names)(jnp.swapaxes(controls, 0, 1), *arrays)

        return warp_call.flattening_vmap(run)

    def _callable(self, names: tuple[str, ...]) -> Any:
        """JAX's way into Warp: controls [S, W, nu], changed fields, `_FIXED`, `MOVING`."""
        if names not in self._callables:

            def simulate(*arrays: Any) -> None:
                given = dict(zip(like, arrays, strict=True))
                model, data = self._worlds(given["controls"].shape[1])
                model = copy.copy(model)
                for name in names:
                    setattr(model, name, given[name])
                for name in _FIXED:
                    wp.copy(getattr(data, name), given[name])
                for name in MOVING:
                    setattr(data, name, given[name])
                for step in range(given["controls"].shape[0]):
                    wp.copy(data.ctrl, given["controls"][step])
                    mujoco_warp.step(model, data)

            with wp.ScopedDevice(warp_call.device()):
                model, data = self._worlds(1)
            like = {"controls": wp.array(dtype=float, ndim=3)}
            like |= {name: getattr(model, name) for name in names}
            like |= {name: getattr(data, name) for name in (*_FIXED, *MOVING)}
            self._callables[names] = warp_call.from_jax(
                simulate, like, num_outputs=len(MOVING), in_out_argnames=MOVING
            )
        return self._callables[names]

    def _worlds(self, number: int) -> tuple[Any, Any]:
        """Model and data of so many worlds on Warp's current device."""
        key = (str(wp.get_device()), number)
        if key not in self._made:
            data = mujoco_warp.make_data(self._mujoco, nworld=number, **self._sizes)
            self._made[key] = self._model(key[0]), data
        return self._made[key]

    def _model(self, device: str) -> Any:
        """The model on Warp's current device, which is called so."""
        for (other, _), (model, _) in self._made.items():
            if other == device:
                return model
        model = mujoco_warp.put_model(self._mujoco)
        # A fixed, small number of iterations is what the scene asks for.
        few = mujoco_warp.OverflowType.ITERATIONS | mujoco_warp.OverflowType.LS_ITERATIONS
        model.opt.warn_overflow &= ~few
        return model


def _with_room(model: mujoco.MjModel, growth: float) -> mujoco.MjModel:
    """The model with bounding volumes that also hold geoms that have grown."""
    model = copy.copy(model)
    bounded = model.geom_rbound > 0  # planes have none
    model.geom_rbound[bounded] *= growth
    model.geom_aabb[bounded, 3:] *= growth
    return model
