"""Call MuJoCo Warp's batch renderer inside jit, on NVIDIA GPUs: fast, with meshes and textures.

Light, checker and sky resemble those of the ray caster.
"""

import copy
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import warp as wp
from mujoco.mjx.third_party import mujoco_warp

from envs.physics import warp_call
from envs.rendering.renderer import Appearance, RayRenderer
from envs.state import Poses

_PER_WORLD = ("geom_size", "geom_rgba", "mat_rgba", "cam_fovy")  # fields of Warp's model
_POSES = ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "light_xdir")  # fields of Warp's data


class WarpRenderer:
    """Render any number of worlds; memory is allocated on construction and never freed."""

    def __init__(self, model: mujoco.MjModel, rays: RayRenderer, num_worlds: int) -> None:
        """Prepare a model.

        Args:
            model: shared by all worlds, with a light named "lamp".
            rays: ray caster whose cameras, appearance, image size and samples are used.
            num_worlds: number of worlds that Warp renders at once.
        """
        self._mujoco, self.model = model, rays.model
        # For several rays per pixel, render a larger image and average it. Warp's own supersampling
        # needs the same field of view in all worlds.
        self.image_size, self.samples = rays.image_size, rays.samples
        self._num_worlds = num_worlds
        with_lamp = _with_lamp(model)
        with wp.ScopedDevice(warp_call.device()):
            self._model = mujoco_warp.put_model(with_lamp)
            self._data = mujoco_warp.make_data(model, nworld=num_worlds)
            self._contexts = [
                mujoco_warp.create_render_context(
                    with_lamp,
                    nworld=num_worlds,
                    cam_res=(rays.samples * rays.image_size,) * 2,  # pyright: ignore
                    render_rgb=True,
                    render_depth=False,
                    cam_active=[camera],
                    use_shadows=True,
                    shadow_light_fraction=0.0,
                    render_skybox=True,
                    use_precomputed_rays=False,  # the field of view differs between worlds
                    enable_specular=False,
                )
                for camera in self.model.cameras
            ]
        self._render = self._callable()
        self._batch = warp_call.flattening_vmap(self._all)

    def __call__(
        self, poses: Poses, appearance: Appearance | None, size: jax.Array | None
    ) -> jax.Array:
        """Render images, uint8 `[N, K, height, width, 3]`, like `RayRenderer`.

        Args:
            poses: poses of all geoms and cameras, leading axis N.
            appearance: appearance of each world, leading axis N; None for the model's own. In each
                world, ambient, headlight and diffuse must be the model's times one factor, which
                scales the whole image. `sky` and `checker` are ignored.
            size: `[N, G, 3]` sizes of geoms; None for the model's own.
        """
        return self._batch(poses, appearance, size)

    def _all(
        self, poses: Poses, appearance: Appearance | None, size: jax.Array | None
    ) -> jax.Array:
        number, chunk = len(poses.geom_xpos), self._num_worlds

        def every(x: Any) -> jax.Array:
            return jnp.broadcast_to(jnp.asarray(x), (number, *np.shape(x)))

        if appearance is None:
            appearance = jax.tree.map(every, self.model.appearance)
        size = every(self.model.size) if size is None else size
        # A call takes exactly `num_worlds` worlds: pad the last chunk with the last world.
        padding = -number % chunk

        def chunks(x: jax.Array) -> jax.Array:
            padded = jnp.concatenate([x, jnp.repeat(x[-1:], padding, axis=0)])
            return padded.reshape(-1, chunk, *x.shape[1:])

        worlds = jax.tree.map(chunks, (poses, appearance, size))
        images = jax.lax.map(lambda world: self._render_chunk(*world), worlds)
        return images.reshape(-1, *images.shape[2:])[:number]

    def _render_chunk(self, poses: Poses, appearance: Appearance, size: jax.Array) -> jax.Array:
        geom_xpos, geom_xmat, cam_xpos, cam_xmat = poses
        worlds, side = self._num_worlds, self.image_size
        own, light = self.model.appearance, -appearance.light
        direction = (
            jnp.zeros((worlds, self._mujoco.nlight, 3))
            .at[:, 0]
            .set(light / jnp.linalg.norm(light, axis=-1, keepdims=True))
        )
        # The lamp replaces the headlight, so it moves to each camera that renders.
        position = jnp.repeat(cam_xpos[:, self.model.cameras, None], self._mujoco.nlight, axis=2)
        per_world = (size, appearance.rgba, self._material_colors(appearance), appearance.fovy)
        lights = (direction, *jnp.moveaxis(position, 1, 0))
        packed = self._render(*per_world, geom_xpos, geom_xmat, cam_xpos, cam_xmat, *lights)
        rays = (side, self.samples) * 2
        packed = jnp.stack(packed, axis=1).reshape(worlds, len(packed), *rays)
        rgb = jnp.stack([(packed >> shift) & 0xFF for shift in (16, 8, 0)], axis=-1)
        rgb = jnp.mean(rgb.astype(jnp.float32), axis=(3, 5))
        bright = (appearance.ambient / own.ambient).reshape(-1, 1, 1, 1, 1)
        return (jnp.clip(rgb * bright, 0, 255) + 0.5).astype(jnp.uint8)

    def _material_colors(self, appearance: Appearance) -> jax.Array:
        """Return colors [worlds, materials, 4]; the table's material takes its geom's color."""
        colors = jnp.broadcast_to(
            jnp.asarray(self._mujoco.mat_rgba, jnp.float32),
            (self._num_worlds, self._mujoco.nmat, 4),
        )
        table = self._mujoco.geom("table").id
        return colors.at[:, self._mujoco.geom_matid[table]].set(appearance.rgba[:, table])

    def _callable(self) -> Any:
        """Make a JAX function of model fields, data fields and one light position per camera."""
        model, data = self._model, self._data
        fields = {name: model for name in _PER_WORLD} | {name: data for name in _POSES}
        like = {name: getattr(owner, name) for name, owner in fields.items()}
        positions = {f"light_xpos{i}": data.light_xpos for i in range(len(self._contexts))}
        pixels = {f"rgb{i}": context.rgb_data for i, context in enumerate(self._contexts)}

        def render(*arrays: Any) -> None:
            by_name = dict(zip((*like, *positions, *pixels), arrays, strict=True))
            for name, owner in fields.items():
                setattr(owner, name, by_name[name])
            for i, context in enumerate(self._contexts):
                data.light_xpos, context.rgb_data = by_name[f"light_xpos{i}"], by_name[f"rgb{i}"]
                mujoco_warp.refit_bvh(model, data, context)
                mujoco_warp.render(model, data, context)

        dims = {name: x.shape for name, x in pixels.items()}
        return warp_call.from_jax(
            render, like | positions | pixels, num_outputs=len(pixels), output_dims=dims
        )


def _with_lamp(model: mujoco.MjModel) -> mujoco.MjModel:
    """Copy the model, with the lamp turned on and the headlight turned off."""
    model = copy.copy(model)
    model.vis.headlight.diffuse[:] = 0.0
    model.light_active[model.light("lamp").id] = True
    return model
