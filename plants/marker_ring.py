"""Markers on the four sides of a robot, for its fellows to see."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pydrake.geometry import FrameId
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody

from plants.boards import add_board
from systems.markers.family import Family
from systems.markers.projector import PlacedMarker
from systems.validation import require_positive

SIDES = ("front", "left", "back", "right")


@dataclass
class MarkerRing:
    """Upright markers, one on each side: ids in the order front, left, back, right.

    Attributes:
        size: side of the black square, m.
        distance: of their centres from the robot's vertical axis, m.
        height: of their centres over the ground, m.
    """

    size: float = 0.16
    distance: float = 0.15
    height: float = 0.20

    def __post_init__(self) -> None:
        require_positive(**vars(self))

    def poses(self) -> list[RigidTransform]:
        """Returns `X_BM` of the four markers."""
        return [
            RigidTransform(RotationMatrix.MakeZRotation(k * math.pi / 2))
            @ RigidTransform([self.distance, 0.0, self.height])
            for k in range(len(SIDES))
        ]


def add_marker_ring(
    plant: MultibodyPlant, body: RigidBody, ring: MarkerRing, *, family: Family, first_id: int
) -> list[PlacedMarker]:
    """Adds the four boards to a robot's body; returns where they are.

    Args:
        plant: not finalized yet, registered with a SceneGraph.
        body: `base_link`, with its origin on the ground.
        ring: size and places.
        family: of the markers.
        first_id: of the one in front; the others follow.

    Raises:
        ValueError: an id that the family does not have.
    """
    frame: FrameId = plant.GetBodyFrameIdOrThrow(body.index())
    placed = []
    for k, X_BM in enumerate(ring.poses()):
        add_board(plant, body, X_BM, family=family, marker_id=first_id + k, size=ring.size)
        placed.append(PlacedMarker(first_id + k, ring.size, frame, X_BM))
    return placed
