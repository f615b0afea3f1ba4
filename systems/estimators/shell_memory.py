"""What the filter in `shell_ekf` remembers beside its state, and what it tells from it of now.

The memory is one vector, so that it can be a system's discrete state: time of the state, stamps of
the last increment and of the last marker pose; the IMU's last sample and for how long it has not
changed; what the gyro is believed to tell now; the number of that sample; the last refused pose:
rotation, marker, time, NaN for none; then the rates of the recent past, see `rate_trail`.

Compiled, for it goes on at the rate of the IMU.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled
from systems.estimators.rate_trail import WIDTH, add_row, rows_for, turn_between
from systems.estimators.shell_arithmetic import (
    DELAY,
    SIZE,
    pose_after,
    pose_covariance,
    predict,
    stand,
)
from systems.small_matrices import unfold

Array = NDArray[np.float64]

TIME, FLOW_STAMP, MARKER_STAMP = 0, 1, 2
SAMPLE, UNCHANGED, RATE, NEWEST = slice(3, 9), 9, slice(10, 13), 13
REFUSED, REFUSED_R, REFUSED_MARKER, TRAIL = slice(14, 25), slice(14, 23), 23, 25


def fresh_memory(duration: float, rate: float) -> Array:
    """Returns the memory of a filter that has heard nothing yet.

    Args:
        duration: how long rates are remembered, s.
        rate: of the IMU, Hz.
    """
    memory = np.full(TRAIL + rows_for(duration, rate) * WIDTH, np.nan)
    memory[SAMPLE.stop : REFUSED.start] = 0.0
    return memory


@compiled("f8[:,::1](f8[::1])")
def trail_of(memory: Array) -> Array:
    """Returns the rows of the rates, a view."""
    return memory[TRAIL:].reshape((len(memory) - TRAIL) // WIDTH, WIDTH)


@compiled("UniTuple(b1, 2)(f8, f8[::1], f8[::1], f8[::1], f8[::1])")
def listen(
    t: float, memory: Array, sample: Array, reference: Array, options: Array
) -> tuple[bool, bool]:
    """Remembers the rates of this moment, see `ShellFusion.listen`.

    Args:
        t: s.
        memory: changed.
        sample: (6,), or of size 0 if it is not used.
        reference: (6,), or of size 0.
        options: rate (Hz), the gyro's range (rad/s), after how long an unchanged one is lost (s).

    Returns:
        Whether the sample and the reference's velocity were wrong.
    """
    rate, gyro_range, silence = options[0], options[1], options[2]
    k = round(t * rate)
    memory[NEWEST] = k
    if math.isnan(memory[TIME]):
        memory[TIME] = t
    turning, bad_reference = np.zeros(3), False
    if len(reference):
        for i in range(3):
            bad_reference = bad_reference or not math.isfinite(reference[i])
        if not bad_reference:
            turning[:] = reference[:3]
    lost, told = True, memory[SAMPLE]
    if len(sample):
        unchanged, within = True, True
        for i in range(6):
            unchanged = unchanged and sample[i] == told[i]
            within = within and (i >= 3 or abs(sample[i]) <= gyro_range)
            told[i] = sample[i]
        memory[UNCHANGED] = memory[UNCHANGED] + 1.0 / rate if unchanged else 0.0
        lost = not within or memory[UNCHANGED] >= silence
        if not lost:
            memory[RATE] = sample[:3]
    add_row(trail_of(memory), k, memory[RATE], turning, lost, rate)
    return lost and len(sample) > 0, bad_reference


@compiled()
def _turn_ahead(t: float, memory: Array, x: Array, options: Array, told: Array) -> float:
    """Writes the turn (13,) since the last picture and returns the time since it, s."""
    start = memory[TIME] - x[DELAY]
    rate, age = options[0], options[1]
    turn_between(trail_of(memory), start, t, age, rate, int(memory[NEWEST]), told)
    told[9:12] = 0.0  # only the beginning of this interval is uncertain
    return t - start


@compiled("void(f8, f8[::1], f8[:,::1], f8[::1], f8[::1], f8[:,::1])")
def pose_now(t: float, memory: Array, R: Array, x: Array, options: Array, X_RB: Array) -> None:
    """Writes the pose (3, 4) now, see `ShellFusion.pose`.

    Args:
        t: s.
        memory: as it is.
        R: (3, 3).
        x: (n,).
        options: rate (Hz), age of a sample (s), reach (m), correlation time of the rock (s).
        X_RB: written.
    """
    R_now, p, told, reach = R.copy(), np.empty(3), np.empty(13), options[2]
    if math.isnan(memory[TIME]):
        stand(R, x, reach, p)
    else:
        dt = _turn_ahead(t, memory, x, options, told)
        pose_after(R, x, told[:3], told[3:6], dt, options[3], reach, R_now, p)
    X_RB[:, :3], X_RB[:, 3] = R_now, p


@compiled("void(f8, f8[::1], f8[:,::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[:,::1], f8[:,::1])")
def covariance_now(
    t: float,
    memory: Array,
    R: Array,
    x: Array,
    lower: Array,
    options: Array,
    noise: Array,
    rock_step: Array,
    covariance: Array,
) -> None:
    """Writes the covariance (6, 6) of the pose now; see `_pose_now` and `shell_arithmetic`."""
    P, grown, told = np.empty((SIZE, SIZE)), np.empty((SIZE, SIZE)), np.empty(13)
    R_now, x_now, u, seen = np.empty((3, 3)), np.empty(SIZE), np.empty(3), np.empty(3)
    unfold(lower, P)
    if math.isnan(memory[TIME]):
        pose_covariance(R, x, P, options[2], covariance)
        return
    dt = _turn_ahead(t, memory, x, options, told)
    predict(
        R, x[:SIZE], P, told[:3], told[3:6], dt, told[6:9], told[9:12], told[12], np.empty(0),
        noise, rock_step, R_now, x_now, grown, u, seen,
    )  # fmt: skip
    pose_covariance(R_now, x_now, grown, options[2], covariance)
