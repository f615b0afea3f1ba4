"""The value types that travel on abstract ports, shaped like the ROS messages that people know.

Every message is immutable (its arrays are read-only), so a port, a cache and a recording may hold
the same one, and copying it costs nothing. `stamp` is the time of measurement in seconds, not the
time of arrival. NaN as stamp means "nothing has been measured yet".
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

Array = NDArray[np.float64]


def whole_nanoseconds(t: float) -> float:
    """Rounds a time in seconds to whole nanoseconds, the resolution that a recording keeps.

    Sensors stamp their samples with it, so that a time read back from a recording is the same
    float as the one that was measured.
    """
    return round(t * 1e9) / 1e9


class Message:
    """Base of all messages: freezes its arrays and is copied by reference."""

    def __post_init__(self) -> None:
        for value in vars(self).values():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self

    def __copy__(self) -> Self:
        return self


@dataclass(frozen=True, eq=False)
class CameraImage(Message):
    """One picture, like `sensor_msgs/Image`.

    Attributes:
        stamp: middle of the exposure, s.
        frame_id: optical frame of the camera that took it.
        data: uint8, (height, width) grey or (height, width, 3) RGB; (0, 0) when there is none.
    """

    stamp: float = math.nan
    frame_id: str = ""
    data: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 0), np.uint8))


@dataclass(frozen=True, eq=False)
class Detections(Message):
    """Markers found in one picture, like `apriltag_msgs/AprilTagDetectionArray`.

    Attributes:
        stamp: time of the picture, s.
        frame_id: optical frame of the camera.
        family: canonical name of the marker family (see `systems.markers.family`).
        ids: (n,) int64.
        corners: (n, 4, 2) px, in the order top-left, top-right, bottom-right, bottom-left of the
            upright marker, counted from the centre of the first pixel, as the (distorted) picture
            shows them.
        hamming: (n,) int64, bits that were corrected.
        decision_margin: (n,) contrast of the code bits over the threshold, grey levels; larger is
            surer.
    """

    stamp: float = math.nan
    frame_id: str = ""
    family: str = ""
    ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    corners: Array = field(default_factory=lambda: np.zeros((0, 4, 2)))
    hamming: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    decision_margin: Array = field(default_factory=lambda: np.zeros(0))

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, index: NDArray[Any]) -> Detections:
        """Returns the detections picked by a boolean mask or an index array, in that order."""
        return Detections(
            stamp=self.stamp,
            frame_id=self.frame_id,
            family=self.family,
            ids=self.ids[index],
            corners=self.corners[index],
            hamming=self.hamming[index],
            decision_margin=self.decision_margin[index],
        )


@dataclass(frozen=True, eq=False)
class PoseEstimate(Message):
    """A pose with its covariance, like `geometry_msgs/PoseWithCovarianceStamped`.

    Attributes:
        stamp: time of measurement, s; NaN when there is no estimate.
        frame_id: the parent frame, as in `X_{parent}{child}`.
        child_frame_id: the frame whose pose it is.
        pose: the pose of child in parent.
        covariance: (6, 6), rotation first: a small rotation vector in the parent frame (rad), then
            the position in the parent frame (m).
        reprojection_rms: root mean square of the corner residuals that it leaves, px; NaN when
            it does not come from corners.
        ambiguous: a second pose explains the same measurements nearly as well.
        markers: number of markers that it rests on.
    """

    stamp: float = math.nan
    frame_id: str = ""
    child_frame_id: str = ""
    pose: RigidTransform = field(default_factory=RigidTransform)
    covariance: Array = field(default_factory=lambda: np.full((6, 6), math.nan))
    reprojection_rms: float = math.nan
    ambiguous: bool = False
    markers: int = 0

    @property
    def valid(self) -> bool:
        """Whether there is an estimate at all."""
        return not math.isnan(self.stamp)


@dataclass(frozen=True, eq=False)
class Scan(Message):
    """One turn of a lidar, like `sensor_msgs/LaserScan`.

    Ray i points to angle_min + i angle_increment in the lidar's own frame (x forward, y left; the
    angles grow to the left) and was measured at stamp + i time_increment.

    Attributes:
        stamp: time of the first ray, s; NaN when there is no scan.
        frame_id: frame of the lidar.
        angle_min: direction of the first ray, rad.
        angle_increment: from one ray to the next, rad.
        time_increment: from one ray to the next, s.
        range_min: nearest distance that can be measured, m.
        range_max: farthest, m.
        ranges: (n,) m; inf where nothing was in reach, NaN where the measurement failed.
    """

    stamp: float = math.nan
    frame_id: str = ""
    angle_min: float = -math.pi
    angle_increment: float = math.radians(1.0)
    time_increment: float = 0.0
    range_min: float = 0.0
    range_max: float = math.inf
    ranges: Array = field(default_factory=lambda: np.zeros(0))

    def __len__(self) -> int:
        return len(self.ranges)

    @property
    def angles(self) -> Array:
        """Directions of the rays in the lidar's frame, (n,) rad."""
        return self.angle_min + self.angle_increment * np.arange(len(self.ranges), dtype=float)


@dataclass(frozen=True, eq=False)
class OccupancyGrid(Message):
    """What is known of the ground around, like `nav_msgs/OccupancyGrid`, in log-odds.

    Attributes:
        stamp: time of the last scan that went in, s; NaN when there is no grid.
        frame_id: the frame that the grid is aligned with.
        resolution: side of a cell, m.
        origin: (2,) the corner of cell (0, 0) with the least coordinates, m.
        log_odds: (rows along y, columns along x) float32; 0 is unknown, above 0 rather occupied.
    """

    stamp: float = math.nan
    frame_id: str = ""
    resolution: float = 0.05
    origin: Array = field(default_factory=lambda: np.zeros(2))
    log_odds: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))


@dataclass(frozen=True, eq=False)
class Path(Message):
    """A way to go, like `nav_msgs/Path` without headings.

    Attributes:
        stamp: when it was planned, s; NaN when there is none yet.
        frame_id: the frame that the points are in.
        points: (n, 2) m, from the start to the goal; empty when there is no way.
    """

    stamp: float = math.nan
    frame_id: str = ""
    points: Array = field(default_factory=lambda: np.zeros((0, 2)))


@dataclass(frozen=True, eq=False)
class AvoiderState(Message):
    """What an avoider sees and wants, for viewers, recordings and whoever decides to give up.

    Attributes:
        stamp: time of the scan that it rests on, s; NaN before the first.
        status: `clear` (the way to the goal is free), `avoiding`, `turning` (no direction is free:
            it turns in place to look for one), `blocked` (it has given up) or `blind` (no scan, or
            none that can be used).
        angles: (n,) middles of the sectors, in map, rad.
        density: (n,) how full each sector is; the avoider's own scale.
        free: (n,) bool, the sectors that it may choose.
        direction: the chosen direction, in map, rad; NaN when there is none.
    """

    stamp: float = math.nan
    status: str = "blind"
    angles: Array = field(default_factory=lambda: np.zeros(0))
    density: Array = field(default_factory=lambda: np.zeros(0))
    free: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    direction: float = math.nan


@dataclass(frozen=True, eq=False)
class Health(Message):
    """What a block dropped and why, counted since the start.

    Attributes:
        counts: reason (a snake_case word) to number of samples dropped for it.
    """

    counts: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class PointMatches(Message):
    """Points of a scene found in two pictures of one camera: sparse optical flow.

    Attributes:
        stamp: time of the later picture, s; NaN when there is nothing to compare.
        previous_stamp: time of the earlier picture, s.
        frame_id: optical frame of the camera.
        previous: (n, 2) px, in the earlier picture, counted from the centre of the first pixel.
        current: (n, 2) px, the same points in the later one.
    """

    stamp: float = math.nan
    previous_stamp: float = math.nan
    frame_id: str = ""
    previous: Array = field(default_factory=lambda: np.zeros((0, 2)))
    current: Array = field(default_factory=lambda: np.zeros((0, 2)))

    def __len__(self) -> int:
        return len(self.previous)


@dataclass(frozen=True, eq=False)
class RotationIncrement(Message):
    """How far a body has turned relative to something it watches, between two pictures.

    Attributes:
        stamp: end of the interval, s; NaN when there is no increment.
        previous_stamp: its beginning, s.
        frame_id: the body's frame, in whose axes it is told.
        rotation: (3,) rotation vector w, rad: the body's frame B turns from B1 to B2 by
            `R_B1B2 = exp(w)`, as the integral of a gyro fixed to it.
        covariance: (3, 3) of a further small rotation in the axes of B2, rad^2.
        inliers: number of points that agree on it.
        inlier_share: part of all matched points that they are.
    """

    stamp: float = math.nan
    previous_stamp: float = math.nan
    frame_id: str = ""
    rotation: Array = field(default_factory=lambda: np.zeros(3))
    covariance: Array = field(default_factory=lambda: np.full((3, 3), math.nan))
    inliers: int = 0
    inlier_share: float = 0.0

    @property
    def valid(self) -> bool:
        """Whether there is an increment at all."""
        return not math.isnan(self.stamp)
