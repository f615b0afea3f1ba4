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
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from systems.estimators.planar_model import SIZE, Correction, Drive, Measurement

Array = NDArray[np.float64]
Predict = Callable[[Array, Array, Drive, float], tuple[Array, Array]]
Correct = Callable[[Array, Array, Measurement, Drive], Correction]

# A row of the memory.
_TICK = 0  # number of the tick, which tells a row from an older one in the same place
_SPEED, _SPEED_VARIANCE = 1, 2
_EXPECTED = 3  # yaw rate, as commanded
_YAW_RATE, _TURN_VARIANCE = 4, 5  # yaw rate as measured, NaN until it is
_STAMP, _AMBIGUOUS = 6, 7
_POSES = slice(8, 14)
_COVARIANCES = slice(14, 32)
_X = slice(32, 32 + SIZE)
_P = slice(32 + SIZE, 32 + SIZE + SIZE**2)
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
            x: (6,) state at its beginning; counts only if there is no older tick to go back to.
            P: (6, 6).
            drive: its speed; its yaw rate is what is expected until `measure_yaw_rate`, and until
                then its turn variance counts.
        """
        row = self._row(k)
        row[:_POSES.start] = (
            k, drive.speed, drive.speed_variance, drive.yaw_rate, np.nan, drive.turn_variance,
            np.nan, 0.0,
        )  # fmt: skip
        row[_X] = x
        row[_P] = P.ravel()

    def measure_yaw_rate(self, k: int, yaw_rate: float, turn_variance: float) -> bool:
        """Says how fast the robot turned during tick k; NaN for as fast as was expected.

        Args:
            k: number of the tick.
            yaw_rate: rad/s.
            turn_variance: of the heading beyond the model's own, rad^2/s.

        Returns:
            Whether that tick is remembered.
        """
        row = self._row(k)
        if row[_TICK] != k:
            return False
        row[_YAW_RATE] = row[_EXPECTED] if math.isnan(yaw_rate) else yaw_rate
        row[_TURN_VARIANCE] = turn_variance
        return True

    def put(self, k: int, measurement: Measurement) -> None:
        """Keeps a measurement that arrived at tick k; one for each tick."""
        row = self._row(k)
        row[_STAMP], row[_AMBIGUOUS] = measurement.stamp, measurement.ambiguous
        row[_POSES] = row[_COVARIANCES] = np.nan
        poses, covariances = measurement.poses.ravel(), measurement.covariances.ravel()
        row[_POSES.start : _POSES.start + len(poses)] = poses
        row[_COVARIANCES.start : _COVARIANCES.start + len(covariances)] = covariances

    def tick_of(self, stamp: float) -> int:
        """Returns the tick that a time lies in; its beginning belongs to it."""
        return math.floor(stamp * self._rate + _ROUNDING)

    def reaches(self, first: int, last: int) -> bool:
        """Whether all ticks from first to last are remembered."""
        n = len(self._rows)
        return last - first < n and all(
            self._rows[j % n, _TICK] == j for j in range(first, last + 1)
        )

    def has_stamp(self, stamp: float) -> bool:
        """Whether a measurement of that time is remembered."""
        return bool((self._rows[:, _STAMP] == stamp).any())

    def forget(self, x: Array, P: Array) -> None:
        """Lets the filter begin anew: state x, P before each tick, and no measurement."""
        self._rows[:, _STAMP] = np.nan
        self._rows[:, _X], self._rows[:, _P] = x, P.ravel()

    def replay(
        self, first: int, last: int, predict: Predict, correct: Correct, look_at: float = math.nan
    ) -> tuple[Array, Array, Correction | None]:
        """Filters from the beginning of one tick to the end of another.

        While the yaw rate of the last ticks has not been measured, the last one measured stands in,
        changed as the command has changed since.

        Args:
            first: where to begin; all from there on must be remembered.
            last: the tick under way.
            predict: (x, P, drive, dt) to (x, P).
            correct: (x, P, measurement, drive) to what became of it.
            look_at: stamp of the measurement that the caller wants to hear of.

        Returns:
            State and covariance at the end of `last`, and what became of that measurement.
        """
        measurements = self._measurements(first, last)
        row = self._row(first)
        x, P = row[_X].copy(), row[_P].reshape(SIZE, SIZE).copy()
        offset, weight = 0.0, 1.0
        looked_at = None
        for k in range(first, last + 1):
            row = self._row(k)
            if k > first:
                row[_X], row[_P] = x, P.ravel()
            speed, speed_variance, expected, yaw_rate, turn_variance = row[_SPEED:_STAMP].tolist()
            t, end = k / self._rate, (k + 1) / self._rate
            if not math.isnan(yaw_rate):
                offset = yaw_rate - expected
            else:
                yaw_rate = expected + offset
                if weight == 1.0:
                    # The last sample's error counts for its own tick and for n more, as one: that
                    # is (n + 1)^2 - 1 = n (n + 2) times the variance that its own tick has got.
                    weight = last + 1 - k + 2.0
                if not measurements:  # the rest in one step, which none will build upon
                    drive = self._mean_drive(k, last, offset, weight)
                    x, P = predict(x, P, drive, (last + 1) / self._rate - t)
                    break
            drive = Drive(speed, yaw_rate, speed_variance, turn_variance, weight)
            while measurements and min(self.tick_of(measurements[-1].stamp), last) == k:
                measurement = measurements.pop()
                if measurement.stamp > t:
                    x, P = predict(x, P, drive, measurement.stamp - t)
                    t = measurement.stamp
                correction = correct(x, P, measurement, drive)
                x, P = correction.x, correction.P
                if measurement.stamp == look_at:
                    looked_at = correction
            x, P = predict(x, P, drive, end - t)
        return x, P, looked_at

    def _row(self, k: int) -> Array:
        row: Array = self._rows[k % len(self._rows)]
        return row

    def _mean_drive(self, first: int, last: int, offset: float, weight: float) -> Drive:
        rows = [self._row(k)[_SPEED:_STAMP].tolist() for k in range(first, last + 1)]
        speed, variance, expected, _, turn_variance = (
            sum(column) / len(rows) for column in zip(*rows, strict=True)
        )
        return Drive(speed, expected + offset, variance, turn_variance, weight)

    def _measurements(self, first: int, last: int) -> list[Measurement]:
        """Returns those of pictures taken in these ticks, the newest first."""
        found = []
        for k in range(first, last + 1):  # none arrived before it was taken
            row = self._row(k)
            stamp = float(row[_STAMP])
            if math.isnan(stamp) or self.tick_of(stamp) < first:
                continue
            poses, covariances = row[_POSES].reshape(2, 3), row[_COVARIANCES].reshape(2, 3, 3)
            number = 1 if math.isnan(poses[1, 0]) else 2
            found.append(
                Measurement(
                    stamp, poses[:number].copy(), covariances[:number].copy(),
                    bool(row[_AMBIGUOUS]),
                )
            )  # fmt: skip
        return sorted(found, key=lambda measurement: -measurement.stamp)
