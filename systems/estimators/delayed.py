"""A filter's short memory: what comes late is put where it belongs, and the rest is done again.

A picture tells of the time at which it was taken, tens of milliseconds ago, perhaps after a newer
one has been heard of. The memory keeps, for each tick of the filter of the last moments, the state
before it, what drove the robot during it, and the measurement that arrived at it. A late one is
answered by going back to its tick and filtering forward again: the result is that of a filter that
had got everything in order, not an approximation of it (Larsen, Andersen, Ravn, Poulsen,
"Incorporation of time delayed measurements in a discrete-time Kalman filter", CDC 1998, compare
such approximations with it).

Kept in one array, so that it can be a system's discrete state; no Drake here.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled
from systems.estimators.planar_kalman import UNKNOWN
from systems.estimators.planar_model import (
    SIZE,
    VERDICTS,
    Correction,
    Drive,
    Measurement,
    correct_into,
    predict_into,
)

Array = NDArray[np.float64]

# A row of the memory.
_TICK = 0  # number of the tick, which tells a row from an older one in the same place
_SPEED, _SPEED_VARIANCE = 1, 2
_EXPECTED = 3  # yaw rate, as commanded
_YAW_RATE, _TURN_VARIANCE = 4, 5  # yaw rate as measured, NaN until it is
_STAMP, _AMBIGUOUS = 6, 7
_FIRST_POSE, _FIRST_COVARIANCE = 8, 14
_POSES, _COVARIANCES = slice(_FIRST_POSE, _FIRST_COVARIANCE), slice(_FIRST_COVARIANCE, 32)
_FIRST_X, _FIRST_P = 32, 32 + SIZE
_X, _P = slice(_FIRST_X, _FIRST_P), slice(_FIRST_P, _FIRST_P + SIZE**2)
WIDTH = 32 + SIZE + SIZE**2

_ROUNDING = 1e-6  # of a tick


def rows_for(horizon: float, rate: float) -> int:
    """Returns how many rows hold `horizon` seconds at `rate` Hz, the tick under way included."""
    return math.ceil(horizon * rate) + 2


class Memory:
    """The last ticks of a filter; a view on an array that belongs to the caller.

    Args:
        rows: (n, WIDTH), NaN where nothing has been written yet; changed in place.
        rate: ticks a second, Hz. Tick k begins at k / rate.
    """

    def __init__(self, rows: Array, rate: float) -> None:
        self._rows = rows
        self._rate = rate

    def begin(self, k: int, x: Array, P: Array, drive: Drive) -> None:
        """Opens tick k.

        Args:
            k: number of the tick.
            x: (7,) state at its beginning; counts only if there is no older tick to go back to.
            P: (7, 7).
            drive: its speed; its yaw rate is what is expected until `measure_yaw_rate`, and until
                then its turn variance counts.
        """
        _begin(self._rows, k, x, P, np.array(drive))

    def measure_yaw_rate(self, k: int, yaw_rate: float, turn_variance: float, last: int) -> int:
        """Says how fast the robot turned during tick k; NaN for as fast as was expected.

        Args:
            k: number of the tick.
            yaw_rate: rad/s.
            turn_variance: of the heading beyond the model's own, rad^2/s.
            last: the tick under way.

        Returns:
            From which tick on things have changed by that, so that all up to `last` are remembered.
            If tick k is forgotten or not connected with the last one (in the first moments, or
            after a leap in time), the first one that is.
        """
        return _measure_yaw_rate(self._rows, k, yaw_rate, turn_variance, last)

    def put(self, k: int, measurement: Measurement) -> None:
        """Keeps a measurement that arrived at tick k; one for each tick."""
        row = self._row(k)
        row[_STAMP], row[_AMBIGUOUS] = measurement.stamp, measurement.ambiguous
        row[_POSES] = row[_COVARIANCES] = np.nan
        poses, covariances = measurement.poses.ravel(), measurement.covariances.ravel()
        row[_FIRST_POSE : _FIRST_POSE + len(poses)] = poses
        row[_FIRST_COVARIANCE : _FIRST_COVARIANCE + len(covariances)] = covariances

    def tick_of(self, stamp: float) -> int:
        """Returns the tick that a time lies in; its beginning belongs to it."""
        return math.floor(stamp * self._rate + _ROUNDING)

    def reaches(self, first: int, last: int) -> bool:
        """Whether all ticks from first to last are remembered."""
        return _reaches(self._rows, first, last)

    def has_stamp(self, stamp: float) -> bool:
        """Whether a measurement of that time is remembered."""
        return bool((self._rows[:, _STAMP] == stamp).any())

    def forget(self, x: Array, P: Array) -> None:
        """Lets the filter begin anew: state x, P before each tick, and no measurement."""
        self._rows[:, _STAMP] = np.nan
        self._rows[:, _X], self._rows[:, _P] = x, P.ravel()

    def replay(
        self, first: int, last: int, noise: Array, rules: Array, look_at: float = math.nan
    ) -> Correction:
        """Filters from the beginning of one tick to the end of another.

        While the yaw rate of the last ticks has not been measured, the last one measured stands in,
        changed as the command has changed since.

        Args:
            first: where to begin; all from there on must be remembered.
            last: the tick under way.
            noise: (10,) see `planar_model.predict_into`.
            rules: (3,) see `planar_model.correct_into`.
            look_at: stamp of the measurement that the caller wants to hear of.

        Returns:
            What became of that measurement, but with state and covariance at the end of `last`; a
            verdict of "" if there is no such measurement.
        """
        x, P = np.empty(SIZE), np.empty((SIZE, SIZE))
        x_before, P_before = np.empty(SIZE), np.empty((SIZE, SIZE))
        verdict, nis = _replay(
            self._rows, self._rate, first, last, noise, rules, look_at, x, P, x_before, P_before
        )
        word = VERDICTS[verdict] if verdict >= 0 else ""
        return Correction(word, x, P, nis, x_before, P_before)

    def _row(self, k: int) -> Array:
        row: Array = self._rows[k % len(self._rows)]
        return row


@compiled("void(f8[:,::1], i8, f8[::1], f8[:,::1], f8[::1])")
def _begin(rows: Array, k: int, x: Array, P: Array, drive: Array) -> None:
    row = rows[k % len(rows)]
    row[_TICK], row[_STAMP], row[_AMBIGUOUS] = k, math.nan, 0.0
    row[_SPEED], row[_EXPECTED], row[_SPEED_VARIANCE], row[_TURN_VARIANCE] = drive[:4]
    row[_YAW_RATE] = math.nan
    row[_FIRST_X:_FIRST_P] = x
    row[_FIRST_P:] = P.ravel()


@compiled("b1(f8[:,::1], i8, i8)")
def _reaches(rows: Array, first: int, last: int) -> bool:
    if last - first >= len(rows):
        return False
    k = first
    while k <= last and rows[k % len(rows), _TICK] == k:
        k += 1
    return k > last


@compiled("i8(f8[:,::1], i8, f8, f8, i8)")
def _measure_yaw_rate(rows: Array, k: int, yaw_rate: float, turn_variance: float, last: int) -> int:
    row = rows[k % len(rows)]
    if row[_TICK] == k:
        row[_YAW_RATE] = row[_EXPECTED] if math.isnan(yaw_rate) else yaw_rate
        row[_TURN_VARIANCE] = turn_variance
    while not _reaches(rows, k, last):
        k += 1
    return k


@compiled()
def _tick_of(stamp: float, rate: float) -> int:
    return math.floor(stamp * rate + _ROUNDING)


@compiled()
def _measured_since(rows: Array, rate: float, first: int, last: int) -> NDArray[np.intp]:
    """Returns the rows of the pictures that were taken in these ticks, the oldest first."""
    found, n = np.empty(last + 1 - first, np.intp), 0
    for k in range(first, last + 1):  # none arrived before it was taken
        j = k % len(rows)
        stamp = rows[j, _STAMP]
        if math.isnan(stamp) or _tick_of(stamp, rate) < first:
            continue
        i = n
        while i > 0 and rows[found[i - 1], _STAMP] > stamp:
            found[i] = found[i - 1]
            i -= 1
        found[i] = j
        n += 1
    return found[:n]


@compiled(
    "Tuple((i8, f8))(f8[:,::1], f8, i8, i8, f8[::1], f8[::1], f8, f8[::1], f8[:,::1],"
    " f8[::1], f8[:,::1])"
)
def _replay(
    rows: Array,
    rate: float,
    first: int,
    last: int,
    noise: Array,
    rules: Array,
    look_at: float,
    x: Array,
    P: Array,
    x_before: Array,
    P_before: Array,
) -> tuple[int, float]:
    """Writes state and covariance at the end, and those before the measurement looked at."""
    size = len(rows)
    measured = _measured_since(rows, rate, first, last)
    x[:] = rows[first % size, _FIRST_X:_FIRST_P]
    P[:] = rows[first % size, _FIRST_P:].reshape(SIZE, SIZE)
    next_x, next_P, step = np.empty(SIZE), np.empty((SIZE, SIZE)), np.empty(6)
    offset, weight = 0.0, 1.0
    m, verdict, nis = 0, -1, math.nan
    for k in range(first, last + 1):
        row = rows[k % size]
        row[_FIRST_X:_FIRST_P] = x
        row[_FIRST_P:] = P.ravel()
        speed, speed_variance, expected = row[_SPEED], row[_SPEED_VARIANCE], row[_EXPECTED]
        yaw_rate, turn_variance = row[_YAW_RATE], row[_TURN_VARIANCE]
        t, end = k / rate, (k + 1) / rate
        rest = 1  # ticks in one step
        if not math.isnan(yaw_rate):
            offset = yaw_rate - expected
        else:
            if weight == 1.0:
                # The last sample's error counts for its own tick and for n more, as one: that is
                # (n + 1)^2 - 1 = n (n + 2) times the variance that its own tick has got.
                weight = last + 1 - k + 2.0
            if m == len(measured):  # the rest in one step, which none will build upon
                rest, end = last + 1 - k, (last + 1) / rate
                for j in range(k + 1, last + 1):
                    later = rows[j % size]
                    speed += later[_SPEED]
                    speed_variance += later[_SPEED_VARIANCE]
                    expected += later[_EXPECTED]
                    turn_variance += later[_TURN_VARIANCE]
            yaw_rate = expected / rest + offset
        step[0], step[1], step[2] = speed / rest, yaw_rate, speed_variance / rest
        step[3], step[4] = turn_variance / rest, weight
        while m < len(measured) and min(_tick_of(rows[measured[m], _STAMP], rate), last) == k:
            told = rows[measured[m]]
            m += 1
            stamp = told[_STAMP]
            if stamp > t:
                step[5], t = stamp - t, stamp
                if P[0, 0] < UNKNOWN:
                    predict_into(x, P, step, noise, next_x, next_P)
                    x[:], P[:] = next_x, next_P
            number = 1 if math.isnan(told[_FIRST_POSE + 3]) else 2
            poses = told[_FIRST_POSE:_FIRST_COVARIANCE].reshape(2, 3)[:number]
            covariances = told[_FIRST_COVARIANCE:_FIRST_X].reshape(2, 3, 3)[:number]
            found, distance = correct_into(
                x, P, poses, covariances, told[_AMBIGUOUS] > 0, step[0], yaw_rate, rules,
                next_x, next_P,
            )  # fmt: skip
            if stamp == look_at:
                verdict, nis = found, distance
                x_before[:], P_before[:] = x, P
            x[:], P[:] = next_x, next_P
        step[5] = end - t
        if P[0, 0] < UNKNOWN:
            predict_into(x, P, step, noise, next_x, next_P)
            x[:], P[:] = next_x, next_P
        if rest > 1:
            break
    return verdict, nis
