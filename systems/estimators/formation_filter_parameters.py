"""The numbers of the formation's estimator."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.validation import require_non_negative, require_positive


@dataclass
class FormationFilterParameters:
    """Noise, sizes and options.

    Attributes:
        marker_size: side of the black squares, m.
        marker_offset: from a robot's axis to the centres of its four markers, m.
        pixel_noise: white noise of a corner coordinate, px.
        corner_floor: what no mean over pictures takes away of it while two robots stand, px: how
            pixels happen to fall on a marker. Without it distances of far markers, whose pixels
            are few, would be trusted too much.
        bearing_floor: the same of the bearing, rad: how well markers sit where they are said to.
            0.02 degrees are 0.17 px at 485 px, or 0.5 mm at 1.5 m.
        range_floor: the same of the distance, relatively: how large markers are.
        use_range: whether the distances count, beside the bearings.
        start_position_noise: standard deviation of each robot's x and y at the start, m.
        start_heading_noise: of its heading, rad.
        yaw_error: standard deviation of each camera's yaw, rad; 0 takes them for exact. 3 px at
            485 px are 0.0062 rad.
        move_position_noise: standard deviation of where a robot gets to in one move, m, as far as
            it can tell itself; large, since the wheels are not listened to.
        move_heading_noise: of its heading, rad.
        gate: a sighting whose squared Mahalanobis distance exceeds this is refused; 13.8 is the
            99.9 % bound of chi-square with 2 degrees of freedom.
        settle_time: how long after a stop a sighting does not count for the new place yet, s.
        memory: how long a sighting of a moving robot is used, s.
        track_rate: how often a robot on its way is placed, at most, Hz.
    """

    marker_size: float = 0.16
    marker_offset: float = 0.15
    pixel_noise: float = 0.3
    corner_floor: float = 0.1
    bearing_floor: float = 0.00035
    range_floor: float = 0.003
    use_range: bool = True
    start_position_noise: float = 0.003
    start_heading_noise: float = 0.01
    yaw_error: float = 0.006
    move_position_noise: float = 30.0
    move_heading_noise: float = 30.0
    gate: float = 13.8
    settle_time: float = 0.1
    memory: float = 0.3
    track_rate: float = 10.0

    def __post_init__(self) -> None:
        above_zero = (
            "marker_size", "bearing_floor", "range_floor", "start_position_noise",
            "start_heading_noise", "move_position_noise", "move_heading_noise", "gate", "memory",
            "track_rate",
        )  # fmt: skip
        require_positive(**{name: getattr(self, name) for name in above_zero})
        zero_allowed = (
            "marker_offset", "pixel_noise", "corner_floor", "yaw_error", "settle_time",
        )  # fmt: skip
        require_non_negative(**{name: getattr(self, name) for name in zero_allowed})

    def sighting_noise(self) -> NDArray[np.float64]:
        """Returns what `formation_model.variances` takes."""
        return np.array([self.pixel_noise, self.corner_floor, self.bearing_floor, self.range_floor])

    def start_deviations(self, robots: int, cameras: int) -> NDArray[np.float64]:
        """Returns the standard deviations of the state at the start, (robots (3 + cameras),)."""
        pose = [self.start_position_noise, self.start_position_noise, self.start_heading_noise]
        exact = math.radians(1e-5)  # a prior needs some deviation
        return np.concatenate(
            [np.tile(pose, robots), np.full(robots * cameras, max(self.yaw_error, exact))]
        )

    def move_deviations(self) -> NDArray[np.float64]:
        """Returns the standard deviations (3,) of a move, m, m, rad."""
        position = self.move_position_noise
        return np.array([position, position, self.move_heading_noise])
