"""Where the axis of a robot shows that carries an upright marker on each of its sides.

Robot k carries ids 4 k (front), 4 k + 1 (left), 4 k + 2 (back), 4 k + 3 (right), each centre at the
same distance from the robot's vertical axis. A marker's centre shows up to that distance beside the
axis: 55 px for 0.15 m seen from 1.35 m at 485 px of focal length, eight times what building a
triangle may be wrong by. Both corrections here count in sides of the marker, as its height in the
picture tells; no distance to anything comes of them.

Where the robot's heading is known, so is the turn of the face: `axis_of_known_face`. Where not, the
turn is found from the shape of the picture, by least squares over the places and heights of the
upright edges: `axis_of_marker`. That is exact without noise and poor with it (at 0.5 px a corner
and 0.10 m markers, 8 px for a face seen head-on from 1.35 m, and a small oblique one may be taken
for its mirror image).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SIDES = 4
_ITERATIONS = 6
# Noise of edge places (means of two corners) and heights (differences), by that of a corner.
_SCALE = np.array([0.5, 0.5, 2.0, 2.0]) ** -0.5


def robot_of(marker_id: int) -> int:
    """Returns the number of the robot that carries a marker."""
    return marker_id // SIDES


def marker_centres(pose: Array, distance: float) -> Array:
    """Returns where the markers of a robot stand: (..., 4, 2) m, front, left, back, right.

    Args:
        pose: (..., 3) of the robot.
        distance: of the markers' centres from the robot's axis, m.
    """
    angles = pose[..., 2:] + np.arange(SIDES) * (np.pi / 2)
    offsets = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    centres: Array = pose[..., None, :2] + distance * offsets
    return centres


def axis_of_marker(rays: Array, setback: float) -> tuple[Array, Array]:
    """Finds where the axis behind each marker shows.

    Camera and markers are level with each other, up to a difference in height.

    Args:
        rays: (n, 4, 2) x/z, y/z of the corners, in the order of `Detections`.
        setback: distance of the markers from the axis, by the side of their black square.

    Returns:
        The axis' x/z (n,), and its variance (n,) for corners of variance 1 in each coordinate.
    """
    left, right = rays[:, [0, 3]], rays[:, [1, 2]]
    seen = np.stack(
        [
            left[:, :, 0].mean(axis=1),
            right[:, :, 0].mean(axis=1),
            left[:, 1, 1] - left[:, 0, 1],
            right[:, 1, 1] - right[:, 0, 1],
        ],
        axis=-1,
    )
    middle, height = seen[:, :2].mean(axis=1), seen[:, 2:].mean(axis=1)
    # The width tells the turn but for its sign: two starts, and the better end wins.
    lean = np.arctan(middle)
    ratio = (seen[:, 1] - seen[:, 0]) / height * np.cos(lean)
    turn = np.arccos(np.clip(ratio, -1.0, np.cos(0.1)))
    ends = [_refined(seen, middle / height, 1 / height, s * turn - lean) for s in (1, -1)]
    better = ends[0][1] <= ends[1][1]
    shape = np.where(better[:, None], ends[0][0], ends[1][0])
    return _axis(shape, setback)


def _model(shape: Array) -> tuple[Array, Array]:
    """Returns edge places and heights (n, 4), and their derivatives (n, 4, 3).

    The shape is [X, Z, turn]: centre (right, forward) in sides, and the direction of the marker's
    right, [cos, sin] of the turn.
    """
    X, Z, turn = shape.T
    c, s = np.cos(turn) / 2, np.sin(turn) / 2
    values, slopes = np.empty((len(shape), 4)), np.zeros((len(shape), 4, 3))
    for k, side in enumerate((-1.0, 1.0)):
        x, z = X + side * c, Z + side * s
        values[:, k], values[:, 2 + k] = x / z, 1 / z
        slopes[:, k] = np.stack([1 / z, -x / z**2, -side * (s / z + x * c / z**2)], axis=-1)
        slopes[:, 2 + k, 1], slopes[:, 2 + k, 2] = -1 / z**2, -side * c / z**2
    return values, slopes


def _refined(seen: Array, X: Array, Z: Array, turn: Array) -> tuple[Array, Array]:
    """Returns the shape (n, 3) by Gauss-Newton, and its weighted sum of squares (n,)."""
    shape = np.stack([X, Z, turn], axis=-1)
    for _ in range(_ITERATIONS):
        values, slopes = _model(shape)
        J, r = slopes * _SCALE[:, None], (seen - values) * _SCALE
        step = np.linalg.solve(_damped(J), np.einsum("nij,ni->nj", J, r)[..., None])[..., 0]
        step[:, 2] = np.clip(step[:, 2], -0.3, 0.3)
        shape = shape + step
        shape[:, 1] = np.maximum(shape[:, 1], 1.0)
    residual = (seen - _model(shape)[0]) * _SCALE
    return shape, (residual**2).sum(axis=1)


def _damped(J: Array) -> Array:
    normal = np.swapaxes(J, 1, 2) @ J
    return np.asarray(normal + 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3))


def _axis(shape: Array, setback: float) -> tuple[Array, Array]:
    """Returns the axis' x/z and its variance for corners of variance 1."""
    X, Z, turn = shape.T
    c, s = np.cos(turn), np.sin(turn)
    x, z = X - setback * s, Z + setback * c  # the normal toward the camera is [s, -c]
    slope = np.stack(
        [1 / z, -x / z**2, -setback * (c / z - x * s / z**2)],
        axis=-1,
    )
    J = _model(shape)[1] * _SCALE[:, None]
    covariance = np.linalg.inv(_damped(J))
    return x / z, np.einsum("ni,nij,nj->n", slope, covariance, slope)


def axis_of_known_face(rays: Array, turn: Array, setback: float) -> Array:
    """Returns where the axis behind each marker shows whose face looks in a known direction.

    Args:
        rays: (n, 4, 2) x/z, y/z of the corners.
        turn: (n,) direction of the face's normal, to the left of the camera's, rad.
        setback: distance of the markers from the axis, by the side of their black square.

    Returns:
        x/z (n,).
    """
    height = (rays[:, [2, 3], 1] - rays[:, [1, 0], 1]).mean(axis=1)
    x = rays[..., 0].mean(axis=1) / height + setback * np.sin(turn)
    axis: Array = x / (1 / height - setback * np.cos(turn))
    return axis


def beacon_axes(
    ids: NDArray[np.int64],
    rays: Array,
    beacons: NDArray[np.int64],
    headings: Array,
    reference: int,
    direction: float,
    setback: float,
) -> Array:
    """Returns the axes' x/z (m,) of the beacons in a picture; NaN for one that is not.

    Args:
        ids: (n,) of the markers.
        rays: (n, 4, 2) of their corners.
        beacons: (m,) numbers of the robots.
        headings: (m,) theirs, rad; NaN where not known.
        reference: which beacon's line of sight is known; without it in the picture the axes of
            those with known headings are NaN.
        direction: of that line, rad in the frame of the headings.
        setback: see `axis_of_known_face`.
    """
    axes = np.full(len(beacons), np.nan)
    turned = np.isfinite(headings)
    by_shape = np.isin(ids // SIDES, beacons[~turned])
    for robot, axis in axes_by_robot(ids[by_shape], rays[by_shape], setback).items():
        axes[beacons == robot] = axis

    def known(k: int, ahead: float) -> float:
        mine = ids // SIDES == beacons[k]
        if not mine.any():
            return float("nan")
        turn = headings[k] + ids[mine] % SIDES * (np.pi / 2) - ahead
        return float(axis_of_known_face(rays[mine], turn, setback).mean())

    if turned[reference]:
        axes[reference] = 0.0
        for _ in range(3):  # the camera's direction by the axis, the axis by the direction
            axes[reference] = known(reference, direction + np.arctan(axes[reference]))
    for k in np.flatnonzero(turned):
        if k != reference:
            axes[k] = known(int(k), float(direction + np.arctan(axes[reference])))
    return axes


def axes_by_robot(ids: NDArray[np.int64], rays: Array, setback: float) -> dict[int, float]:
    """Returns the axis' x/z of each robot in the picture: of its markers, by their variances.

    Args:
        ids: (n,) of the markers.
        rays: (n, 4, 2) of their corners.
        setback: see `axis_of_marker`.
    """
    if len(ids) == 0:
        return {}
    places, variances = axis_of_marker(rays, setback)
    robots = ids // SIDES
    found = {}
    for robot in np.unique(robots):
        weights = (robots == robot) / variances
        found[int(robot)] = float((weights * places).sum() / weights.sum())
    return found
