"""Arenas: the ground, obstacles and marker boards around a robot, from plain numbers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant

from plants.boards import add_board
from plants.moving import MovingCylinder, add_moving_cylinders
from plants.obstacles import BoxObstacle, CylinderObstacle, Wall
from plants.planar_shapes import PlanarShapes
from systems.markers.layout import Marker, MarkerMap
from systems.validation import require_positive

Array = NDArray[np.float64]
StandingObstacle = Wall | BoxObstacle | CylinderObstacle

_FRICTION = CoulombFriction(1.0, 1.0)
_COLOURS = {
    Wall: np.array([0.62, 0.62, 0.58, 1.0]),
    BoxObstacle: np.array([0.55, 0.47, 0.36, 1.0]),
    CylinderObstacle: np.array([0.36, 0.50, 0.47, 1.0]),
}
_GROUND_COLOUR = np.array([0.42, 0.42, 0.40, 1.0])
MARKER_CLEARANCE = 0.001  # m; a marker's face nearer to a wall than this flickers in pictures


@dataclass
class ArenaParameters:
    """An arena without its markers.

    Attributes:
        walls: the walls.
        boxes: boxes that stand still.
        cylinders: cylinders that stand still.
        moving: cylinders that travel back and forth.
        ground: side of the visible square of ground about the origin, m; contact goes on for 100 m.
    """

    walls: list[Wall] = field(default_factory=list)
    boxes: list[BoxObstacle] = field(default_factory=list)
    cylinders: list[CylinderObstacle] = field(default_factory=list)
    moving: list[MovingCylinder] = field(default_factory=list)
    ground: float = 12.0

    def __post_init__(self) -> None:
        require_positive(ground=self.ground)
        standing = list(self.standing())
        for index, cylinder in enumerate(self.moving):
            swept = cylinder.swept()
            for name, obstacle in standing:
                gap = float(swept.distances(obstacle.footprint()).min())
                if gap < 0:
                    raise ValueError(
                        f"moving[{index}]: its path leads through {name}: {-gap:.3f} m too near"
                    )

    def standing(self) -> Iterator[tuple[str, StandingObstacle]]:
        """Yields what stands still, by name: `walls[0]`, ..., `boxes[0]`, ..., `cylinders[0]`."""
        for kind in ("walls", "boxes", "cylinders"):
            for index, obstacle in enumerate(getattr(self, kind)):
                yield f"{kind}[{index}]", obstacle

    def footprints(self) -> PlanarShapes:
        """Returns the ground that is covered by what stands still, in the order of `standing`."""
        return PlanarShapes.joined(obstacle.footprint() for _, obstacle in self.standing())


def check_markers(arena: ArenaParameters, markers: MarkerMap) -> None:
    """Raises `ValueError` for a marker that lies inside an obstacle or on its very surface."""
    for marker in markers:
        for name, obstacle in arena.standing():
            gap = obstacle.gap(marker)
            if gap < MARKER_CLEARANCE:
                raise ValueError(
                    f"marker {marker.id} is {gap:.4f} m from {name}: must be at least "
                    f"{MARKER_CLEARANCE} m in front of it"
                )


def check_free(
    arena: ArenaParameters,
    point: Sequence[float],
    radius: float,
    what: str,
    *,
    moving: bool = False,
) -> None:
    """Raises `ValueError` for a point on the ground that has an obstacle within `radius`.

    Args:
        arena: the arena.
        point: (2,) m.
        radius: room that is needed, m.
        what: name of the point for the message, `waypoints[0]` for example.
        moving: moving obstacles count too, where they stand at t = 0.
    """
    obstacles = list(arena.standing())
    if moving:
        obstacles += [(f"moving[{k}]", m.at_start()) for k, m in enumerate(arena.moving)]
    for name, obstacle in obstacles:
        gap = float(obstacle.footprint().distances_from(np.array([point], float))[0, 0])
        if gap < radius:
            where = "lies in" if gap < 0 else f"is {gap:.3f} m from"
            raise ValueError(
                f"{what} = [{point[0]:g}, {point[1]:g}] {where} {name}: the robot "
                f"needs {radius:.3f} m of room"
            )


def add_arena(plant: MultibodyPlant, arena: ArenaParameters, markers: MarkerMap) -> None:
    """Adds ground, obstacles and marker boards to the plant's world.

    Moving obstacles become the model instance `plants.moving.MODEL`, if there are any.

    Raises:
        ValueError: a marker lies in an obstacle.
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
    for label, obstacle in arena.standing():
        X, shape, name = obstacle.pose(), obstacle.shape(), _geometry_name(label)
        plant.RegisterCollisionGeometry(world, X, shape, name, _FRICTION)
        plant.RegisterVisualGeometry(world, X, shape, name, _COLOURS[type(obstacle)])
    if arena.moving:
        add_moving_cylinders(plant, arena.moving, _FRICTION)
    for marker in markers:
        add_marker(plant, marker, markers)


def _geometry_name(label: str) -> str:
    """Returns `wall_0` for `walls[0]`, and so on."""
    kind, index = label.rstrip("]").split("[")
    singular = {"walls": "wall", "boxes": "box", "cylinders": "cylinder"}[kind]
    return f"{singular}_{index}"


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
