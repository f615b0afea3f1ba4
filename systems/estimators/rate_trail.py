"""A short memory of angular rates: how far did it turn between two moments of the recent past?

A picture tells of a moment some samples of the gyro ago, by a delay that is only being found out.
The trail keeps the integral of the rates at each sample, so that the turn between any two moments
is a difference. Sums of rates are rotation vectors for the few hundredths of a second between two
pictures: what the order of turns adds is less than a thousandth of them.

Kept in one array, so that it can be a system's discrete state; no Drake here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled, packed
from systems.estimators.shell_model import Turn

Array = NDArray[np.float64]

# A row: number of the sample; integrals of gyro, reference and time without a gyro; the two rates.
_INDEX = 0
WIDTH = 14
_UNKNOWN = -1  # for the number of the last sample
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

    def add(self, k: int, gyro: Sequence[float], reference: Sequence[float], lost: bool) -> None:
        """Adds the rates of sample k; after a gap the trail begins anew.

        Args:
            k: number of the sample.
            gyro: 3 numbers, rad/s.
            reference: 3 numbers, rad/s, in another frame.
            lost: whether the gyro is only a guess.
        """
        add_row(self._rows, k, np.array(gyro, float), np.array(reference, float), lost, self._rate)

    def newest(self) -> int:
        """Returns the number of the last sample."""
        return int(np.fmax.reduce(self._rows[:, _INDEX]))

    def between(self, start: float, end: float, newest: int | None = None) -> Turn:
        """Returns the turn from one moment to another, which may be earlier.

        Before the memory the rate counts as zero and as lost, after it as it was last.

        Args:
            start: s.
            end: s.
            newest: number of the last sample, if it is known.
        """
        told = np.empty(13)
        turn_between(
            packed(self._rows),
            start,
            end,
            self._age,
            self._rate,
            _UNKNOWN if newest is None else newest,
            told,
        )
        return Turn(told[:3], told[3:6], end - start, told[6:9], told[9:12], float(told[12]))


@compiled("void(f8[:,::1], i8, f8[::1], f8[::1], b1, f8)")
def add_row(rows: Array, k: int, gyro: Array, reference: Array, lost: bool, rate: float) -> None:
    """Adds the rates of sample k to a trail, see `RateTrail.add`; for compiled code too."""
    n = len(rows)
    before, row = rows[(k - 1) % n], rows[k % n]
    follows = before[0] == k - 1
    if not follows:
        rows[:] = np.nan
    for i in range(7):
        step = lost / rate
        if i < 6:
            now = gyro[i] if i < 3 else reference[i - 3]
            step = (now + before[8 + i]) * 0.5 / rate
            row[8 + i] = now
        row[1 + i] = before[1 + i] + step if follows else 0.0
    row[0] = k


@compiled("void(f8[:,::1], f8, f8, f8, f8, i8, f8[::1])")
def turn_between(
    rows: Array, start: float, end: float, age: float, rate: float, newest: int, told: Array
) -> None:
    """Writes the integrals (6,), the rates at both ends (3,) and the time without a gyro."""
    n = len(rows)
    if newest == _UNKNOWN:
        for k in range(n):
            if rows[k, 0] > newest:
                newest = int(rows[k, 0])
    oldest = newest - n + 1
    if rows[oldest % n, 0] != oldest:  # not full yet
        oldest = newest
        for k in range(n):
            if rows[k, 0] < oldest:
                oldest = int(rows[k, 0])
    sums = np.empty((6, 7))
    _sums(rows, start, end, age, rate, oldest, newest, sums)
    for i in range(6):
        told[i] = sums[3, i] - sums[0, i]
    for i in range(3):
        told[6 + i] = (sums[2, i] - sums[1, i]) / _RATE_WINDOW
        told[9 + i] = (sums[5, i] - sums[4, i]) / _RATE_WINDOW
    begin = oldest / rate - age
    known = abs(max(end, begin) - max(start, begin))
    told[12] = abs(sums[3, 6] - sums[0, 6]) + max(abs(end - start) - known, 0.0)


@compiled()
def _sums(
    rows: Array,
    start: float,
    end: float,
    age: float,
    rate: float,
    oldest: int,
    newest: int,
    sums: Array,
) -> None:
    """Writes the integrals (7,) up to six moments; before the memory its first.

    The moments are the start and half a window before and after it, then the same about the end.
    """
    n = len(rows)
    for m in range(6):
        moment = start if m < 3 else end
        if m % 3:
            moment += _RATE_WINDOW / 2 if m % 3 == 2 else -_RATE_WINDOW / 2
        place = (moment + age) * rate
        within = min(max(place, float(oldest)), float(newest))
        k = int(within)
        before, after = k % n, min(k + 1, newest) % n
        part = within - k
        beyond = max(place - newest, 0.0) / rate
        for i in range(7):
            a, b = rows[before, 1 + i], rows[after, 1 + i]
            sums[m, i] = a + part * (b - a)
            if i < 6:
                sums[m, i] += beyond * rows[newest % n, 8 + i]
