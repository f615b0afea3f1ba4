from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import systems.formation.dead_reckoning as module
from systems.formation.dead_reckoning import (
    DeadReckoningParameters,
    dead_reckoning_errors,
    gauss_markov,
)

Array = NDArray[np.float64]

RUNS = 20_000
SLACK = 5 * math.sqrt(2 / RUNS)  # of a variance of normal numbers
V = 0.435  # m/s
LINE = [(1.0, 2.0), (1.0, 2.0 + 30 * V)]  # 30 s, to the north
QUIET: dict[str, Any] = {"heading_deviation": 0.0, "heading_noise": 0.0, "speed_noise": 0.0}
PATH_1 = [(0.0, 0.0), *(4 * [(12.0, 0.0), (12.0, 6.0), (0.0, 6.0), (0.0, 0.0)])]
PATH_2 = [(0.0, 0.0), (5.0, 0.0), (5.0, 3.0), (0.0, 3.0), (0.0, 0.0)]


def at_the_end(path: Any, *, speed: float = V, runs: int = RUNS, **noise: Any) -> Array:
    """Returns (runs, 2) m: errors with no noise but what is named."""
    parameters = DeadReckoningParameters(**{**QUIET, **noise})
    random = np.random.default_rng(7)
    found = dead_reckoning_errors(
        path, speed=speed, runs=runs, random=random, parameters=parameters
    )
    return found.errors[:, -1]


def mean_error(path: Any, speed: float, parameters: DeadReckoningParameters | None = None) -> float:
    random = np.random.default_rng(8)
    found = dead_reckoning_errors(
        path, speed=speed, runs=4000, random=random, parameters=parameters
    )
    return float(np.linalg.norm(found.errors[:, -1], axis=1).mean())


# --- The process ---


def test_gauss_markov_is_stationary_with_its_correlation_time() -> None:
    random = np.random.default_rng(9)
    sigma, tau, step = math.radians(2.5), 120.0, 10.0
    values = gauss_markov(
        sigma * random.standard_normal(RUNS),
        random.standard_normal((24, RUNS)),
        step=step,
        time=tau,
        deviation=sigma,
    )
    assert values.shape == (25, RUNS)
    np.testing.assert_allclose((values**2).mean(axis=1), sigma**2, rtol=SLACK)
    correlation = (values[0] * values).mean(axis=1) / sigma**2
    expected = np.exp(-step * np.arange(25) / tau)  # 1/e after the correlation time
    np.testing.assert_allclose(correlation, expected, atol=5 / math.sqrt(RUNS))
    assert expected[12] == pytest.approx(1 / math.e)


def test_gauss_markov_does_not_depend_on_the_step() -> None:
    # From one and the same value: mean and variance after 60 s, in 120 steps or in one.
    random = np.random.default_rng(10)
    for steps in (1, 120):
        start = np.full(RUNS, 3.0)
        noise = random.standard_normal((steps, RUNS))
        end = gauss_markov(start, noise, step=60 / steps, time=120.0, deviation=2.0)[-1]
        variance = 4.0 * (1 - math.exp(-1))
        assert end.mean() == pytest.approx(3 * math.exp(-0.5), abs=5 * math.sqrt(variance / RUNS))
        assert end.var() == pytest.approx(variance, rel=SLACK)


def test_gauss_markov_of_tiny_steps_keeps_its_digits() -> None:
    end = gauss_markov(np.zeros(1), np.ones((1, 1)), step=1e-18, time=1.0, deviation=1.0)[-1]
    assert end[0] == pytest.approx(math.sqrt(2e-18))


# --- One noise at a time, along a straight line: across it is -x, along it y ---


def test_no_noise_no_error() -> None:
    np.testing.assert_allclose(at_the_end(PATH_1, runs=2), 0.0, atol=1e-12)


def test_white_speed() -> None:
    for period in (0.1, 0.5):
        across, along = at_the_end(LINE, speed_noise=0.045, period=period).T
        assert along.var() == pytest.approx(0.045**2 * 30 * period, rel=SLACK)
        np.testing.assert_allclose(across, 0.0, atol=1e-12)


def test_white_speed_with_a_last_sample_cut_short() -> None:
    path = [(0.0, 0.0), (10.25 * V, 0.0)]  # 20 samples of 0.5 s, and one of 0.25 s
    along = at_the_end(path, speed_noise=0.045)[:, 0]
    assert along.var() == pytest.approx(0.045**2 * (20 * 0.5**2 + 0.25**2), rel=SLACK)


def test_white_heading() -> None:
    sigma = math.radians(0.8)
    across, along = at_the_end(LINE, heading_noise=sigma).T
    assert across.var() == pytest.approx((V * sigma) ** 2 * 30 * 0.5, rel=SLACK)
    assert along.mean() == pytest.approx(-30 * V * sigma**2 / 2, rel=0.05)  # E cos = 1 - var / 2


def test_gauss_markov_heading() -> None:
    # Integrated twice over its exponential covariance.
    sigma, tau, t = math.radians(2.5), 120.0, 30.0
    across = at_the_end(LINE, heading_deviation=sigma, period=0.1)[:, 0]
    variance = 2 * (V * sigma * tau) ** 2 * (t / tau - 1 + math.exp(-t / tau))
    assert across.var() == pytest.approx(variance, rel=SLACK)
    # White noise of that size would be far smaller: the correlation is what counts.
    assert across.var() > 100 * (V * sigma) ** 2 * t * 0.1


def test_scale() -> None:
    ends = at_the_end(LINE, runs=2, speed_scale=0.02)
    np.testing.assert_allclose(ends, [[0.0, 0.02 * 30 * V]] * 2, atol=1e-12)


def test_gyro_bias() -> None:
    bias = math.radians(0.05)
    across = at_the_end(LINE, gyro_bias=bias)[:, 0]
    assert across.std() == pytest.approx(V * bias * 30**2 / 2, rel=SLACK)
    # A left turn of the believed heading ends left: to the west of a way north.
    random = np.random.default_rng(7)
    random.standard_normal(RUNS)
    assert (np.sign(across) == -np.sign(random.standard_normal(RUNS))).all()


def test_only_the_gyro_bias_doubles_at_half_the_speed() -> None:
    sigma, bias = math.radians(2.5), math.radians(0.01)
    noises: dict[str, dict[str, Any]] = {
        "slow heading": {"heading_deviation": sigma},
        "white": {"speed_noise": 0.045},
        "bias": {"gyro_bias": bias},
    }
    ratio = {
        name: np.linalg.norm(at_the_end(LINE, speed=V / 2, **noise), axis=1).mean()
        / np.linalg.norm(at_the_end(LINE, **noise), axis=1).mean()
        for name, noise in noises.items()
    }
    assert ratio["slow heading"] == pytest.approx(1.0, abs=0.1)
    assert ratio["white"] == pytest.approx(math.sqrt(2), rel=0.03)
    assert ratio["bias"] == pytest.approx(2.0, rel=0.001)


# --- The paper's table ---


@pytest.mark.parametrize(("path", "paper"), [(PATH_1, 0.81), (PATH_2, 0.20)])
def test_the_row_that_fits(path: Any, paper: float) -> None:
    assert mean_error(path, V) == pytest.approx(paper, rel=0.15)


@pytest.mark.parametrize("path", [PATH_1, PATH_2])
def test_the_row_that_does_not(path: Any) -> None:
    # The paper has 1.77 and 2.1 times the error at half the speed.
    assert 1.0 < mean_error(path, V / 2) / mean_error(path, V) < math.sqrt(2) + 0.02


def test_the_gyro_bias_that_fits_the_first_path_only() -> None:
    biased = DeadReckoningParameters(gyro_bias=math.radians(0.012))
    assert mean_error(PATH_1, V, biased) == pytest.approx(0.81, rel=0.15)
    assert mean_error(PATH_1, V / 2, biased) == pytest.approx(1.43, rel=0.15)
    assert mean_error(PATH_2, V / 2, biased) < 0.85 * 0.42


# --- Instants, seeds, refusals ---


def test_instants() -> None:
    def found(instants: int) -> module.ErrorsOverTime:
        return dead_reckoning_errors(
            PATH_2, speed=V, runs=3, random=np.random.default_rng(11), instants=instants
        )

    few, many = found(1), found(10)
    duration = 16 / V
    np.testing.assert_allclose(few.times, [duration])
    assert many.errors.shape == (3, 10, 2)
    np.testing.assert_allclose(many.times, duration * np.arange(1, 11) / 10, atol=0.5)
    assert many.times[-1] == pytest.approx(duration)
    np.testing.assert_array_equal(few.errors[:, -1], many.errors[:, -1])
    every = found(10_000)  # no more than there are samples
    np.testing.assert_allclose(every.times[:-1], 0.5 * np.arange(1, len(every.times)))
    assert 0 < every.times[-1] - every.times[-2] <= 0.5
    kept = np.isin(every.times, many.times)
    np.testing.assert_array_equal(every.errors[:, kept], many.errors)


@pytest.mark.parametrize(("duration", "samples"), [(2.0, 4), (2.1, 5), (0.3, 1)])
def test_samples(duration: float, samples: int) -> None:
    path = [(0.0, 0.0), (V * duration, 0.0)]
    random = np.random.default_rng(13)
    found = dead_reckoning_errors(path, speed=V, runs=1, random=random, instants=100)
    assert len(found.times) == samples
    assert found.times[-1] == pytest.approx(duration)


def test_in_blocks_as_in_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def found() -> Array:
        random = np.random.default_rng(12)
        return dead_reckoning_errors(PATH_2, speed=V, runs=7, random=random, instants=9).errors

    whole = found()
    monkeypatch.setattr(module, "_NUMBERS", 7 * 4)
    np.testing.assert_allclose(found(), whole, atol=1e-12)


def test_seeds() -> None:
    def found(seed: int) -> Array:
        random = np.random.default_rng(seed)
        return dead_reckoning_errors(PATH_2, speed=V, runs=5, random=random).errors

    np.testing.assert_array_equal(found(1), found(1))
    assert (found(1) != found(2)).all()


@pytest.mark.parametrize(
    ("parameters", "line"),
    [
        ({"heading_time": 0.0}, "heading_time is 0.0: must be greater than 0"),
        ({"period": math.nan}, "period is nan: must be greater than 0"),
        ({"speed_noise": -1.0}, "speed_noise is -1.0: must be 0 or greater"),
        ({"speed_scale": -1.0}, "speed_scale is -1.0: must be greater than -1"),
    ],
)
def test_parameters_refused(parameters: dict[str, float], line: str) -> None:
    with pytest.raises(ValueError, match=line):
        DeadReckoningParameters(**parameters)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({"path": [(1.0, 1.0)]}, r"path is \[\(1.0, 1.0\)\]: must be longer than 0 m"),
        ({"path": [1.0, 2.0]}, "path is"),
        ({"speed": 0.0}, "speed is 0.0: must be greater than 0"),
        ({"runs": 0}, "runs is 0: must be 1 or more"),
        ({"instants": 0}, "instants is 0: must be 1 or more"),
    ],
)
def test_refused(arguments: dict[str, Any], line: str) -> None:
    given = {"path": PATH_2, "speed": V, "runs": 1, **arguments}
    with pytest.raises(ValueError, match=line):
        dead_reckoning_errors(given.pop("path"), random=np.random.default_rng(), **given)
