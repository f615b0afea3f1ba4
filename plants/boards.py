"""Marker boards as Drake geometry: a plate with the marker's cells on it, drawn crisply."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box, GeometryInstance, InMemoryMesh, Mesh
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody

from plants.textured_mesh import Surface, textured_mesh
from systems.markers.family import Family
from systems.validation import require, require_positive

PLATE_THICKNESS = 0.003  # m
_GAP = 0.0005  # m between the plate and the printed face: less, and renderers mix the two
_PLATE_COLOUR = np.array([0.85, 0.85, 0.85, 1.0])
_CELL_PIXELS = 32  # of the texture: finer than any camera sees a cell


def marker_texture(family: Family, marker_id: int, margin: int = 1) -> NDArray[np.uint8]:
    """Returns the marker's picture, upright, with a white margin: uint8, square, grey.

    Each cell is `_CELL_PIXELS` wide, so that a renderer's interpolation between texels stays
    within 1/32 of a cell.
    """
    cells = family.cell_image(marker_id, margin)
    return np.kron(cells, np.ones((_CELL_PIXELS, _CELL_PIXELS), np.uint8))


def face_mesh(texture: NDArray[np.uint8], side: float) -> InMemoryMesh:
    """Returns a textured square in the marker frame: in the plane x = 0, seen from +x.

    Args:
        texture: uint8 grey picture; its first row is at the top (+z), its first column at the
            viewer's left (-y).
        side: of the square, m.
    """
    h = side / 2
    surface = Surface(
        vertices=np.array([[0, -h, h], [0, h, h], [0, h, -h], [0, -h, -h]]),
        normals=np.tile([1.0, 0.0, 0.0], (4, 1)),
        places=np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]),
        triangles=np.array([[0, 3, 2], [0, 2, 1]]),
    )
    return textured_mesh(surface, texture, "marker face")


def add_board(
    plant: MultibodyPlant,
    body: RigidBody,
    X_BM: RigidTransform,
    *,
    family: Family,
    marker_id: int,
    size: float,
    margin: int = 1,
) -> None:
    """Fixes a marker board to a body: cameras and Meshcat see it, contact ignores it.

    Args:
        plant: not finalized yet.
        body: what the board is fixed to.
        X_BM: pose of the marker frame (x out of the printed face, z up) in the body.
        family: the marker's family.
        marker_id: its id.
        size: side of the black square, m.
        margin: white cells around the black square, at least 1.

    Raises:
        ValueError: no such id, a size that is not positive, or no margin.
    """
    require_positive(size=size)
    require(margin >= 1, "margin", margin, "at least 1 cell: without it detectors miss the marker")
    side = size * (family.cells + 2 * margin) / family.cells
    name = f"marker_{marker_id}"
    plate = Box(PLATE_THICKNESS, side, side)
    X_BPlate = X_BM.multiply(RigidTransform([-_GAP - PLATE_THICKNESS / 2, 0.0, 0.0]))
    plant.RegisterVisualGeometry(body, X_BPlate, plate, f"{name}_plate", _PLATE_COLOUR)
    face = Mesh(face_mesh(marker_texture(family, marker_id, margin), side), 1.0)
    # Without properties of its own the face keeps the mesh's material, in both visual roles.
    plant.RegisterVisualGeometry(body, GeometryInstance(X_BM, face, f"{name}_face"))
