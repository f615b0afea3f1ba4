from __future__ import annotations

import math

import numpy as np
import pytest

from systems.estimators.rate_trail import WIDTH, RateTrail, rows_for

RATE = 300.0


def trail_of(duration: float, age: float = 0.0) -> RateTrail:
    rows = np.full((rows_for(duration, RATE), WIDTH), np.nan)
    return RateTrail(rows, rate=RATE, age=age)


def test_the_trail_gives_the_integral_between_any_two_moments() -> None:
    trail = trail_of(0.5, age=1 / 300)

    def rate(t: float) -> np.ndarray:
        return np.array([math.sin(3 * t), 1.0, t])

    def integral(t: float) -> np.ndarray:
        return np.array([-math.cos(3 * t) / 3, t, t * t / 2])

    for k in range(400):
        trail.add(k, rate((k - 1) / 300).tolist(), [0.0, 0.0, 2.0], lost=200 <= k < 230)
    for start, end in ((1.0, 1.05), (1.2345, 1.0123), (1.31, 1.3266)):
        turn = trail.between(start, end, 399)
        np.testing.assert_allclose(turn.gyro, integral(end) - integral(start), atol=2e-5)
        np.testing.assert_allclose(turn.reference, [0, 0, 2 * (end - start)], atol=1e-12)
        assert turn.lost == 0.0
        np.testing.assert_allclose(turn.rate_before, rate(start), atol=1e-2)
    ahead = trail.between(1.3, 1.36, 399)  # beyond the last sample, of 398 / 300 s
    np.testing.assert_allclose(ahead.gyro, integral(1.36) - integral(1.3), atol=5e-3)
    assert trail.newest() == 399
    assert trail.between(0.2, 0.9, 399).lost == pytest.approx(0.9 - 0.2, abs=0.15)


def test_between_samples_rates_change_evenly_and_beyond_the_last_they_stay() -> None:
    # An independent account of the same: the sums at the samples, and what lies between them.
    rng = np.random.default_rng(0)
    rates = rng.normal(0, 1, (200, 6))
    trail = trail_of(0.3, age=0.002)
    for k, (gyro, reference) in enumerate(rates.reshape(-1, 2, 3)):
        trail.add(k, gyro.tolist(), reference.tolist(), lost=k % 7 == 0)
    times = np.arange(200) / RATE - 0.002
    steps = (rates[1:] + rates[:-1]) / 2 / RATE
    sums = np.vstack([np.zeros(6), np.cumsum(steps, axis=0)])

    def integral(t: float) -> np.ndarray:
        inside = np.array([np.interp(t, times, column) for column in sums.T])
        return inside + max(t - times[-1], 0.0) * rates[-1]

    for start, end in rng.uniform(0.42, 0.7, (50, 2)):
        turn = trail.between(start, end, 199)
        np.testing.assert_allclose(
            np.r_[turn.gyro, turn.reference], integral(end) - integral(start), atol=1e-12
        )
        assert turn.dt == end - start
        for told, t in ((turn.rate_before, start), (turn.rate_after, end)):
            mean = (integral(t + 0.005) - integral(t - 0.005))[:3] / 0.01
            np.testing.assert_allclose(told, mean, atol=1e-10)


def test_before_its_memory_nothing_is_known() -> None:
    trail = trail_of(0.1)  # 32 rows
    for k in range(100):
        trail.add(k, [1.0, 0.0, 0.0], [0.0, 0.0, 0.0], lost=False)
    oldest = (99 - 31) / RATE
    turn = trail.between(oldest - 0.2, oldest + 0.03, 99)
    assert turn.gyro[0] == pytest.approx(0.03)
    assert turn.lost == pytest.approx(0.2)
    wholly = trail.between(oldest - 0.2, oldest - 0.1, 99)
    assert (wholly.gyro == 0).all()
    assert wholly.lost == pytest.approx(0.1)


def test_after_a_gap_it_begins_anew() -> None:
    trail = trail_of(0.1)
    for k in (0, 1, 2, 5):
        trail.add(k, [float(k), 0.0, 0.0], [0.0, 0.0, 0.0], lost=False)
    assert trail.newest() == 5
    turn = trail.between(0.0, 6 / RATE, 5)
    assert turn.gyro[0] == pytest.approx(5 / RATE)  # as it was last, and of before nothing
    assert turn.lost == pytest.approx(5 / RATE)
    trail.add(6, [7.0, 0.0, 0.0], [0.0, 0.0, 0.0], lost=True)
    turn = trail.between(5 / RATE, 6 / RATE, 6)
    assert turn.gyro[0] == pytest.approx(6 / RATE)
    assert turn.lost == pytest.approx(1 / RATE)
