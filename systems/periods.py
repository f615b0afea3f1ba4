"""Periods whose common multiples are the same instants.

1 / 60 and 1 / 300 are rounded, so that the 60th multiple of the one and the 300th of the other need
not be equal. The simulator then makes two steps of one, and whether a camera sees the plant before
or after its step is a matter of rounding. A diagram all of whose blocks are made within `aligned`
has not got this.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from fractions import Fraction

_FINEST = 9000  # Hz; of it all usual rates are parts

# 1 / 9000 s with so few digits that its multiples up to seconds are exact. It is rounded up:
# nothing that is due at an instant comes before it.
_TICK = float(Fraction(math.ceil(Fraction(2**53, _FINEST)), 2**53))

_aligned: ContextVar[bool] = ContextVar("aligned", default=False)


@contextmanager
def aligned(wanted: bool = True) -> Iterator[None]:
    """Lets blocks that are made within have periods that fall together, if wanted; see `align`.

    For a diagram whose other periods are aligned too, such as the plant's step and the logs': a
    block of Drake's own, made with 0.01 s, would be a rounding error off.
    """
    token = _aligned.set(wanted)
    try:
        yield
    finally:
        _aligned.reset(token)


def align(seconds: float) -> float:
    """Returns a period (s) itself; within `aligned`, the one next to it that falls together.

    That is so of periods that are multiples of 1 / 9000 s, such as 1 / 300, 2 / 300 and 1 / 60 s.
    They then are longer by a part in 10^12, half a nanosecond after a quarter of an hour.
    """
    ticks = seconds * _FINEST
    if _aligned.get() and abs(ticks - round(ticks)) < 1e-9 * ticks:
        return round(ticks) * _TICK
    return seconds


def period(rate: float) -> float:
    """Returns the time (s) between samples at a rate (Hz), for Drake's periodic events."""
    return align(1.0 / rate)
