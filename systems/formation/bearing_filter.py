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
from systems.compiled import compiled, in_rows, packed
from systems.formation.bearings import pixel_covariance, resect
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
    p, shape = parameters, x.shape
    x, P = x.copy(), P.copy()
    noise = np.array((p.distance_noise, p.turn_noise, p.drift_noise))
    travel = np.broadcast_to(travel, (*shape[:-1], 2))
    _predict(in_rows(x, SIZE), in_rows(P, SIZE, SIZE), in_rows(travel, 2), noise)
    return x, P


@compiled("void(f8[:,::1], f8[:,:,::1], f8[:,::1], f8[::1])")
def _predict(x: Array, P: Array, travel: Array, noise: Array) -> None:
    """Does `predict` for n robots in place; noise as in the parameters: by way, turn, drift."""
    for n in range(len(x)):
        distance, angle = travel[n, 0], travel[n, 1]
        middle = x[n, 2] + angle / 2
        c, s = math.cos(middle), math.sin(middle)
        # F P F' with F = 1 but for how the place follows the heading: rows, then columns.
        for k in range(SIZE):
            P[n, 0, k] -= distance * s * P[n, 2, k]
            P[n, 1, k] += distance * c * P[n, 2, k]
        for k in range(SIZE):
            P[n, k, 0] -= distance * s * P[n, k, 2]
            P[n, k, 1] += distance * c * P[n, k, 2]
        along = noise[0] * noise[0] * abs(distance)
        P[n, 0, 0] += along * c * c
        P[n, 0, 1] += along * c * s
        P[n, 1, 0] += along * c * s
        P[n, 1, 1] += along * s * s
        P[n, 2, 2] += noise[1] * noise[1] * abs(angle) + noise[2] * noise[2] * abs(distance)
        x[n, 0] += distance * c
        x[n, 1] += distance * s
        x[n, 2] = _wrapped(x[n, 2] + angle)


@compiled()
def _wrapped(angle: float) -> float:
    """Returns the angle (rad) in (-pi, pi]."""
    return math.pi - (math.pi - angle) % (2 * math.pi)


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
    shape = x.shape[:-1]
    x, P, u = x.copy(), P.copy(), np.asarray(u, float)
    points = np.broadcast_to(point, (*shape, 2))
    settings = np.array((focal_length, parameters.pixel_std, parameters.gate))
    used = np.zeros(x.size // SIZE, bool)
    _correct(
        in_rows(x, SIZE), in_rows(P, SIZE, SIZE), packed(np.broadcast_to(u, shape).reshape(-1)),
        in_rows(points, 2), settings, 3 + rear, used,
    )  # fmt: skip
    was_used = used.reshape(shape)
    return x, P, was_used, np.isfinite(u) & ~was_used


@compiled("void(f8[:,::1], f8[:,:,::1], f8[::1], f8[:,::1], f8[::1], i8, b1[::1])")
def _correct(
    x: Array,
    P: Array,
    u: Array,
    points: Array,
    settings: Array,
    camera: int,
    used: NDArray[np.bool_],
) -> None:
    """Does `correct` for n robots in place.

    Args:
        x: (n, 7).
        P: (n, 7, 7).
        u: (n,) px.
        points: (n, 2) m.
        settings: focal length (px), noise (px), gate.
        camera: where in the state its principal point is; its yaw is two further.
        used: (n,) written where a sighting is used; False at first.
    """
    focal_length = settings[0]
    H, PH = np.zeros(SIZE), np.empty(SIZE)
    for n in range(len(x)):
        x[n, 2] = _wrapped(x[n, 2])
        dx, dy = points[n, 0] - x[n, 0], points[n, 1] - x[n, 1]
        c, s = math.cos(x[n, 2]), math.sin(x[n, 2])
        ahead, aside = c * dx + s * dy, c * dy - s * dx
        seen = math.isfinite(u[n]) and (ahead < 0) == (camera == 4)
        if not (seen and abs(ahead) > _NEAREST):
            continue
        by_ahead, by_aside = focal_length * aside / ahead**2, -focal_length / ahead
        H[0] = s * by_aside - c * by_ahead
        H[1] = -s * by_ahead - c * by_aside
        H[2] = aside * by_ahead - ahead * by_aside
        H[camera] = 1.0
        H[camera + 2] = H[2]  # a camera turned is a robot turned
        variance = settings[1] * settings[1]
        innovation = u[n] + focal_length * aside / ahead
        innovation -= x[n, camera] + H[2] * x[n, camera + 2]
        for i in range(SIZE):
            PH[i] = 0.0
            for j in range(SIZE):
                PH[i] += P[n, i, j] * H[j]
            variance += H[i] * PH[i]
        if not innovation * innovation <= settings[2] * variance:
            continue
        used[n] = True
        for i in range(SIZE):
            gain = PH[i] / variance
            x[n, i] += gain * innovation
            for j in range(i + 1):
                mean = (P[n, i, j] + P[n, j, i]) / 2 - gain * PH[j]
                P[n, i, j] = P[n, j, i] = mean
        x[n, 2] = _wrapped(x[n, 2])


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
