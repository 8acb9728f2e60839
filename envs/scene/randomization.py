"""Domain randomization: worlds that differ in physics, cameras, light and colors.

    ranges = envs.Randomization(mass=(0.5, 2.0), latency=(0.0, 0.04))
    state = env.reset(key, ranges)

Every world draws its values at reset and keeps them until its next reset. Ranges and draws are
traced, so changing them does not recompile.
"""

import dataclasses
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.rendering.renderer import Appearance
from envs.robots import BASE, multiply, turn
from envs.scene.ranges import Randomization
from envs.state import Changes, Data
from envs.tasks import Layout


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Draw:
    """Values drawn for one world with N cameras and G geoms; fields are as in `Randomization`.

    Attributes:
        size, friction, brightness, latency, table_height: [].
        mass: [bodies].
        gains: [actuators].
        camera_position, camera_turn: `[N, 3]`.
        field_of_view: `[N]`.
        light_turn: `[3]`.
        colour: `[G, 3]`.
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
    table_height: jax.Array


def prepare(ranges: Randomization | None, control_dt: float) -> Randomization | None:
    """Check ranges, unless they are traced, and convert them to strongly typed arrays."""
    leaves = jax.tree.leaves(ranges)
    if ranges and not any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        ranges.check(control_dt)
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), ranges)


def draw(
    key: jax.Array, ranges: Randomization, model: mujoco.MjModel, layout: Layout
) -> tuple[Draw, Layout]:
    """Draw one world's values, and move, rotate and scale the objects of its layout."""
    cameras, geoms = (model.ncam,), (model.ngeom, 3)
    # In this order, a key gives the same values as before a range was added at the end.
    shapes: dict[str, tuple[int, ...]] = {
        "size": (),
        "mass": (model.nbody,),
        "friction": (),
        "gains": (model.nu,),
        "camera_position": (*cameras, 3),
        "camera_turn": (*cameras, 3),
        "field_of_view": cameras,
        "light_turn": (3,),
        "brightness": (),
        "colour": geoms,
        "latency": (),
        "position": (2,),
        "turn": (),
        "table_height": (),
    }
    values = {}
    for each, (name, shape) in zip(jax.random.split(key, len(shapes)), shapes.items(), strict=True):
        low, high = getattr(ranges, name)
        values[name] = jax.random.uniform(each, shape, minval=low, maxval=high)
    move = jnp.stack([*values.pop("position"), jnp.float32(0.0), values.pop("turn")])
    drawn = Draw(**values)
    scale = jnp.ones(4).at[2].set(drawn.size)  # heights in a layout are sums of object sizes
    return drawn, {name: pose * scale + move for name, pose in layout.items()}


def in_subtrees(model: mujoco.MjModel, names: Iterable[str]) -> np.ndarray:
    """Return a mask of the named bodies and their descendants, bool [bodies]."""
    included = np.isin(np.arange(model.nbody), [model.body(name).id for name in names])
    for body in range(1, model.nbody):  # parents come first
        included[body] |= included[model.body_parentid[body]]
    return included


def geom_sizes(drawn: Draw, model: mujoco.MjModel, objects: np.ndarray) -> jax.Array:
    """Compute the sizes `[G, 3]` of all geoms of one world; `objects` masks the objects' bodies."""
    return model.geom_size * jnp.where(objects[model.geom_bodyid], drawn.size, 1.0)[:, None]


def changes(drawn: Draw, model: mujoco.MjModel, objects: np.ndarray) -> Changes:
    """Compute the model fields that differ in one world; `objects` masks the objects' bodies."""
    mass = jnp.where(objects, drawn.mass, 1.0)
    size = jnp.where(objects, drawn.size, 1.0)[:, None]
    # A body's position in its parent scales only if the parent does.
    parent_size = jnp.where(objects[model.body_parentid], drawn.size, 1.0)[:, None]
    # Factors on the solver's estimates of 1 / mass and 1 / inertia of a free body.
    inverse = 1 / jnp.stack([mass, mass * size[:, 0] ** 2], axis=1)
    # The world's origin is on the table, so a higher table is a lower robot.
    position = (model.body_pos * parent_size).at[model.body(BASE).id, 2].add(-drawn.table_height)
    return {
        "geom_size": geom_sizes(drawn, model, objects),
        "geom_pos": model.geom_pos * size[model.geom_bodyid],
        "body_pos": position,
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
