"""Markers on the four sides of a robot, for its fellows to see."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from pydrake.geometry import FrameId
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody

from plants.boards import add_board
from systems.markers.family import Family
from systems.markers.projector import PlacedMarker
from systems.validation import require, require_positive

SIDES = ("front", "left", "back", "right")


@dataclass
class MarkerRing:
    """Upright markers, one on each side: ids in the order front, left, back, right.

    Attributes:
        size: side of the black square, m.
        distance: of their centres from the robot's vertical axis, m.
        height: of their centres over the ground, m.
        misplaced: [outward (m), to the left (m), larger by this part] for each of the four: how far
            each is off all this; left out, not at all.
    """

    size: float = 0.16
    distance: float = 0.15
    height: float = 0.20
    misplaced: list[list[float]] = field(default_factory=lambda: [[0.0] * 3] * len(SIDES))

    def __post_init__(self) -> None:
        require_positive(size=self.size, distance=self.distance, height=self.height)
        off = self.misplaced
        sound = len(off) == len(SIDES) and all(len(row) == 3 for row in off)
        require(
            sound and bool(np.isfinite(off).all()) and min(row[2] for row in off) > -1,
            "misplaced",
            off,
            f"[outward, left, larger] for each of {', '.join(SIDES)}; larger by more than -1",
        )

    def markers(self) -> list[tuple[RigidTransform, float]]:
        """Returns where the four markers truly are, `X_BM`, and how large, m."""
        return [
            (
                RigidTransform(RotationMatrix.MakeZRotation(k * math.pi / 2))
                @ RigidTransform([self.distance + outward, left, self.height]),
                self.size * (1 + larger),
            )
            for k, (outward, left, larger) in enumerate(self.misplaced)
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
    for k, (X_BM, size) in enumerate(ring.markers()):
        add_board(plant, body, X_BM, family=family, marker_id=first_id + k, size=size)
        placed.append(PlacedMarker(first_id + k, size, frame, X_BM))
    return placed
