"""Domain randomization: worlds that differ in physics, cameras, light and colors.

    ranges = envs.Randomization(mass=(0.5, 2.0), latency=(0.0, 0.04))
    state = env.reset(key, ranges)

Every world draws its values at reset and keeps them until its next reset. Ranges and draws are
traced, so changing them does not recompile.
"""

import dataclasses
from collections.abc import Iterable
from typing import Any, Self

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs import checks
from envs.physics.physics import MAX_GROWTH
from envs.rendering.renderer import Appearance
from envs.robots import multiply, turn
from envs.state import Changes, Data
from envs.tasks import Layout

Range = tuple[float, float]
_POSITIVE = ("size", "mass", "friction", "gains", "brightness")
_MAX_FOV_CHANGE = 20.0  # deg, our choice; the narrowest field of view is 32
_ZERO, _ONE = (0.0, 0.0), (1.0, 1.0)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Randomization:
    """Ranges (low, high) to draw from uniformly; the defaults change nothing.

    Attributes:
        position: common shift of all objects along x and along y [m].
        turn: rotation of each object about its own vertical axis, the same angle for all [rad].
        size: common factor on the size of all objects, which stay on the table.
        mass: factor on each object's mass and inertia.
        friction: common factor on all friction.
        gains: factor on each servo's stiffness and damping.
        camera_position: shift of each camera along each of its axes [m].
        camera_turn: each component of each camera's rotation vector [rad].
        field_of_view: change of each camera's vertical field of view [deg].
        light_turn: each component of the rotation vector of the light's direction [rad].
        brightness: factor on all light.
        colour: change of red, green and blue of each geom, on a scale of 0 to 1.
        latency: delay from an action to its first effect [s], at most one control step.
    """

    position: Range = _ZERO
    turn: Range = _ZERO
    size: Range = _ONE
    mass: Range = _ONE
    friction: Range = _ONE
    gains: Range = _ONE
    camera_position: Range = _ZERO
    camera_turn: Range = _ZERO
    field_of_view: Range = _ZERO
    light_turn: Range = _ZERO
    brightness: Range = _ONE
    colour: Range = _ZERO
    latency: Range = _ZERO

    @classmethod
    def typical(cls) -> Self:
        """Return moderate ranges for small robots and their cameras; the experts still succeed."""
        return cls(
            position=(-0.01, 0.01),
            turn=(-0.1, 0.1),
            size=(0.95, 1.05),
            mass=(0.7, 1.4),
            friction=(0.8, 1.25),
            gains=(0.8, 1.2),
            camera_position=(-0.01, 0.01),
            camera_turn=(-0.035, 0.035),
            field_of_view=(-2.0, 2.0),
            light_turn=(-0.5, 0.5),
            brightness=(0.7, 1.2),
            colour=(-0.1, 0.1),
            latency=(0.0, 0.04),
        )

    def check(self, control_dt: float) -> None:
        """Raise a ValueError if a range is invalid; latency must not exceed `control_dt` [s]."""
        for name, value in vars(self).items():
            if not _is_range(value):
                raise ValueError(f"{name} must be two finite numbers (low, high), got {value}")
            if name in _POSITIVE and value[0] <= 0:
                raise ValueError(f"{name} is a factor and must be above 0, got {value}")
        if self.size[0] < 1 / MAX_GROWTH or self.size[1] > MAX_GROWTH:
            limits = f"[{1 / MAX_GROWTH}, {MAX_GROWTH}]"
            raise ValueError(f"size must lie in {limits}, got {self.size}")
        if max(map(abs, self.field_of_view)) > _MAX_FOV_CHANGE:
            limit = f"[-{_MAX_FOV_CHANGE}, {_MAX_FOV_CHANGE}] degrees"
            raise ValueError(f"field_of_view must lie in {limit}, got {self.field_of_view}")
        if self.latency[0] < 0 or self.latency[1] > control_dt:
            raise ValueError(f"latency must lie in [0, {control_dt}] s, got {self.latency}")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Draw:
    """Values drawn for one world with N cameras and G geoms; fields are as in `Randomization`.

    Attributes:
        size, friction, brightness, latency: [].
        mass: [bodies].
        gains: [actuators].
        camera_position, camera_turn: [N, 3].
        field_of_view: [N].
        light_turn: [3].
        colour: [G, 3].
    """

    size: jax.Array
    mass: jax.Array
    friction: jax.Array
    gains: jax.Array
    camera_position: jax.Array
    camera_turn: jax.Array
    field_of_view: jax.Array
    light_turn: jax.Array
    brightness: jax.Array
    colour: jax.Array
    latency: jax.Array


def prepare(ranges: Randomization | None, control_dt: float) -> Randomization | None:
    """Check ranges, unless they are traced, and convert them to strongly typed arrays."""
    leaves = jax.tree.leaves(ranges)
    if ranges is not None:
        checks.instance("ranges", ranges, Randomization, "an envs.Randomization or None")
    if ranges and not any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        ranges.check(control_dt)
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), ranges)


def _is_range(value: Any) -> bool:
    """Return whether `value` is two numbers, finite in single precision, the lower first."""
    if isinstance(value, tuple | list):
        value = [np.asarray(x) for x in value]
        if not all(x.shape == () and checks.is_numeric(x) for x in value):
            return False
        value = np.array(value)
    if not checks.is_numeric(value) or value.shape != (2,):
        return False
    with np.errstate(over="ignore"):
        low, high = np.asarray(value, np.float32)
    return bool(np.isfinite([low, high]).all() and value[0] <= value[1])


def draw(
    key: jax.Array, ranges: Randomization, model: mujoco.MjModel, layout: Layout
) -> tuple[Draw, Layout]:
    """Draw one world's values, and move, rotate and scale the objects of its layout."""
    keys = iter(jax.random.split(key, len(dataclasses.fields(ranges))))

    def uniform(name: str, *shape: int) -> jax.Array:
        low, high = getattr(ranges, name)
        return jax.random.uniform(next(keys), shape, minval=low, maxval=high)

    drawn = Draw(
        size=uniform("size"),
        mass=uniform("mass", model.nbody),
        friction=uniform("friction"),
        gains=uniform("gains", model.nu),
        camera_position=uniform("camera_position", model.ncam, 3),
        camera_turn=uniform("camera_turn", model.ncam, 3),
        field_of_view=uniform("field_of_view", model.ncam),
        light_turn=uniform("light_turn", 3),
        brightness=uniform("brightness"),
        colour=uniform("colour", model.ngeom, 3),
        latency=uniform("latency"),
    )
    move = jnp.stack([*uniform("position", 2), jnp.float32(0.0), uniform("turn")])
    scale = jnp.ones(4).at[2].set(drawn.size)  # heights in a layout are sums of object sizes
    return drawn, {name: pose * scale + move for name, pose in layout.items()}


def in_subtrees(model: mujoco.MjModel, names: Iterable[str]) -> np.ndarray:
    """Return a mask of the named bodies and their descendants, bool [bodies]."""
    included = np.isin(np.arange(model.nbody), [model.body(name).id for name in names])
    for body in range(1, model.nbody):  # parents come first
        included[body] |= included[model.body_parentid[body]]
    return included


def geom_sizes(drawn: Draw, model: mujoco.MjModel, objects: np.ndarray) -> jax.Array:
    """Compute the sizes [G, 3] of all geoms of one world; `objects` masks the objects' bodies."""
    return model.geom_size * jnp.where(objects[model.geom_bodyid], drawn.size, 1.0)[:, None]


def changes(drawn: Draw, model: mujoco.MjModel, objects: np.ndarray) -> Changes:
    """Compute the model fields that differ in one world; `objects` masks the objects' bodies."""
    mass = jnp.where(objects, drawn.mass, 1.0)
    size = jnp.where(objects, drawn.size, 1.0)[:, None]
    # A body's position in its parent scales only if the parent does.
    parent_size = jnp.where(objects[model.body_parentid], drawn.size, 1.0)[:, None]
    # Factors on the solver's estimates of 1 / mass and 1 / inertia of a free body.
    inverse = 1 / jnp.stack([mass, mass * size[:, 0] ** 2], axis=1)
    return {
        "geom_size": geom_sizes(drawn, model, objects),
        "geom_pos": model.geom_pos * size[model.geom_bodyid],
        "body_pos": model.body_pos * parent_size,
        "body_ipos": model.body_ipos * size,
        "body_mass": model.body_mass * mass,
        "body_inertia": model.body_inertia * mass[:, None] * size**2,
        "body_invweight0": model.body_invweight0 * inverse,
        "geom_friction": model.geom_friction * drawn.friction,
        "actuator_gainprm": model.actuator_gainprm * drawn.gains[:, None],
        "actuator_biasprm": model.actuator_biasprm * drawn.gains[:, None],
    }


def move_cameras(drawn: Draw, data: Data) -> Data:
    """Move the cameras of one world as drawn."""
    shift = multiply(data.cam_xmat, drawn.camera_position[..., None])[..., 0]
    rotated = multiply(data.cam_xmat, jax.vmap(turn)(drawn.camera_turn))
    return data.replace(cam_xpos=data.cam_xpos + shift, cam_xmat=rotated)


def appearance(drawn: Draw, base: Appearance) -> Appearance:
    """Apply one world's draw to the model's appearance."""
    rgb = jnp.clip(base.rgba[:, :3] + drawn.colour, 0.0, 1.0)
    return dataclasses.replace(
        base,
        rgba=jnp.concatenate([rgb, base.rgba[:, 3:]], axis=1),
        light=multiply(turn(drawn.light_turn), jnp.asarray(base.light)),
        ambient=base.ambient * drawn.brightness,
        headlight=base.headlight * drawn.brightness,
        diffuse=base.diffuse * drawn.brightness,
        sky=base.sky * drawn.brightness,
        fovy=base.fovy + drawn.field_of_view,
    )
