"""Domain randomisation: worlds that differ in everything but the task.

    ranges = envs.Randomization(mass=(0.5, 2.0), latency=(0.0, 0.04))
    state = env.reset(key, ranges)

Every world draws its own values at reset and keeps them until the next one. Ranges and draws are
traced: other numbers compile nothing anew.
"""

import dataclasses
from collections.abc import Iterable
from typing import Any, Self

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs import checks
from envs.physics.physics import MOST_GROWTH
from envs.rendering.renderer import Look
from envs.robots import multiply, turn
from envs.state import Changes, Data
from envs.tasks import Layout

Range = tuple[float, float]
_POSITIVE = ("size", "mass", "friction", "gains", "brightness")
_MOST_DEGREES = 20.0  # of change to a field of view; the narrowest camera has 32
_STILL, _SAME = (0.0, 0.0), (1.0, 1.0)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Randomization:
    """Ranges (low, high) to draw from uniformly; the defaults leave everything as it is.

    Attributes:
        position: shift of all objects together along x and along y [m].
        turn: of each object about its own vertical axis, all by the same angle [rad].
        size: factor on all objects, about where they stand on the table.
        mass: factor on each object's mass and inertia.
        friction: factor on the friction of everything.
        gains: factor on each servo's stiffness and damping.
        camera_position: shift of each camera along each of its own axes [m].
        camera_turn: rotation vector of each camera, each of its components [rad].
        field_of_view: change of each camera's vertical field of view [deg].
        light_turn: rotation vector of the light's direction, each component [rad].
        brightness: factor on all light.
        colour: change of red, green and blue of each geom, each 0 to 1.
        latency: time from an action to its first effect [s], at most one control step.
    """

    position: Range = _STILL
    turn: Range = _STILL
    size: Range = _SAME
    mass: Range = _SAME
    friction: Range = _SAME
    gains: Range = _SAME
    camera_position: Range = _STILL
    camera_turn: Range = _STILL
    field_of_view: Range = _STILL
    light_turn: Range = _STILL
    brightness: Range = _SAME
    colour: Range = _STILL
    latency: Range = _STILL

    @classmethod
    def typical(cls) -> Self:
        """Ranges that are usual for such arms and cameras; own choices, which experts cope with."""
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
        """Raises a ValueError for ranges that make no sense; `control_dt` in s."""
        for name, given in vars(self).items():
            if not _is_range(given):
                raise ValueError(f"{name} must be two finite numbers (low, high), got {given}")
            if name in _POSITIVE and given[0] <= 0:
                raise ValueError(f"{name} is a factor and must be above 0, got {given}")
        if self.size[0] < 1 / MOST_GROWTH or self.size[1] > MOST_GROWTH:
            limits = f"{1 / MOST_GROWTH} to {MOST_GROWTH}"
            raise ValueError(f"size must lie in {limits}, got {self.size}")
        if max(map(abs, self.field_of_view)) > _MOST_DEGREES:
            limit = f"-{_MOST_DEGREES} to {_MOST_DEGREES} degrees"
            raise ValueError(f"field_of_view must lie in {limit}, got {self.field_of_view}")
        if self.latency[0] < 0 or self.latency[1] > control_dt:
            raise ValueError(f"latency must lie in 0 to {control_dt} s, got {self.latency}")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Draw:
    """What one world drew, fields as in `Randomization`; N cameras, G geoms of the model.

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


def prepared(ranges: Randomization | None, control_dt: float) -> Randomization | None:
    """The ranges as strongly typed arrays, checked; those already traced are taken as they are."""
    leaves = jax.tree.leaves(ranges)
    if ranges is not None:
        checks.instance("ranges", ranges, Randomization, "an envs.Randomization or None")
    if ranges and not any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        ranges.check(control_dt)
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), ranges)


def _is_range(given: Any) -> bool:
    """Whether it is two finite numbers in single precision, the lower first."""
    if isinstance(given, tuple | list):
        given = [np.asarray(x) for x in given]
        if not all(x.shape == () and checks.is_numeric(x) for x in given):
            return False
        given = np.array(given)
    if not checks.is_numeric(given) or given.shape != (2,):
        return False
    with np.errstate(over="ignore"):
        low, high = np.asarray(given, np.float32)
    return bool(np.isfinite([low, high]).all() and given[0] <= given[1])


def draw(
    key: jax.Array, ranges: Randomization, model: mujoco.MjModel, layout: Layout
) -> tuple[Draw, Layout]:
    """One world's values, and its layout with the objects moved, turned and grown."""
    keys = iter(jax.random.split(key, len(dataclasses.fields(ranges))))

    def uniform(name: str, *shape: int) -> jax.Array:
        low, high = getattr(ranges, name)
        return jax.random.uniform(next(keys), shape, minval=low, maxval=high)

    found = Draw(
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
    grow = jnp.ones(4).at[2].set(found.size)  # a height is the sum of what lies below
    return found, {name: place * grow + move for name, place in layout.items()}


def belonging(model: mujoco.MjModel, names: Iterable[str]) -> np.ndarray:
    """Whether each body of a model is one of these or hangs on one, bool [bodies]."""
    belongs = np.isin(np.arange(model.nbody), [model.body(name).id for name in names])
    for body in range(1, model.nbody):  # parents come first
        belongs[body] |= belongs[model.body_parentid[body]]
    return belongs


def geom_sizes(found: Draw, model: mujoco.MjModel, ours: np.ndarray) -> jax.Array:
    """Sizes [G, 3] of all geoms in one world, `ours` being its objects' bodies."""
    return model.geom_size * jnp.where(ours[model.geom_bodyid], found.size, 1.0)[:, None]


def changes(found: Draw, model: mujoco.MjModel, ours: np.ndarray) -> Changes:
    """How a world's model differs from the one that all share, `ours` being its objects' bodies."""
    mass = jnp.where(ours, found.mass, 1.0)
    size = jnp.where(ours, found.size, 1.0)[:, None]
    # Where a body's frame lies in its parent's: grown only if the parent has grown as well.
    inner = jnp.where(ours[model.body_parentid], found.size, 1.0)[:, None]
    # What the solver takes for 1 / mass and 1 / inertia of a free body.
    lighter = 1 / jnp.stack([mass, mass * size[:, 0] ** 2], axis=1)
    return {
        "geom_size": geom_sizes(found, model, ours),
        "geom_pos": model.geom_pos * size[model.geom_bodyid],
        "body_pos": model.body_pos * inner,
        "body_ipos": model.body_ipos * size,
        "body_mass": model.body_mass * mass,
        "body_inertia": model.body_inertia * mass[:, None] * size**2,
        "body_invweight0": model.body_invweight0 * lighter,
        "geom_friction": model.geom_friction * found.friction,
        "actuator_gainprm": model.actuator_gainprm * found.gains[:, None],
        "actuator_biasprm": model.actuator_biasprm * found.gains[:, None],
    }


def move_cameras(found: Draw, data: Data) -> Data:
    """A world whose cameras are where it drew them."""
    shift = multiply(data.cam_xmat, found.camera_position[..., None])[..., 0]
    turned = multiply(data.cam_xmat, jax.vmap(turn)(found.camera_turn))
    return data.replace(cam_xpos=data.cam_xpos + shift, cam_xmat=turned)


def look(found: Draw, own: Look) -> Look:
    """How a world looks, given how the model does."""
    rgb = jnp.clip(own.rgba[:, :3] + found.colour, 0.0, 1.0)
    return dataclasses.replace(
        own,
        rgba=jnp.concatenate([rgb, own.rgba[:, 3:]], axis=1),
        light=multiply(turn(found.light_turn), jnp.asarray(own.light)),
        ambient=own.ambient * found.brightness,
        headlight=own.headlight * found.brightness,
        diffuse=own.diffuse * found.brightness,
        sky=own.sky * found.brightness,
        fovy=own.fovy + found.field_of_view,
    )
