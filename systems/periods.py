"""Periods whose common multiples are the same instants.

1 / 60 and 1 / 300 are rounded, so that the 60th multiple of the one and the 300th of the other need
not be equal. The simulator then makes two steps of one, and whether a camera sees the plant before
or after its step is a matter of rounding.
"""

from __future__ import annotations

import math
from fractions import Fraction

_FINEST = 9000  # Hz; of it all usual rates are parts

# 1 / 9000 s with so few digits that its multiples up to seconds are exact. It is rounded up:
# nothing that is due at an instant comes before it.
_TICK = float(Fraction(math.ceil(Fraction(2**53, _FINEST)), 2**53))


def period(rate: float) -> float:
    """Returns the time (s) between samples at a rate (Hz), for Drake's periodic events.

    Of rates that 9000 Hz is a multiple of (1, 5, 10, 15, 20, 25, 30, 50, 60, 100, 200, 250, 300,
    500, 1000, ...), the samples that fall together do so exactly. It is 1 / rate but for a part in
    10^12, half a nanosecond after a quarter of an hour; of other rates it is 1 / rate.
    """
    ticks = _FINEST / rate
    return round(ticks) * _TICK if abs(ticks - round(ticks)) < 1e-9 * ticks else 1.0 / rate
