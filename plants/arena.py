"""Arenas: the ground, walls and marker boards around a robot, from plain numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant

from plants.boards import add_board
from systems.markers.layout import Marker, MarkerMap
from systems.validation import require, require_positive

Array = NDArray[np.float64]

_FRICTION = CoulombFriction(1.0, 1.0)
_WALL_COLOUR = np.array([0.62, 0.62, 0.58, 1.0])
_GROUND_COLOUR = np.array([0.42, 0.42, 0.40, 1.0])
MARKER_CLEARANCE = 0.001  # m; a marker's face nearer to a wall than this flickers in pictures


@dataclass
class Wall:
    """An upright wall on the ground.

    Attributes:
        start: [x, y] of one end of its centre line, m.
        end: [x, y] of the other end, m.
        thickness: m.
        height: m.
    """

    start: list[float]
    end: list[float]
    thickness: float = 0.05
    height: float = 0.6

    def __post_init__(self) -> None:
        for name in ("start", "end"):
            value = getattr(self, name)
            require(
                len(value) == 2 and bool(np.isfinite(value).all()), name, value, "[x, y] in metres"
            )
        require(self.start != self.end, "end", self.end, "another point than start")
        require_positive(thickness=self.thickness, height=self.height)

    @property
    def length(self) -> float:
        """Length of the centre line, m."""
        return float(np.hypot(*np.subtract(self.end, self.start)))

    def pose(self) -> RigidTransform:
        """Returns the pose of the wall's box: origin at its centre, x along the wall."""
        along = np.subtract(self.end, self.start)
        x, y = np.add(self.start, self.end) / 2
        return RigidTransform(
            RollPitchYaw(0.0, 0.0, float(np.arctan2(along[1], along[0]))), [x, y, self.height / 2]
        )

    def distance(self, points: Array) -> Array:
        """Returns the distance of points (n, 3) from the wall's surface, m; negative inside."""
        local = np.abs(self.pose().inverse().multiply(np.atleast_2d(points).T).T)
        outside = local - np.array([self.length, self.thickness, self.height]) / 2
        return np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(axis=1), 0)


@dataclass
class ArenaParameters:
    """An arena without its markers.

    Attributes:
        walls: the walls.
        ground: side of the visible square of ground about the origin, m; contact goes on for 100 m.
    """

    walls: list[Wall] = field(default_factory=list)
    ground: float = 12.0

    def __post_init__(self) -> None:
        require_positive(ground=self.ground)


def check_markers(arena: ArenaParameters, markers: MarkerMap) -> None:
    """Raises `ValueError` for a marker that lies inside a wall or on its very surface."""
    for marker in markers:
        for index, wall in enumerate(arena.walls):
            gap = _gap(wall, marker)
            if gap < MARKER_CLEARANCE:
                raise ValueError(
                    f"marker {marker.id} is {gap:.4f} m from walls[{index}]: must be at least "
                    f"{MARKER_CLEARANCE} m in front of it"
                )


def _gap(wall: Wall, marker: Marker) -> float:
    """Returns how far a marker's square is from a wall's box, m; negative when they overlap.

    That is along the axis that parts them best: normals, and normals of pairs of edges.
    """
    X_BM = wall.pose().inverse().multiply(marker.X_WM)
    normal, *edges = X_BM.rotation().matrix().T
    axes = np.vstack([np.eye(3), normal, *(np.cross(np.eye(3), edge) for edge in edges)])
    lengths = np.linalg.norm(axes, axis=1, keepdims=True)
    axes = (axes / np.maximum(lengths, 1e-9))[lengths[:, 0] > 1e-9]
    reach = np.abs(axes) @ np.array([wall.length, wall.thickness, wall.height]) / 2
    reach += np.abs(axes @ np.transpose(edges)).sum(axis=1) * marker.size / 2
    return float((np.abs(axes @ X_BM.translation()) - reach).max())


def check_free(arena: ArenaParameters, point: Sequence[float], radius: float, what: str) -> None:
    """Raises `ValueError` for a point on the ground that has a wall within `radius`.

    Args:
        arena: the arena.
        point: (2,) m.
        radius: room that is needed, m.
        what: name of the point for the message, `waypoints[0]` for example.
    """
    for index, wall in enumerate(arena.walls):
        gap = float(wall.distance(np.array([[*point, wall.height / 2]]))[0])
        if gap < radius:
            where = "lies in" if gap < 0 else f"is {gap:.3f} m from"
            raise ValueError(
                f"{what} = [{point[0]:g}, {point[1]:g}] {where} walls[{index}]: the robot "
                f"needs {radius:.3f} m of room"
            )


def add_arena(plant: MultibodyPlant, arena: ArenaParameters, markers: MarkerMap) -> None:
    """Adds ground, walls and marker boards to the plant's world.

    Raises:
        ValueError: a marker lies in a wall.
    """
    check_markers(arena, markers)
    world = plant.world_body()
    # A box, not a half space: Drake warns at each start that those cannot touch soft bodies.
    plant.RegisterCollisionGeometry(
        world, RigidTransform([0.0, 0.0, -0.5]), Box(200.0, 200.0, 1.0), "ground", _FRICTION
    )
    plate = Box(arena.ground, arena.ground, 0.02)
    plant.RegisterVisualGeometry(
        world, RigidTransform([0.0, 0.0, -0.0105]), plate, "ground", _GROUND_COLOUR
    )
    for index, wall in enumerate(arena.walls):
        box = Box(wall.length, wall.thickness, wall.height)
        name = f"wall_{index}"
        plant.RegisterCollisionGeometry(world, wall.pose(), box, name, _FRICTION)
        plant.RegisterVisualGeometry(world, wall.pose(), box, name, _WALL_COLOUR)
    for marker in markers:
        add_marker(plant, marker, markers)


def add_marker(plant: MultibodyPlant, marker: Marker, markers: MarkerMap) -> None:
    """Adds one marker's board to the plant's world."""
    add_board(
        plant,
        plant.world_body(),
        marker.X_WM,
        family=markers.family,
        marker_id=marker.id,
        size=marker.size,
    )
