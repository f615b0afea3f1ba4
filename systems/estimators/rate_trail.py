"""A short memory of angular rates: how far did it turn between two moments of the recent past?

A picture tells of a moment some samples of the gyro ago, by a delay that is only being found out.
The trail keeps the integral of the rates at each sample, so that the turn between any two moments
is a difference. Sums of rates are rotation vectors for the few hundredths of a second between two
pictures: what the order of turns adds is less than a thousandth of them.

Kept in one array, so that it can be a system's discrete state; no Drake here.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from systems.estimators.shell_model import Turn

Array = NDArray[np.float64]

# A row: number of the sample, integrals of gyro, reference and time without a gyro, then the gyro.
_INDEX, _SUMS, _LOST, _GYRO, _REFERENCE = 0, slice(1, 8), 7, slice(8, 11), slice(11, 14)
WIDTH = 14
_RATE_WINDOW = 0.01  # s, over which a momentary rate is averaged


def rows_for(duration: float, rate: float) -> int:
    """Returns how many rows hold `duration` seconds at `rate` Hz."""
    return math.ceil(duration * rate) + 2


class RateTrail:
    """The last rates; a view on an array that belongs to the caller.

    Args:
        rows: (n, WIDTH), NaN where nothing has been written yet; changed in place.
        rate: samples a second, Hz.
        age: how old a sample is when it is added, s: the k-th tells of the time k / rate - age.
    """

    def __init__(self, rows: Array, *, rate: float, age: float) -> None:
        self._rows = rows
        self._rate = rate
        self._age = age

    def add(self, k: int, gyro: Array, reference: Array, lost: bool) -> None:
        """Adds the rates of sample k; after a gap the trail begins anew.

        Args:
            k: number of the sample.
            gyro: (3,) rad/s.
            reference: (3,) rad/s, in another frame.
            lost: whether the gyro is only a guess.
        """
        n = len(self._rows)
        before = self._rows[(k - 1) % n]
        row = self._rows[k % n]
        if before[_INDEX] == k - 1:
            rates = np.concatenate([gyro, reference, [0.0]])
            rates[:6] = (rates[:6] + before[8:14]) / 2
            rates[6] = lost
            row[_SUMS] = before[_SUMS] + rates / self._rate
        else:
            self._rows[:] = np.nan
            row[_SUMS] = 0.0
        row[_INDEX], row[_GYRO], row[_REFERENCE] = k, gyro, reference

    def newest(self) -> int:
        """Returns the number of the last sample."""
        return int(np.nanmax(self._rows[:, _INDEX]))

    def between(self, start: float, end: float, newest: int) -> Turn:
        """Returns the turn from one moment to another, which may be earlier.

        Before the memory the rate counts as zero and as lost, after it as it was last.

        Args:
            start: s.
            end: s.
            newest: number of the last sample.
        """
        a, b = self._sums(start, newest), self._sums(end, newest)
        d = b - a
        lost = max(abs(end - start) - abs(self._inside(end, newest) - self._inside(start, newest)),
                   0.0)  # fmt: skip
        return Turn(
            d[:3], d[3:6], end - start,
            self._rate_at(start, newest), self._rate_at(end, newest), abs(d[6]) + lost,
        )  # fmt: skip

    def _oldest(self, newest: int) -> int:
        n = len(self._rows)
        k = newest - n + 1
        return k if self._rows[k % n, _INDEX] == k else int(np.nanmin(self._rows[:, _INDEX]))

    def _inside(self, t: float, newest: int) -> float:
        """Returns t, or the oldest moment of the memory if that is later."""
        return max(t, self._oldest(newest) / self._rate - self._age)

    def _sums(self, t: float, newest: int) -> Array:
        n = len(self._rows)
        place = (t + self._age) * self._rate
        last = self._rows[newest % n]
        if place >= newest:
            rest = np.concatenate([last[8:14], [0.0]])
            held: Array = last[_SUMS] + rest * ((place - newest) / self._rate)
            return held
        oldest = self._oldest(newest)
        place = max(place, float(oldest))
        k = min(math.floor(place), newest - 1)
        if k < oldest:
            only: Array = last[_SUMS].copy()
            return only
        before, after = self._rows[k % n, _SUMS], self._rows[(k + 1) % n, _SUMS]
        between: Array = before + (place - k) * (after - before)
        return between

    def _rate_at(self, t: float, newest: int) -> Array:
        d = self._sums(t + _RATE_WINDOW / 2, newest) - self._sums(t - _RATE_WINDOW / 2, newest)
        rate: Array = d[:3] / _RATE_WINDOW
        return rate
