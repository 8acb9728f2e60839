"""MuJoCo Warp's batch renderer inside jit, for NVIDIA GPUs: meshes and textures, and fast.

It is made to look like the ray caster: the same light, the same squares, the same sky.
"""

import copy
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import warp as wp
from mujoco.mjx.third_party import mujoco_warp

from envs.physics import warp_call
from envs.rendering.renderer import Look, RayRenderer

_PER_WORLD = ("geom_size", "geom_rgba", "mat_rgba", "cam_fovy")  # fields of the model
_POSES = ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "light_xdir")  # of data


class WarpRenderer:
    """Pictures of any number of worlds; its memory is taken when it is made, and kept for good."""

    def __init__(self, model: mujoco.MjModel, rays: RayRenderer, num_worlds: int) -> None:
        """Prepare a model.

        Args:
            model: what all worlds share, with a light called lamp.
            rays: the ray caster for it, whose cameras, look and kind of picture are taken over.
            num_worlds: worlds that Warp draws at a time.
        """
        self._mujoco, self.model = model, rays.model
        # Warp's own way to take several rays a pixel cannot vary the field of view.
        self.image_size, self.samples = rays.image_size, rays.samples
        self._num_worlds = num_worlds
        lamplit = _lamplit(model)
        with wp.ScopedDevice(warp_call.device()):
            self._model = mujoco_warp.put_model(lamplit)
            self._data = mujoco_warp.make_data(model, nworld=num_worlds)
            self._contexts = [
                mujoco_warp.create_render_context(
                    lamplit,
                    nworld=num_worlds,
                    cam_res=(rays.samples * rays.image_size,) * 2,  # pyright: ignore
                    render_rgb=True,
                    render_depth=False,
                    cam_active=[camera],
                    use_shadows=True,
                    shadow_light_fraction=0.0,
                    render_skybox=True,
                    use_precomputed_rays=False,  # fields of view differ from world to world
                    enable_specular=False,
                )
                for camera in self.model.cameras
            ]
        self._render = self._callable()
        self._batch = warp_call.flattening_vmap(self._all)

    def __call__(
        self, poses: Sequence[jax.Array], look: Look | None, size: jax.Array | None
    ) -> jax.Array:
        """Pictures, uint8 `[N, K, height, width, 3]`, as by `render.render_batch`.

        Args:
            poses: geom_xpos, geom_xmat, cam_xpos, cam_xmat with leading axis N.
            look: of each world, leading axis N; None for the model's own. Of its light, all three
                shares must be brighter or darker by one factor; sky and squares keep their own.
            size: `[N, G, 3]` sizes of geoms; None for the model's own.
        """
        return self._batch(tuple(poses), look, size)

    def _all(
        self, poses: Sequence[jax.Array], look: Look | None, size: jax.Array | None
    ) -> jax.Array:
        """Pictures of all worlds, chunk by chunk."""
        number, chunk = len(poses[0]), self._num_worlds

        def every(x: Any) -> jax.Array:
            return jnp.broadcast_to(jnp.asarray(x), (number, *np.shape(x)))

        look = jax.tree.map(every, self.model.look) if look is None else look
        size = every(self.model.size) if size is None else size
        # A call takes exactly `num_worlds`: the last chunk is filled up with the last world.
        rest = -number % chunk

        def chunks(x: jax.Array) -> jax.Array:
            filled = jnp.concatenate([x, jnp.repeat(x[-1:], rest, axis=0)])
            return filled.reshape(-1, chunk, *x.shape[1:])

        worlds = jax.tree.map(chunks, (poses, look, size))
        pictures = jax.lax.map(lambda world: self._pictures(*world), worlds)
        return pictures.reshape(-1, *pictures.shape[2:])[:number]

    def _pictures(self, poses: Sequence[jax.Array], look: Look, size: jax.Array) -> jax.Array:
        """Pictures of one chunk."""
        geom_xpos, geom_xmat, cam_xpos, cam_xmat = poses
        worlds, side = self._num_worlds, self.image_size
        own, light = self.model.look, -look.light
        direction = (
            jnp.zeros((worlds, self._mujoco.nlight, 3))
            .at[:, 0]
            .set(light / jnp.linalg.norm(light, axis=-1, keepdims=True))
        )
        # Each camera has its own lamp, lights being the same for all pixels of a call.
        place = jnp.repeat(cam_xpos[:, self.model.cameras, None], self._mujoco.nlight, axis=2)
        per_world = (size, look.rgba, self._material_colours(look), look.fovy)
        lights = (direction, *jnp.moveaxis(place, 1, 0))
        packed = self._render(*per_world, geom_xpos, geom_xmat, cam_xpos, cam_xmat, *lights)
        rays = (side, self.samples) * 2
        packed = jnp.stack(packed, axis=1).reshape(worlds, len(packed), *rays)
        rgb = jnp.stack([(packed >> shift) & 0xFF for shift in (16, 8, 0)], axis=-1)
        rgb = jnp.mean(rgb.astype(jnp.float32), axis=(3, 5))
        bright = (look.ambient / own.ambient).reshape(-1, 1, 1, 1, 1)
        return (jnp.clip(rgb * bright, 0, 255) + 0.5).astype(jnp.uint8)

    def _material_colours(self, look: Look) -> jax.Array:
        """Colours of the materials: those of the geoms that wear them, [worlds, materials, 4]."""
        colours = jnp.broadcast_to(
            jnp.asarray(self._mujoco.mat_rgba, jnp.float32),
            (self._num_worlds, self._mujoco.nmat, 4),
        )
        table = self._mujoco.geom("table").id
        return colours.at[:, self._mujoco.geom_matid[table]].set(look.rgba[:, table])

    def _callable(self) -> Any:
        """JAX's way into Warp: fields of model and data, a place of the lights for each camera."""
        model, data = self._model, self._data
        fields = {name: model for name in _PER_WORLD} | {name: data for name in _POSES}
        like = {name: getattr(owner, name) for name, owner in fields.items()}
        places = {f"light_xpos{i}": data.light_xpos for i in range(len(self._contexts))}
        pixels = {f"rgb{i}": context.rgb_data for i, context in enumerate(self._contexts)}

        def render(*arrays: Any) -> None:
            given = dict(zip((*like, *places, *pixels), arrays, strict=True))
            for name, owner in fields.items():
                setattr(owner, name, given[name])
            for i, context in enumerate(self._contexts):
                data.light_xpos, context.rgb_data = given[f"light_xpos{i}"], given[f"rgb{i}"]
                mujoco_warp.refit_bvh(model, data, context)
                mujoco_warp.render(model, data, context)

        dims = {name: x.shape for name, x in pixels.items()}
        return warp_call.from_jax(
            render, like | places | pixels, num_outputs=len(pixels), output_dims=dims
        )


def _lamplit(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model with its lamp in place of the headlight, which would shine along the camera."""
    model = copy.copy(model)
    model.vis.headlight.diffuse[:] = 0.0
    model.light_active[model.light("lamp").id] = True
    return model
