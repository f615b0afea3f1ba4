"""How a body rocks on its springs over a chassis: a random motion, and what it does to the body's.

B0 is the chassis' frame, B that of the body on the springs: their origins are one, and
`R_B0B = exp([r]x)` with r = (x, y, 0), a tilt against the chassis' z.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled
from systems.small_matrices import multiply, rotation_of_quaternion
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

_SINES = 12  # for each axis
_FADE = 0.5  # s
_SMALL = 1e-2  # rad^2; below, series are more exact than what they are the series of


@dataclass
class RockingParameters:
    """How a body rocks: a random motion whose spectrum is even from one frequency to another.

    Attributes:
        bound: of the tilt about each axis, rad. The standard deviation is bound / sqrt(3), that of
            what lies evenly within the bound; the tilt, nearly normally distributed, is beyond it
            for a twelfth of the time.
        lowest: frequency, Hz.
        highest: frequency, Hz.
    """

    bound: float = math.radians(0.3)
    lowest: float = 0.2
    highest: float = 3.0

    def __post_init__(self) -> None:
        require_non_negative(bound=self.bound)
        require_positive(lowest=self.lowest, highest=self.highest)
        above = self.highest > self.lowest
        require(above, "highest", self.highest, f"greater than lowest, {self.lowest:g} Hz")


class Waves(NamedTuple):
    """Sines that make up a tilt: it is the imaginary part of the sum of weights exp(i rates t).

    Attributes:
        rates: (2, n) for x and y, rad/s.
        weights: (3, 2, n) complex: of the tilt, of its first and of its second derivative by time.
    """

    rates: Array
    weights: NDArray[np.complex128]


def draw_waves(parameters: RockingParameters, random: np.random.Generator) -> Waves:
    """Draws the sines: one from each of as many equal parts of the band, so that none is empty."""
    p, shape = parameters, (2, _SINES)
    place = (np.arange(_SINES) + random.random(shape)) / _SINES
    rates = 2 * math.pi * (p.lowest + (p.highest - p.lowest) * place)
    amplitude = p.bound * math.sqrt(2 / (3 * _SINES))
    wave = amplitude * np.exp(1j * random.uniform(0, 2 * math.pi, shape))
    return Waves(rates, np.array([wave, 1j * rates * wave, -(rates**2) * wave]))


def tilt(waves: Waves, t: float) -> tuple[Array, Array, Array]:
    """Returns the tilt (2,) rad at t (s), and its first and second derivative by time.

    It fades in during the first half second, from rest at zero.
    """
    q = np.empty((3, 2))
    _tilt(waves.rates, waves.weights, float(t), q)
    return q[0], q[1], q[2]


@compiled("void(f8[:,::1], c16[:,:,::1], f8, f8[:,::1])")
def _tilt(rates: Array, weights: NDArray[np.complex128], t: float, q: Array) -> None:
    """Writes the sums of the waves and of their two derivatives, (3, 2), at t (s)."""
    q[:] = 0.0
    for axis in range(2):
        for k in range(rates.shape[1]):
            c, s = math.cos(t * rates[axis, k]), math.sin(t * rates[axis, k])
            for n in range(3):
                q[n, axis] += weights[n, axis, k].real * s + weights[n, axis, k].imag * c
    s = t / _FADE
    if s >= 1:
        return
    # s^3 (10 - 15 s + 6 s^2): its first and second derivative are zero at both ends.
    f = s**3 * (10 - 15 * s + 6 * s * s)
    f_dot = 30 * (s * (1 - s)) ** 2 / _FADE
    f_ddot = 60 * s * (1 - s) * (1 - 2 * s) / _FADE**2
    for axis in range(2):
        q[2, axis] = f_ddot * q[0, axis] + 2 * f_dot * q[1, axis] + f * q[2, axis]
        q[1, axis] = f_dot * q[0, axis] + f * q[1, axis]
        q[0, axis] *= f


@compiled()
def _coefficients(s: float) -> tuple[float, float, float, float, float]:
    """Returns sin(a) / a, b = (1 - cos(a)) / s, c = (a - sin(a)) / (a s), db/ds, dc/ds; s = a^2."""
    if s < _SMALL:
        return (
            1 - s * (1 / 6 - s * (1 / 120 - s / 5040)),
            1 / 2 - s * (1 / 24 - s * (1 / 720 - s / 40320)),
            1 / 6 - s * (1 / 120 - s * (1 / 5040 - s / 362880)),
            -1 / 24 + s * (1 / 360 - s / 13440),
            -1 / 120 + s * (1 / 2520 - s / 120960),
        )
    angle = math.sqrt(s)
    a, b = math.sin(angle) / angle, (1 - math.cos(angle)) / s
    c = (1 - a) / s
    return a, b, c, (a - 2 * b) / (2 * s), (b - 3 * c) / (2 * s)


def tilted(r: Array, r_dot: Array, r_ddot: Array) -> tuple[Array, Array, Array]:
    """Returns how a body that is tilted is turned, and turns.

    With r = (x, y, 0) and k = x dy/dt - y dx/dt the angular velocity J(r) dr/dt, J the left
    Jacobian of SO(3), is (dx/dt + c k y, dy/dt - c k x, b k).

    Args:
        r: (2,) tilt about x and y, rad.
        r_dot: (2,) rad/s.
        r_ddot: (2,) rad/s^2.

    Returns:
        `R_B0B` (3, 3), the angular velocity (3,) of B in B0 and the angular acceleration (3,), told
        in B0.
    """
    R, turning = np.empty((3, 3)), np.empty((2, 3))
    _tilted(np.array([r, r_dot, r_ddot]), R, turning)
    return R, turning[0], turning[1]


@compiled("void(f8[:,::1], f8[:,::1], f8[:,::1])")
def _tilted(q: Array, R: Array, turning: Array) -> None:
    """Writes the same of a tilt and its derivatives (3, 2): velocity, then acceleration, (2, 3)."""
    (x, u, du), (y, v, dv) = (q[0, 0], q[1, 0], q[2, 0]), (q[0, 1], q[1, 1], q[2, 1])
    s = x * x + y * y
    a, b, c, b_s, c_s = _coefficients(s)
    k, dk, ds = x * v - y * u, x * dv - y * du, 2 * (x * u + y * v)
    ck, d_ck = c * k, c_s * ds * k + c * dk
    R[0, 0], R[0, 1], R[0, 2] = 1 - b * y * y, b * x * y, a * y
    R[1, 0], R[1, 1], R[1, 2] = b * x * y, 1 - b * x * x, -a * x
    R[2, 0], R[2, 1], R[2, 2] = -a * y, a * x, 1 - b * s
    turning[0, 0], turning[0, 1], turning[0, 2] = u + ck * y, v - ck * x, b * k
    turning[1, 0] = du + d_ck * y + ck * v
    turning[1, 1] = dv - d_ck * x - ck * u
    turning[1, 2] = b_s * ds * k + b * dk


# Of the body in W: pose (3, 4) row by row; velocity; what it adds to B0's angular acceleration.
POSE, VELOCITY, ADDED = slice(12), slice(12, 18), slice(18, 21)


@compiled("void(f8[:,::1], c16[:,:,::1], f8, f8[::1], i8, f8[::1])")
def ride(
    rates: Array,
    weights: NDArray[np.complex128],
    t: float,
    state: Array,
    num_positions: int,
    motion: Array,
) -> None:
    """Writes the motion (21,) in W of a body that rocks over a chassis.

    Args:
        rates: see `Waves`, as `weights`.
        weights: likewise.
        t: s.
        state: of the chassis: positions, of which its quaternion and place are the first seven,
            then velocities, of which its own are the first six.
        num_positions: in `state`.
        motion: written: `X_WB` (3, 4), `V_WB` (6, rotation first), and by what its angular
            acceleration exceeds that of the chassis (3).
    """
    q, R_B0B, turning = np.empty((3, 2)), np.empty((3, 3)), np.empty((2, 3))
    _tilt(rates, weights, t, q)
    _tilted(q, R_B0B, turning)
    R, R_WB = np.empty((3, 3)), np.empty((3, 3))  # R: of the chassis
    rotation_of_quaternion(state[:4], R)
    multiply(R, R_B0B, R_WB)
    pose, velocity, added = motion[POSE].reshape(3, 4), motion[VELOCITY], motion[ADDED]
    pose[:, :3] = R_WB
    pose[:, 3] = state[4:7]
    velocity[:] = state[num_positions : num_positions + 6]
    w0, w = velocity[:3].copy(), np.empty(3)
    for i in range(3):
        w[i] = R[i, 0] * turning[0, 0] + R[i, 1] * turning[0, 1] + R[i, 2] * turning[0, 2]
        velocity[i] += w[i]
        added[i] = R[i, 0] * turning[1, 0] + R[i, 1] * turning[1, 1] + R[i, 2] * turning[1, 2]
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        added[i] += w0[a] * w[b] - w0[b] * w[a]  # what turns with the chassis: Coriolis
