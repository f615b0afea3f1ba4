"""What a formation may drive on and build on: room for its robots, sight between them.

Positions of the lattice are vertices, and the centre points between two of them, both in halves of
the lattice's steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.planners.formation_lattice import (
    TriangleLattice,
    Vertex,
    mirrored,
)
from systems.planners.formation_obstacles import Obstacles, clearance
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]
# In halves of the lattice's steps, so that centre points are whole too.
Half = tuple[int, int]


@dataclass
class FormationParameters:
    """Room that robots need, and what counts as arrival.

    Attributes:
        side: of the triangles, m.
        robot_radius: of the circle about a robot's axis that holds it, m.
        safety: zone about obstacles that no robot's circle enters, m.
        beyond: how far a robot drives past its vertex, straight on, before it backs in, m; that
            much of the line is to be free too.
        sight_margin: no obstacle may be nearer to the line of sight from the target vertex to a
            beacon, m: half a marker and some.
        arrival: a robot stands this near to the destination when the formation is there, in sides;
            above 1 / sqrt(3), since no place is farther than that from the nearest vertex.
        tolerance: a robot that is said to stand farther from its vertex than this breaks the
            formation, in sides.
        max_expansions: of the A* search, after which the destination counts as out of reach.
    """

    side: float = 1.5
    robot_radius: float = 0.2
    safety: float = 0.15
    beyond: float = 0.2
    sight_margin: float = 0.1
    arrival: float = 0.6
    tolerance: float = 0.4
    max_expansions: int = 100_000

    def __post_init__(self) -> None:
        require_positive(side=self.side, robot_radius=self.robot_radius)
        require_non_negative(safety=self.safety, beyond=self.beyond, sight_margin=self.sight_margin)
        # A path's lines pass beacons, and those pass each other, at sqrt(3)/4 sides.
        room = math.sqrt(3) / 4 * self.side
        least = 2 * self.robot_radius
        require(least < room, "side", self.side, f"above {least / room * self.side:.3g} m")
        require(
            math.isfinite(self.arrival) and self.arrival > 1 / math.sqrt(3),
            "arrival",
            self.arrival,
            "above 1 / sqrt(3) = 0.577 sides",
        )
        require(0 < self.tolerance <= 0.5, "tolerance", self.tolerance, "above 0, up to 0.5 sides")
        require(self.max_expansions >= 1, "max_expansions", self.max_expansions, "1 or greater")

    @property
    def room(self) -> float:
        """Distance that a robot's axis keeps from obstacles, m."""
        return self.robot_radius + self.safety


class Ground:
    """The lattice among obstacles: which lines on it are free. What has been asked is kept.

    Args:
        lattice: where the vertices are.
        obstacles: what stands around.
        parameters: room that is needed.
        around: whether a robot may drive around the formation where no way leads through it.
    """

    def __init__(
        self,
        lattice: TriangleLattice,
        obstacles: Obstacles,
        parameters: FormationParameters,
        *,
        around: bool = False,
    ) -> None:
        self.lattice = lattice
        self.parameters = parameters
        self.around = around
        self._obstacles = obstacles
        self._rooms: dict[tuple[Half, Half], float] = {}
        self._built: dict[tuple[Half, Half], float] = {}

    def place(self, half: Half) -> Array:
        """Returns where a vertex or centre point is, given in half steps: (2,) m."""
        return self.lattice.positions(np.array(half) / 2)

    def can_stand(self, vertex: Vertex) -> bool:
        """Whether a robot has room at a vertex."""
        return self._between(corner(vertex), corner(vertex)) >= self.parameters.room

    def can_drive(self, a: Half, b: Half) -> bool:
        """Whether a robot has room along the straight line between two points of the lattice."""
        return self._between(a, b) >= self.parameters.room

    def can_drive_from(self, position: Array, b: Half) -> bool:
        """Whether a robot has room along the straight line from a place (2,) m to a point.

        One that is in the safety zone already may leave it, but come no nearer to an obstacle.
        """
        least = min(self.parameters.room, clearance(self._obstacles, position, position))
        return 0 < least <= clearance(self._obstacles, position, self.place(b)) + 1e-9

    def can_see(self, a: Vertex, b: Vertex) -> bool:
        """Whether a robot at one vertex sees one at the other."""
        return self._between(corner(a), corner(b)) >= self.parameters.sight_margin

    def can_build(self, p: Vertex, q: Vertex, r: Vertex) -> bool:
        """Whether a robot can go from the centre point of p and q to the mirror image of r."""
        target = mirrored(r, p, q)
        return (
            self.can_stand(target)
            and self._to_build(middle(p, q), corner(target)) >= self.parameters.room
            and all(self.can_see(target, beacon) for beacon in (p, q, r))
        )

    def _to_build(self, a: Half, b: Half) -> float:
        """Returns the room on the way from a centre point to a vertex and past it, m."""
        if (a, b) not in self._built:
            start, vertex = self.place(a), self.place(b)
            end = past(start, vertex, self.parameters.beyond)
            self._built[a, b] = clearance(self._obstacles, start, end)
        return self._built[a, b]

    def _between(self, a: Half, b: Half) -> float:
        key = (a, b) if a <= b else (b, a)
        if key not in self._rooms:
            self._rooms[key] = clearance(self._obstacles, self.place(a), self.place(b))
        return self._rooms[key]


def past(start: Array, end: Array, beyond: float) -> Array:
    """Returns the point that is `beyond` (m) behind the end (2,) of a straight line, (2,) m."""
    along = end - start
    return np.asarray(end + along * (beyond / max(float(np.hypot(*along)), 1e-9)))


def corner(vertex: Vertex) -> Half:
    """Returns a vertex in half steps."""
    return 2 * vertex[0], 2 * vertex[1]


def middle(p: Vertex, q: Vertex) -> Half:
    """Returns the centre point between two vertices, in half steps."""
    return p[0] + q[0], p[1] + q[1]
