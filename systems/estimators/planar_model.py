"""Motion and measurement model of a robot that knows its commands, its gyro and marker poses.

State: x (m), y (m), theta (rad) of base_link in map, the bias of the gyro (rad/s), the scale of the
wheels (true speed by commanded speed), the scale of the gyro (true turn by measured turn), and how
far the wheels' scale is now from where it is in the mean. Bias and scales are states, not noise,
because they last: an error of 0.02 rad/s or 3 % is the same now as in the last second, so markers
tell what it is and dead reckoning goes on with it. White noise in their place, as in [NAV], would
have to be so large that the covariance says nothing. Slip that comes and goes lasts for a while: a
Gauss-Markov process of first order (Gelb, ed., "Applied optimal estimation", 1974, section 3.8),
which dead reckoning lets fade to the mean as fast as it does in fact.

Covariances are in the order of the state. All functions are pure; times in seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled, in_rows, packed
from systems.estimators.planar_kalman import UNKNOWN
from systems.small_matrices import congruence, solve_positive

Array = NDArray[np.float64]

SIZE = 7
THETA, BIAS, SCALE, GYRO_SCALE, WANDER = 2, 3, 4, 5, 6

VERDICTS = ("started", "accepted", "gated", "ambiguous")  # the last: refused for that
_STARTED, _ACCEPTED, _GATED, _AMBIGUOUS = range(4)


class Drive(NamedTuple):
    """What moves the robot during one step.

    Attributes:
        speed: as commanded (or measured by encoders), m/s.
        yaw_rate: as the gyro says, rad/s.
        speed_variance: of the distance, m^2/s, beyond the model's own.
        turn_variance: of the heading, rad^2/s, beyond the model's own.
        gyro_weight: how many times the gyro's own noise counts; more than once where one sample
            stands for several.
    """

    speed: float
    yaw_rate: float
    speed_variance: float = 0.0
    turn_variance: float = 0.0
    gyro_weight: float = 1.0


class ProcessNoise(NamedTuple):
    """Variances that grow with time, distance or turning: squares of the filter's parameters.

    Attributes:
        speed: of the distance, by time, m^2/s.
        slip: of the distance, by distance, m^2/m.
        side: of the sideways position, by turning, m^2/rad.
        gyro: of the heading, by time, rad^2/s.
        turn: of the heading, by turning, rad^2/rad.
        bias: of the gyro's bias, by time, (rad/s)^2/s.
        scale: of the wheels' scale, by time, 1/s.
        gyro_scale: of the gyro's scale, by time, 1/s.
        wander: of the wheels' scale about its mean; does not grow.
        fading: rate at which the wheels' scale returns to its mean, 1/s.
    """

    speed: float
    slip: float
    side: float
    gyro: float
    turn: float
    bias: float
    scale: float
    gyro_scale: float
    wander: float = 0.0
    fading: float = 0.0


def unknown(
    bias_std: float, scale_std: float, gyro_scale_std: float, wander_std: float = 0.0
) -> tuple[Array, Array]:
    """Returns state (7,) and covariance (7, 7) before anything is known of the pose.

    Args:
        bias_std: standard deviation of the gyro's bias, rad/s.
        scale_std: of the wheels' scale.
        gyro_scale_std: of the gyro's scale.
        wander_std: of the wheels' scale about its mean.
    """
    x = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0])
    known = np.square([bias_std, scale_std, gyro_scale_std, wander_std])
    return x, np.diag([UNKNOWN, UNKNOWN, UNKNOWN, *known])


def is_known(P: Array) -> bool:
    """Whether there has been a start: whether the covariance is not that of `unknown`."""
    return bool(P[0, 0] < UNKNOWN)


def predict(
    x: Array, P: Array, drive: Drive, dt: float, noise: ProcessNoise
) -> tuple[Array, Array]:
    """Dead-reckons one step with the heading of its middle, which follows an arc to second order.

    Args:
        x: (7,) state.
        P: (7, 7) its covariance.
        drive: speed and yaw rate, constant over the step.
        dt: length of the step, s.
        noise: variance rates.

    Returns:
        The state and F P F' + G Q G' after the step.
    """
    predicted, grown = np.empty(SIZE), np.empty((SIZE, SIZE))
    step = np.array([*drive, dt])
    predict_into(packed(x), in_rows(P, SIZE), step, np.array(noise), predicted, grown)
    return predicted, grown


def linearize(x: Array, drive: Drive, dt: float, fading: float = 0.0) -> tuple[Array, Array, Array]:
    """Returns the derivatives of one step and where it leads; `fading` as in `ProcessNoise`.

    Returns:
        F: (7, 7) by the state. G: (7, 7) by what noise adds over the step: distance along and
        across the heading (m), heading (rad), bias (rad/s), scales, the wheels' deviation from
        theirs. The state after it: (7,).
    """
    F, G, predicted = np.empty((SIZE, SIZE)), np.empty((SIZE, SIZE)), np.empty(SIZE)
    _linearize(packed(x), drive.speed, drive.yaw_rate, dt, fading, F, G, predicted)
    return F, G, predicted


@compiled("void(f8[::1], f8, f8, f8, f8, f8[:,::1], f8[:,::1], f8[::1])")
def _linearize(
    x: Array,
    speed: float,
    yaw_rate: float,
    dt: float,
    fading: float,
    F: Array,
    G: Array,
    predicted: Array,
) -> None:
    theta, bias, gyro_scale = x[THETA], x[BIAS], x[GYRO_SCALE]
    scale = x[SCALE] + x[WANDER]
    measured = (yaw_rate - bias) * dt
    turn = gyro_scale * measured
    c, s = math.cos(theta + turn / 2), math.sin(theta + turn / 2)
    by_scale_x, by_scale_y = speed * dt * c, speed * dt * s
    dx, dy = scale * by_scale_x, scale * by_scale_y
    for i in range(SIZE):
        for j in range(SIZE):
            F[i, j] = G[i, j] = 1.0 if i == j else 0.0
        predicted[i] = x[i]
    F[0, 2], F[1, 2] = -dy, dx
    # A change of the turn moves the heading, and half of it that of the middle.
    F[2, 3], F[2, 5] = -gyro_scale * dt, measured
    F[0, 3], F[1, 3] = dy * gyro_scale * dt / 2, -dx * gyro_scale * dt / 2
    F[0, 4], F[1, 4] = by_scale_x, by_scale_y
    F[0, 6], F[1, 6] = by_scale_x, by_scale_y
    F[6, 6] = math.exp(-fading * dt)
    F[0, 5], F[1, 5] = -dy * measured / 2, dx * measured / 2
    G[0, 0], G[1, 0] = c, s
    G[0, 1], G[1, 1] = -s, c
    # Turning noise comes evenly over the step: the middle has half of it.
    G[0, 2], G[1, 2] = -dy / 2, dx / 2
    predicted[0], predicted[1] = x[0] + dx, x[1] + dy
    predicted[WANDER] = F[6, 6] * x[WANDER]
    predicted[THETA] = math.pi - (math.pi - theta - turn) % (2 * math.pi)


@compiled("void(f8[::1], f8[:,::1], f8[::1], f8[::1], f8[::1], f8[:,::1])")
def predict_into(
    x: Array, P: Array, step: Array, noise: Array, predicted: Array, grown: Array
) -> None:
    """Writes what `predict` returns, not into x or P; for compiled callers.

    Args:
        x: (7,).
        P: (7, 7).
        step: (6,) the entries of `Drive`, then dt.
        noise: (10,) the entries of `ProcessNoise`.
        predicted: (7,), written.
        grown: (7, 7), written.
    """
    speed, yaw_rate, speed_variance, turn_variance, gyro_weight, dt = step
    speed_noise, slip_noise, side_noise, gyro_noise, turn_noise = noise[:5]
    F, G, added = np.empty((SIZE, SIZE)), np.empty((SIZE, SIZE)), np.empty((SIZE, SIZE))
    wander, fading = noise[8], noise[9]
    _linearize(x, speed, yaw_rate, dt, fading, F, G, predicted)
    v, omega = abs(speed), abs(yaw_rate)
    Q = np.zeros((SIZE, SIZE))
    Q[0, 0] = (speed_noise + slip_noise * v + speed_variance) * dt
    Q[1, 1] = side_noise * omega * dt
    Q[2, 2] = ((gyro_noise + turn_noise * omega) * gyro_weight + turn_variance) * dt
    for i in range(3, WANDER):
        Q[i, i] = noise[2 + i] * dt
    Q[6, 6] = wander * (1 - F[6, 6] ** 2)  # keeps the variance where it is in the long run
    congruence(G, Q, added)
    congruence(F, P, grown)
    for i in range(SIZE):
        for j in range(SIZE):
            grown[i, j] += added[i, j]


def update(x: Array, P: Array, z: Array, R: Array) -> tuple[Array, Array]:
    """Corrects the state by a measured pose; the covariance in Joseph's form.

    Joseph's form, (I - K H) P (I - K H)' + K R K', stays symmetric and positive whatever rounding
    does to K: marker poses can be a thousand times as exact as the prediction.

    Args:
        x: (7,) state.
        P: (7, 7).
        z: (3,) measured [x, y, theta].
        R: (3, 3) its covariance.

    Returns:
        The corrected state and covariance.
    """
    corrected, reduced = np.empty(SIZE), np.empty((SIZE, SIZE))
    if not _update(packed(x), in_rows(P, SIZE), packed(z), in_rows(R, 3), corrected, reduced):
        raise np.linalg.LinAlgError("P + R is not positive definite")
    return corrected, reduced


@compiled()
def _wrap(angle: float) -> float:
    return math.pi - (math.pi - angle) % (2 * math.pi)


@compiled("b1(f8[::1], f8[:,::1], f8[::1], f8[:,::1], f8[::1], f8[:,::1])")
def _update(x: Array, P: Array, z: Array, R: Array, corrected: Array, reduced: Array) -> bool:
    K, S, noise = np.empty((SIZE, 3)), np.empty((3, 3)), np.empty((SIZE, SIZE))
    for i in range(SIZE):
        for j in range(3):
            K[i, j] = P[i, j]
            for k in range(3):
                S[j, k] = P[j, k] + R[j, k]
        if not solve_positive(S, K[i]):
            return False
    A = np.zeros((SIZE, SIZE))
    dx, dy, turn = z[0] - x[0], z[1] - x[1], _wrap(z[2] - x[2])
    for i in range(SIZE):
        A[i, i] = 1.0
        for j in range(3):
            A[i, j] -= K[i, j]
        corrected[i] = x[i] + K[i, 0] * dx + K[i, 1] * dy + K[i, 2] * turn
    corrected[THETA] = _wrap(corrected[THETA])
    congruence(A, P, reduced)
    congruence(K, R, noise)
    for i in range(SIZE):
        for j in range(SIZE):
            reduced[i, j] += noise[i, j]
    return True


@dataclass(frozen=True, eq=False)
class Measurement:
    """What one picture says of the pose.

    Attributes:
        stamp: time of the picture, s.
        poses: (1 or 2, 3) [x, y, theta], the better solution first.
        covariances: (1 or 2, 3, 3) of them.
        ambiguous: whether the second is nearly as good as the first.
    """

    stamp: float
    poses: Array
    covariances: Array
    ambiguous: bool = False


@dataclass(frozen=True, eq=False)
class Correction:
    """What became of a measurement.

    Attributes:
        verdict: one of `VERDICTS`.
        x: (7,) state after it.
        P: (7, 7) covariance after it.
        nis: squared Mahalanobis distance by degrees of freedom; NaN if none was looked at.
        x_before: (7,) state before it, at the time of the picture.
        P_before: (7, 7).
    """

    verdict: str
    x: Array
    P: Array
    nis: float
    x_before: Array
    P_before: Array


def correct(
    x: Array,
    P: Array,
    measurement: Measurement,
    drive: Drive,
    *,
    stamp_variance: float,
    gate: float,
    take_ambiguous: bool,
) -> Correction:
    """Starts from a measurement, takes it, or refuses it.

    Args:
        x: (7,) state at the time of the picture.
        P: (7, 7).
        measurement: with its second solution, if there is one.
        drive: how the robot moved then.
        stamp_variance: of the time of the picture, s^2.
        gate: largest squared Mahalanobis distance that is taken.
        take_ambiguous: whether the nearer solution of an ambiguous picture is taken. A start needs
            one that is not ambiguous.
    """
    rules = np.array([stamp_variance, gate, float(take_ambiguous)])
    corrected, reduced = np.empty(SIZE), np.empty((SIZE, SIZE))
    verdict, nis = correct_into(
        packed(x), in_rows(P, SIZE), in_rows(measurement.poses, 3),
        in_rows(measurement.covariances, 3, 3), measurement.ambiguous, drive.speed,
        drive.yaw_rate, rules, corrected, reduced,
    )  # fmt: skip
    return Correction(VERDICTS[verdict], corrected, reduced, nis, x, P)


@compiled(
    "Tuple((i8, f8))(f8[::1], f8[:,::1], f8[:,::1], f8[:,:,::1], b1, f8, f8, f8[::1],"
    " f8[::1], f8[:,::1])"
)
def correct_into(
    x: Array,
    P: Array,
    poses: Array,
    covariances: Array,
    ambiguous: bool,
    speed: float,
    yaw_rate: float,
    rules: Array,
    corrected: Array,
    reduced: Array,
) -> tuple[int, float]:
    """Writes state and covariance of what `correct` returns, not into x or P; for compiled callers.

    Args:
        x: (7,).
        P: (7, 7).
        poses: (1 or 2, 3).
        covariances: (1 or 2, 3, 3).
        ambiguous: see `Measurement`.
        speed: see `Drive`.
        yaw_rate: see `Drive`.
        rules: (3,) variance of the stamp (s^2), gate, and 1 or 0 for `take_ambiguous`.
        corrected: (7,), written.
        reduced: (7, 7), written.

    Returns:
        Index of the verdict in `VERDICTS`, and NIS.
    """
    stamp_variance, gate = rules[0], rules[1]
    corrected[:], reduced[:] = x, P
    known = P[0, 0] < UNKNOWN
    if ambiguous and not (known and rules[2] > 0):
        return _AMBIGUOUS, math.nan
    theta = x[THETA] if known else poses[0, THETA]
    # Taken a moment earlier or later, it would show a pose further back or ahead.
    v = (x[SCALE] + x[WANDER]) * speed
    velocity = (
        v * math.cos(theta),
        v * math.sin(theta),
        x[GYRO_SCALE] * (yaw_rate - x[BIAS]),
    )
    R, S, y = np.empty((len(poses), 3, 3)), np.empty((3, 3)), np.empty(3)
    nearest, least = 0, math.inf
    for n in range(len(poses) if ambiguous else 1):
        for i in range(3):
            y[i] = poses[n, i] - x[i]
            for j in range(3):
                R[n, i, j] = covariances[n, i, j] + stamp_variance * velocity[i] * velocity[j]
                S[i, j] = P[i, j] + R[n, i, j]
        if not known:
            corrected[:3], reduced[:3, :3] = poses[0], R[0]
            return _STARTED, math.nan
        y[THETA] = _wrap(y[THETA])
        dx, dy, turn = y
        if solve_positive(S, y):
            distance = dx * y[0] + dy * y[1] + turn * y[2]
            if distance < least:
                nearest, least = n, distance
    if not least <= gate or not _update(x, P, poses[nearest], R[nearest], corrected, reduced):
        return _GATED, least / 3
    return _ACCEPTED, least / 3


def is_covariance(R: Array) -> bool:
    """Whether R (3, 3) is finite, positive definite and says something at all.

    Zeros are what many send who have no covariance.
    """
    if not np.isfinite(R).all():
        return False
    (a, b, c), (_, d, e), (_, _, f) = R.tolist()
    minor = a * d - b * b
    determinant = minor * f - a * e * e + 2 * b * c * e - d * c * c
    return min(a, d, f, minor, determinant) > 0 and max(a, d, f) < UNKNOWN


def chi_square_3(probability: float) -> float:
    """Returns what a chi-square with 3 degrees of freedom stays below with this probability.

    Its distribution is erf(sqrt(q / 2)) - sqrt(2 q / pi) exp(-q / 2); solved by bisection.
    """
    low, high = 0.0, 1e3
    for _ in range(100):
        q = (low + high) / 2
        below = math.erf(math.sqrt(q / 2)) - math.sqrt(2 * q / math.pi) * math.exp(-q / 2)
        low, high = (q, high) if below < probability else (low, q)
    return low
