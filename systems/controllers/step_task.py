"""What a robot of a formation is to do in one step, and how far it is with it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from systems.formation.triangles import gates
from systems.messages import Message

Array = NDArray[np.float64]

STATUS_SIZE = 3  # number of the step, `Status`, tries of this step after the first


class Status(IntEnum):
    """How far a step is."""

    IDLE = 0
    APPROACH = 1
    PASS = 2
    BUILD = 3
    DONE = 4
    WAITING = 5


@dataclass(frozen=True, eq=False)
class StepTask(Message):
    """What a robot is to do.

    Attributes:
        number: of the step; a new number begins anew, 0 is no task.
        beacons: (3,) numbers of the robots that stand as beacons 1, 2 and 3.
        poses: (3, 3) what is believed of theirs, [x (m), y (m), theta (rad)]. Where a
            heading is NaN, the axis of the robot is found from a marker's shape.
        target: (2,) the vertex to settle on, m.
        start: (2,) where the robot is believed to be, m.
        points: (n, 2) centre points to pass before it, m, the last that of beacons 1 and 2; left
            empty, it is entry and exit of the beacons' triangle.
        others: (m,) numbers of further robots that stand, by which one may tell where one is.
        other_poses: (m, 3) theirs, as `poses`.
    """

    number: int = 0
    beacons: NDArray[np.int64] = field(default_factory=lambda: np.arange(3))
    poses: Array = field(default_factory=lambda: np.zeros((3, 3)))
    target: Array = field(default_factory=lambda: np.zeros(2))
    start: Array = field(default_factory=lambda: np.zeros(2))
    points: Array = field(default_factory=lambda: np.zeros((0, 2)))
    others: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    other_poses: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def sound(self) -> bool:
        """Whether it is a task: a whole number, robots that all differ, a way that is finite."""
        number, robots = float(self.number), self.robots()
        if not (number >= 0 and number.is_integer() and len(self.beacons) == 3):
            return False
        different = len(set(robots.tolist())) == len(robots) and bool(robots.min() >= 0)
        return different and bool(np.isfinite(self.points).all())

    def robots(self) -> NDArray[np.int64]:
        """Returns the numbers of all that stand, the beacons first."""
        return np.concatenate([self.beacons, self.others])

    def robot_poses(self) -> Array:
        """Returns what is believed of their poses, in that order, (3 + m, 3)."""
        return np.concatenate([self.poses, self.other_poses])

    def way(self) -> Array:
        """Returns the centre points to pass, (n, 2) m."""
        return self.points if len(self.points) else gates(self.poses[:, :2])


OFF = StepTask()
