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
from systems.compiled import compiled, in_rows
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

    The centre is where the diagonals cross, which perspective keeps. The mean height of the upright
    edges tells the mean of their reciprocal depths, and the width how much one of them is nearer
    than the other: both together give the centre's depth, however the marker is turned. Each edge's
    own height would give it too, but that makes squares of their noise, which all lengthen the
    distance: by 1.5 (s / h)^2 for noise s in a height of h, at 12 px with 0.3 px by 4 mm in 4 m.

    Args:
        detections: markers in one picture of a level camera at their height.
        camera: its intrinsics.
        marker_size: side of the black squares, m.

    Returns:
        (n, 2) as in `Sightings`; NaN where the corners make no upright marker.
    """
    if len(detections) == 0:
        return np.zeros((0, 2))
    corners = in_rows(detections.corners, 4, 2)
    values = np.empty((len(corners), 2))
    _measure(camera.undistort(corners), marker_size, values)
    return values


@compiled("void(f8[:,:,::1], f8, f8[:,::1])")
def _measure(rays: Array, marker_size: float, values: Array) -> None:
    """Does what `measure` says.

    Args:
        rays: (n, 4, 2) x/z, y/z of the corners.
        marker_size: m.
        values: (n, 2) written.
    """
    for n in range(len(rays)):
        a, b, c, d = rays[n]
        crossed = (c[0] - a[0]) * (d[1] - b[1]) - (c[1] - a[1]) * (d[0] - b[0])
        share = ((b[0] - a[0]) * (d[1] - b[1]) - (b[1] - a[1]) * (d[0] - b[0])) / crossed
        tangent = a[0] + share * (c[0] - a[0])
        left, right = d[1] - a[1], c[1] - b[1]  # heights
        nearness = (left + right) / 2 / marker_size
        across = (b[0] + c[0] - a[0] - d[0]) / 4 / nearness
        # The half marker is across + tangent lean to the right and lean ahead.
        secant = 1 + tangent * tangent
        root = math.sqrt(max(secant * marker_size**2 / 4 - across * across, 0.0))
        one, other = (root - across * tangent) / secant, (-root - across * tangent) / secant
        by_heights = marker_size * (1 / right - 1 / left) / 2
        lean = one if abs(one - by_heights) < abs(other - by_heights) else other
        depth = (1 + math.hypot(1.0, 2 * nearness * lean)) / (2 * nearness)
        bearing = -math.atan(tangent)
        distance = math.log(depth / math.cos(bearing))
        upright = left > 0 and right > 0
        sound = upright and math.isfinite(bearing) and math.isfinite(distance)
        values[n, 0] = bearing if sound else math.nan
        values[n, 1] = distance if sound else math.nan


def mean_values(mean: Array, values: Array, frames: Array) -> Array:
    """Returns the means (n, 2) of sightings over some pictures, taking one more picture in.

    Bearings are averaged as they are, distances by their reciprocals: heights of markers have
    errors about zero, the logarithms that are made of them have not. The mean of those would be too
    far by half the relative variance of one picture's.

    Args:
        mean: (n, 2) as in `Sightings`, over the pictures so far.
        values: (n, 2) of the new picture.
        frames: (n,) pictures, the new one included.
    """
    result = mean + (values - mean) / frames[:, None]
    # By how much, relatively, the reciprocal of the mean's distance changes.
    result[:, 1] = mean[:, 1] - np.log1p(np.expm1(mean[:, 1] - values[:, 1]) / frames)
    return result


def variances(
    values: Array, frames: Array, *, focal_length: float, marker_size: float, noise: Array
) -> Array:
    """Returns the variances of sightings that are means over some pictures: (n, 2).

    White noise s of each corner coordinate is s sqrt(2) in the height h of an edge, thus s / h,
    relatively, in the mean of both. Where the diagonals cross it is sqrt(1 + (w / h)^2) s/2
    for a marker of width w: from 1 to sqrt(2) times s/2. A sighting does not tell the width; the
    mean of the variances is taken.

    Args:
        values: (n, 2) as in `Sightings`.
        frames: (n,) pictures that each is the mean of.
        focal_length: px.
        marker_size: m.
        noise: (4,) white noise of a corner coordinate, px; and what no mean over pictures takes
            away: of that coordinate, px, in the bearing, rad, and in the distance, relatively.
    """
    (white, lasting), floors = noise[:2], noise[2:]
    cosine = np.cos(values[:, 0])
    height = focal_length * marker_size / (np.exp(values[:, 1]) * cosine)
    crossing = math.sqrt(1.5) / 2 / focal_length * cosine**2
    by_corner = np.column_stack([crossing, 1 / height])  # rad and relatively, for 1 px
    corner = white**2 / frames + lasting**2
    return np.asarray(by_corner**2 * corner[:, None] + floors**2)


class SightingModel:
    """What sightings would be in a state, and how they change with it.

    Which numbers of the state matter for which sighting is looked up once: a least-squares search
    asks again and again.

    Args:
        layout: of the state.
        sightings: n of them.
    """

    def __init__(self, layout: Layout, sightings: Sightings) -> None:
        n = np.arange(len(sightings.values))
        observer, target = 3 * sightings.observer, 3 * sightings.target
        yaw = layout.poses + sightings.observer * layout.cameras + sightings.camera
        self._values = sightings.values
        self._observer = observer, observer + 1, observer + 2
        self._target = target, target + 1, target + 2
        self._yaw = yaw
        self._camera_yaw = layout.camera_yaws[sightings.camera]
        self._side = sightings.marker % SIDES * (np.pi / 2)
        self._offset = layout.marker_offset
        # Where the derivatives are that are not zero: of the bearing, then of the distance.
        x, y, heading = self._target
        bearing = np.stack([x, y, heading, observer, observer + 1, observer + 2, yaw])
        self._shape = (len(n), 2, layout.size)
        row = 2 * layout.size * n
        self._places = np.concatenate([row + bearing, row + layout.size + bearing[:5]]).ravel()

    def predict(self, x: Array) -> Array:
        """Returns what the sightings would be without noise in state x: (n, 2)."""
        dx, dy, _, _ = self._lines(x)
        yaw = x[self._observer[2]] + self._camera_yaw + x[self._yaw]
        result = np.empty((len(dx), 2))
        result[:, 0] = wrap(np.arctan2(dy, dx) - yaw)
        result[:, 1] = np.log(np.hypot(dx, dy))
        return result

    def residuals(self, x: Array) -> Array:
        """Returns by how much the sightings differ from those predicted: (n, 2), the first wrapped.

        Args:
            x: (size,) state.
        """
        difference: Array = self._values - self.predict(x)
        difference[:, 0] = wrap(difference[:, 0])
        return difference

    def jacobian(self, x: Array) -> Array:
        """Returns the derivatives of `predict` by the state, (n, 2, size), at x."""
        dx, dy, lever_x, lever_y = self._lines(x)
        squared = dx * dx + dy * dy
        a, b = dx / squared, dy / squared  # of the logarithm of the distance; turned, of the angle
        minus = np.full(len(dx), -1.0)
        by_state = [
            -b, a, b * lever_y + a * lever_x, b, -a, minus, minus,
            a, b, b * lever_x - a * lever_y, -a, -b,
        ]  # fmt: skip
        result = np.zeros(self._shape)
        result.ravel()[self._places] = np.concatenate(by_state)
        return result

    def _lines(self, x: Array) -> tuple[Array, Array, Array, Array]:
        """Returns the lines from observers to markers, and from targets' axes to markers, in W."""
        angle = x[self._target[2]] + self._side
        lever_x, lever_y = self._offset * np.cos(angle), self._offset * np.sin(angle)
        dx = x[self._target[0]] + lever_x - x[self._observer[0]]
        dy = x[self._target[1]] + lever_y - x[self._observer[1]]
        return dx, dy, lever_x, lever_y


def predict(layout: Layout, x: Array, sightings: Sightings) -> Array:
    """Returns what the sightings would be without noise in state x: (n, 2)."""
    return SightingModel(layout, sightings).predict(x)


def residuals(layout: Layout, x: Array, sightings: Sightings) -> Array:
    """Returns by how much the sightings differ from those predicted: (n, 2), the first wrapped."""
    return SightingModel(layout, sightings).residuals(x)


def jacobian(layout: Layout, x: Array, sightings: Sightings) -> Array:
    """Returns the derivatives of `predict` by the state: (n, 2, size)."""
    return SightingModel(layout, sightings).jacobian(x)
