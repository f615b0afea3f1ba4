"""A robot's pose from its commands and the bearings it sees: an extended Kalman filter.

The state is [x (m), y (m), theta (rad), centre_front (px), centre_rear (px), yaw_front (rad),
yaw_rear (rad)]: the pose, by how much each camera's principal point shows too far right, and by how
much each camera looks too far to the left. Of one place the last four tell nothing, as they look
like an error of the pose; what is known of them at the start bounds them, and driving tells more.
Each sighting is a correction of its own, so one beacon alone helps, and three are a resection
averaged over all pictures so far.

Leading dimensions are batches; a batch of none is one robot.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from systems.angles import wrap
from systems.formation.bearings import in_robot, lateral_pixels, pixel_covariance, resect
from systems.validation import require_non_negative, require_positive

Array = NDArray[np.float64]

SIZE = 7

_UNKNOWN = 100.0  # variance, m^2 and rad^2
_NEAREST = 0.05  # m ahead of a camera; nearer is beside the robot


@dataclass
class BearingFilterParameters:
    """Noise of sight and motion.

    Attributes:
        pixel_std: of a lateral pixel in one picture, px.
        centre_std: what is known of each camera's principal point, px; 0 for calibrated ones.
        yaw_std: what is known of each camera's direction, rad; 0 for calibrated ones.
        distance_noise: random walk of the distance driven against the commanded one, m/sqrt(m).
        turn_noise: of the angle turned, by the angle, rad/sqrt(rad).
        drift_noise: of the heading, by the distance, rad/sqrt(m).
        gate: a sighting whose squared Mahalanobis distance exceeds this is refused; 15.1 is one in
            10,000 of chi-square with 1 degree of freedom.
    """

    pixel_std: float = 0.5
    centre_std: float = 0.0
    yaw_std: float = 0.0
    distance_noise: float = 0.02
    turn_noise: float = 0.02
    drift_noise: float = 0.02
    gate: float = 15.1

    def __post_init__(self) -> None:
        require_positive(pixel_std=self.pixel_std, gate=self.gate)
        require_non_negative(
            centre_std=self.centre_std,
            yaw_std=self.yaw_std,
            distance_noise=self.distance_noise,
            turn_noise=self.turn_noise,
            drift_noise=self.drift_noise,
        )


def start(
    pose: Array, covariance: Array, parameters: BearingFilterParameters
) -> tuple[Array, Array]:
    """Returns state (..., 7) and covariance (..., 7, 7) of a pose that is known so well.

    Args:
        pose: (..., 3).
        covariance: (..., 3, 3) or (3, 3).
        parameters: what is known of the cameras.
    """
    x = np.zeros((*pose.shape[:-1], SIZE))
    x[..., :3] = pose
    P = np.zeros((*pose.shape[:-1], SIZE, SIZE))
    P[..., :3, :3] = covariance
    P[..., [3, 4], [3, 4]] = parameters.centre_std**2
    P[..., [5, 6], [5, 6]] = parameters.yaw_std**2
    return x, P


def moved(pose: Array, travel: Array) -> Array:
    """Returns poses (..., 3) after short arcs [distance (m), angle (rad)] (..., 2)."""
    middle = pose[..., 2] + travel[..., 1] / 2
    steps = np.stack(
        [travel[..., 0] * np.cos(middle), travel[..., 0] * np.sin(middle), travel[..., 1]], axis=-1
    )
    result: Array = pose + steps
    result[..., 2] = wrap(np.asarray(result[..., 2]))
    return result


def arcs(sent: Array, dt: float, now: float, start: float, end: float) -> Iterator[Array]:
    """Yields the arcs [distance (m), angle (rad)] driven from `start` to `end` (s).

    Args:
        sent: (n, 2) commands, the newest first: the first one holds since now - dt.
        dt: for how long each held, s.
        now: s.
        start: not before now - n dt, s.
        end: s.
    """
    oldest = min(math.ceil((now - start) / dt) + 1, len(sent)) - 1
    newest = max(math.floor((now - end) / dt) - 1, 0)
    for k in range(oldest, newest - 1, -1):
        begin = now - (k + 1) * dt
        duration = min(begin + dt, end) - max(begin, start)
        if duration > 1e-9 and sent[k].any():
            yield sent[k] * duration


def predict(
    x: Array, P: Array, travel: Array, parameters: BearingFilterParameters
) -> tuple[Array, Array]:
    """Carries the state on by a short arc [distance (m), angle (rad)] (..., 2), as commanded."""
    distance, angle = travel[..., 0], travel[..., 1]
    middle = x[..., 2] + angle / 2
    c, s = np.cos(middle), np.sin(middle)
    along = parameters.distance_noise**2 * np.abs(distance)
    # F P F' with F = 1 but for how the place follows the heading: row after row, then columns.
    P = P.copy()
    by_heading = np.stack([-distance * s, distance * c], axis=-1)
    P[..., :2, :] += by_heading[..., None] * P[..., 2:3, :]
    P[..., :, :2] += by_heading[..., None, :] * P[..., :, 2:3]
    P[..., 0, 0] += along * c * c
    P[..., 0, 1] += along * c * s
    P[..., 1, 0] += along * c * s
    P[..., 1, 1] += along * s * s
    P[..., 2, 2] += parameters.turn_noise**2 * np.abs(angle)
    P[..., 2, 2] += parameters.drift_noise**2 * np.abs(distance)
    return np.concatenate([moved(x[..., :3], travel), x[..., 3:]], axis=-1), P


def correct(
    x: Array,
    P: Array,
    u: Any,
    point: Array,
    focal_length: float,
    parameters: BearingFilterParameters,
    *,
    rear: bool,
) -> tuple[Array, Array, Any, Any]:
    """Corrects the state by one sighting.

    Args:
        x: (..., 7).
        P: (..., 7, 7).
        u: (...) lateral pixel; NaN where the point is not seen.
        point: (..., 2) m.
        focal_length: px.
        parameters: noise and gate.
        rear: which camera.

    Returns:
        State and covariance; where it was used (...), and where it was refused (...): by the gate,
        or because that camera cannot see the point.
    """
    ahead = in_robot(x[..., :3], point[..., None, :])[..., 0, 0]
    seen = np.isfinite(u) & ((ahead < 0) == rear) & (np.abs(ahead) > _NEAREST)
    with np.errstate(divide="ignore", invalid="ignore"):  # of what is beside, and not used
        expected, by_pose = lateral_pixels(x[..., :3], point[..., None, :], focal_length)
    expected = np.where(seen, expected[..., 0], 0.0)
    by_pose = np.where(seen[..., None], by_pose[..., 0, :], 0.0)
    H = np.zeros_like(x)
    H[..., :3] = by_pose
    H[..., 3 + rear] = 1.0
    H[..., 5 + rear] = by_pose[..., 2]  # a camera turned is a robot turned
    innovation = np.where(seen, u, 0.0) - expected - x[..., 3 + rear]
    innovation = innovation - by_pose[..., 2] * x[..., 5 + rear]
    PH = (P @ H[..., None])[..., 0]
    variance = (H * PH).sum(axis=-1) + parameters.pixel_std**2
    used = seen & (innovation**2 <= parameters.gate * variance)
    gain = PH / variance[..., None] * used[..., None]
    x = x + gain * innovation[..., None]
    x[..., 2] = wrap(np.asarray(x[..., 2]))
    P = P - gain[..., :, None] * PH[..., None, :]
    return x, (P + np.swapaxes(P, -1, -2)) / 2, used, np.isfinite(u) & ~used


def restart(
    u: Array,
    points: Array,
    focal_length: float,
    guess: Array,
    parameters: BearingFilterParameters,
    *,
    rear: bool,
) -> tuple[Array, Array, Any]:
    """Begins anew at the resection from one picture, whatever was believed before.

    A filter that comes from a poor start with bearings of one beacon has linearised at wrong
    places; the first sight of three needs no start.

    Args:
        u: (..., n) lateral pixels of n >= 3 points.
        points: (..., n, 2) m.
        focal_length: px.
        guess: (..., 3) roughly the pose (see `resect`).
        parameters: noise.
        rear: which camera.

    Returns:
        State and covariance, and where there is one (...); elsewhere they are of no use.
    """
    covariance = pixel_covariance(u.shape[-1], parameters.pixel_std, parameters.centre_std)
    pose = resect(u, points, focal_length, covariance, guess).pose
    found = np.asarray(np.isfinite(pose).all(axis=-1))
    pose = np.where(found[..., None], pose, guess)
    # From knowing nothing, at the place that explains the picture: the pose stays, and its errors
    # become those of the pixels and of the camera, with all their correlations.
    x, P = start(pose, np.eye(3) * _UNKNOWN, parameters)
    for k in range(u.shape[-1]):
        _, P, _, _ = correct(
            x, P, u[..., k], points[..., k, :], focal_length, parameters, rear=rear
        )
    return x, P, found
