"""Meshes approximated by primitives."""

import itertools

import mujoco
import numpy as np
import pytest

from envs.mjcf import fitting

_CUBE = np.array(list(itertools.product((-1, 1), repeat=3)))
_CUBE_FACES = np.array(
    [
        *((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)),
        *((2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)),
    ]
)


def fitted(vertices: np.ndarray, faces: str = "") -> list[fitting.Shape]:
    """Fit shapes to a mesh; without faces it is the convex hull of its vertices."""
    numbers = " ".join(map(str, vertices.ravel()))
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><asset><mesh name="mesh" vertex="{numbers}" {faces}/></asset>'
        '<worldbody><geom type="mesh" mesh="mesh"/></worldbody></mujoco>'
    )
    return fitting.fit(model, 0)


def test_round_meshes_become_cylinders():
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    rim = 0.04 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    up = np.array([0, 0, 0.1])
    (shape,) = fitted(np.concatenate([rim - up, rim + up]))
    assert shape.kind == mujoco.mjtGeom.mjGEOM_CYLINDER
    np.testing.assert_allclose(shape.size[:2], [0.04, 0.1], rtol=0.04)


def test_bent_meshes_are_split():
    long, tall = np.array([0.1, 0.01, 0.01]), np.array([0.01, 0.01, 0.1])
    beams = long * _CUBE, tall * _CUBE + np.array([0.09, 0, 0.11])
    faces = " ".join(map(str, np.concatenate([_CUBE_FACES, _CUBE_FACES + 8]).ravel()))
    shapes = fitted(np.concatenate(beams), f'face="{faces}"')
    assert {shape.kind for shape in shapes} == {mujoco.mjtGeom.mjGEOM_BOX}
    volume = sum(8 * np.prod(shape.size) for shape in shapes)
    assert volume == pytest.approx(2 * 0.2 * 0.02**2, rel=0.15)  # a box around both has ten times
