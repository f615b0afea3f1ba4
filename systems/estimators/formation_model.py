"""What robots of a formation see of one another: bearings and ranges of markers, and their model.

State of N robots with C cameras each: poses x (m), y (m), theta (rad) of all robots in W, robot
after robot, then the yaw errors (rad) of all cameras, robot after robot. Robot k carries the
markers 4k (front), 4k+1 (left), 4k+2 (back) and 4k+3 (right), upright, their centres on a circle
around the robot's axis; the cameras stand on the axis, level, at the height of the markers.

A sighting is the bearing of a marker's centre and, from the height of its upright edges, the
logarithm of its distance along the ground. The model knows where on its robot the marker sits, so
nothing is lost by taking one side of a robot for its axis: 0.15 m beside the axis is 5.7 degrees
at 1.5 m. All functions are pure.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from systems.angles import wrap
from systems.cameras import PinholeCamera
from systems.messages import Detections

Array = NDArray[np.float64]
Index = NDArray[np.intp]

SIDES = 4  # markers a robot


class Layout(NamedTuple):
    """What the numbers of the state stand for.

    Attributes:
        robots: how many there are.
        camera_yaws: (C,) where the cameras of each robot look, from its x axis to the left, rad.
        marker_offset: from a robot's axis to the centres of its markers, m.
    """

    robots: int
    camera_yaws: Array
    marker_offset: float

    @property
    def cameras(self) -> int:
        """How many cameras a robot has."""
        return len(self.camera_yaws)

    @property
    def poses(self) -> int:
        """How many numbers the poses are; the yaw errors follow."""
        return 3 * self.robots

    @property
    def size(self) -> int:
        """How many numbers the state is."""
        return self.robots * (3 + self.cameras)


class Sightings(NamedTuple):
    """Markers of some robots as cameras of others see them.

    Attributes:
        observer: (n,) robots that look.
        camera: (n,) which of their cameras.
        marker: (n,) ids of the markers.
        values: (n, 2) bearing in the camera, rad, positive to the left; and logarithm of the
            distance along the ground, of m.
    """

    observer: Index
    camera: Index
    marker: Index
    values: Array

    @property
    def target(self) -> Index:
        """The robots that are seen, (n,)."""
        return self.marker // SIDES

    def select(self, index: NDArray[np.bool_] | Index) -> Sightings:
        """Returns the sightings picked by a mask or an index array."""
        return Sightings(
            self.observer[index], self.camera[index], self.marker[index], self.values[index]
        )


def measure(detections: Detections, camera: PinholeCamera, marker_size: float) -> Array:
    """Returns bearings and logarithms of distances of detected markers.

    The centre is where the diagonals cross, which perspective keeps. Each upright edge tells its
    own depth by its height, and the centre's is the mean of both, however the marker is turned.

    Args:
        detections: markers in one picture of a level camera at their height.
        camera: its intrinsics.
        marker_size: side of the black squares, m.

    Returns:
        (n, 2) as in `Sightings`; NaN where the corners make no upright marker.
    """
    if len(detections) == 0:
        return np.zeros((0, 2))
    rays = camera.undistort(detections.corners.reshape(-1, 2)).reshape(-1, 4, 2)
    a, b, c, d = (rays[:, i] for i in range(4))
    with np.errstate(all="ignore"):
        share = _cross(b - a, d - b) / _cross(c - a, d - b)
        tangent = a[:, 0] + share * (c - a)[:, 0]
        heights = np.stack([d - a, c - b])[..., 1]
        heights[~(heights > 0)] = math.nan
        depth = marker_size * (1 / heights).mean(axis=0)
        # The logarithm of a noisy height leans to far: by half its relative variance, which is
        # below 0.1 % here, and left.
        bearing = -np.arctan(tangent)
        values = np.column_stack([bearing, np.log(depth / np.cos(bearing))])
    values[~np.isfinite(values).all(axis=1)] = math.nan
    return values


def variances(
    values: Array, frames: Array, *, focal_length: float, marker_size: float, noise: Array
) -> Array:
    """Returns the variances of sightings that are means over some pictures: (n, 2).

    White noise s of each corner coordinate is s sqrt(2) in the height h of an edge, thus s / h,
    relatively, in the mean of two depths. Where the diagonals cross it is sqrt(1 + (w / h)^2) s/2
    for a marker of width w: from 1 to sqrt(2) times s/2. A sighting does not tell the width; the
    mean of the variances is taken.

    Args:
        values: (n, 2) as in `Sightings`.
        frames: (n,) pictures that each is the mean of.
        focal_length: px.
        marker_size: m.
        noise: (3,) white noise of a corner coordinate, px; and what no mean over pictures takes
            away, in the bearing, rad, and in the distance, relatively.
    """
    white, lasting = noise[0], noise[1:]
    cosine = np.cos(values[:, 0])
    height = focal_length * marker_size / (np.exp(values[:, 1]) * cosine)
    crossing = math.sqrt(1.5) * white / 2
    by_picture = np.column_stack([crossing / focal_length * cosine**2, white / height])
    return np.asarray(by_picture**2 / frames[:, None] + lasting**2)


def predict(layout: Layout, x: Array, sightings: Sightings) -> Array:
    """Returns what the sightings would be without noise in state x: (n, 2)."""
    line, _ = _lines(layout, x, sightings)
    theta = x[3 * sightings.observer + 2]
    yaw = layout.camera_yaws[sightings.camera] + x[_yaw_error(layout, sightings)]
    bearing = wrap(np.arctan2(line[:, 1], line[:, 0]) - theta - yaw)
    return np.column_stack([bearing, np.log(np.hypot(line[:, 0], line[:, 1]))])


def residuals(layout: Layout, x: Array, sightings: Sightings) -> Array:
    """Returns by how much the sightings differ from those predicted: (n, 2), the first wrapped."""
    difference = sightings.values - predict(layout, x, sightings)
    difference[:, 0] = wrap(difference[:, 0])
    return difference


def jacobian(layout: Layout, x: Array, sightings: Sightings) -> Array:
    """Returns the derivatives of `predict` by the state: (n, 2, size)."""
    line, lever = _lines(layout, x, sightings)
    squared = (line * line).sum(axis=1)[:, None]
    # Of bearing and logarithm of the distance, by the line from observer to marker.
    by_line = (
        np.stack([line @ np.array([[0.0, 1.0], [-1.0, 0.0]]), line], axis=1) / squared[..., None]
    )
    n = np.arange(len(line))
    result = np.zeros((len(line), 2, layout.size))
    for axis in range(2):
        result[n, :, 3 * sightings.target + axis] = by_line[:, :, axis]
        result[n, :, 3 * sightings.observer + axis] = -by_line[:, :, axis]
    turned = np.column_stack([-lever[:, 1], lever[:, 0]])
    result[n, :, 3 * sightings.target + 2] = (by_line @ turned[:, :, None])[..., 0]
    result[n, 0, 3 * sightings.observer + 2] = -1.0
    result[n, 0, _yaw_error(layout, sightings)] = -1.0
    return result


def _lines(layout: Layout, x: Array, sightings: Sightings) -> tuple[Array, Array]:
    """Returns the lines from observers to markers and from targets' axes to markers, in W."""
    poses = x[: layout.poses].reshape(-1, 3)
    target = poses[sightings.target]
    angle = target[:, 2] + sightings.marker % SIDES * (np.pi / 2)
    lever = layout.marker_offset * np.column_stack([np.cos(angle), np.sin(angle)])
    return target[:, :2] + lever - poses[sightings.observer, :2], lever


def _yaw_error(layout: Layout, sightings: Sightings) -> Index:
    return layout.poses + sightings.observer * layout.cameras + sightings.camera


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
