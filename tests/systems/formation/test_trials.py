from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from systems.formation.building import Algorithm1Parameters
from systems.formation.trials import (
    Algorithm1Trials,
    TrialParameters,
    beacons_of,
    build_by_algorithm1,
    build_by_resection,
)
from systems.formation.triangles import next_vertex, side_ratios

FLAWLESS: dict[str, Any] = {
    "latency": 0.0,
    "pixel_noise": 0.0,
    "centre_bias": 0.0,
    "along_std": 0.0,
    "lateral_std": 0.0,
    "heading_std": 0.0,
    "wheel_scale_std": 0.0,
}


def random(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_the_triangle_is_equilateral_and_its_vertex_straight_ahead_of_the_anchor() -> None:
    beacons = beacons_of(2.0)
    np.testing.assert_allclose(side_ratios(beacons, 2.0), 1.0)
    np.testing.assert_allclose(next_vertex(beacons), [2.0 * math.sqrt(3), 0.0], atol=1e-12)


def test_the_numbers_of_the_paper() -> None:
    lateral, longitudinal = np.abs(Algorithm1Trials().draw(random(1), (100,))).mean(axis=0)
    assert 0.025 <= lateral <= 0.040
    assert 0.008 <= longitudinal <= 0.018


def test_a_seed_repeats_and_another_differs() -> None:
    first, again, other = (Algorithm1Trials().draw(random(s), (3, 2)) for s in (4, 4, 5))
    assert first.shape == (3, 2, 2)
    np.testing.assert_array_equal(first, again)
    assert not (first == other).any()
    # Trials of one draw are different ones, and so are those of a second draw.
    assert len(np.unique(first)) == first.size
    generator = random(4)
    Algorithm1Trials().draw(generator, (3, 2))
    assert not (Algorithm1Trials().draw(generator, (3, 2)) == first).any()


def test_lateral_comes_first() -> None:
    outcome = build_by_algorithm1(6, 7)
    drawn = Algorithm1Trials().draw(random(7), (6,))
    np.testing.assert_array_equal(drawn, np.stack([outcome.aside, outcome.along], axis=1))


def test_a_flawless_robot_stops_inside_the_tolerance() -> None:
    algorithm = Algorithm1Parameters(mean_tolerance=2.0)
    drawn = Algorithm1Trials(TrialParameters(**FLAWLESS), algorithm=algorithm).draw(random(), (2,))
    np.testing.assert_allclose(drawn[:, 0], 0.0, atol=1e-9)
    # It shows at f tan(30 deg) = 280.01 px there; 2 px are 2 f / (beacons' distance squared ...):
    # u = f (s / 2) / (x - s sqrt(3) / 2), so du/dx = -u / (s sqrt(3) / 2).
    assert np.abs(drawn[:, 1]).max() <= 2.05 / 280 * 1.5 * math.sqrt(3) / 2
    np.testing.assert_array_equal(drawn[0], drawn[1])


def test_latency_carries_it_on() -> None:
    late = TrialParameters(**{**FLAWLESS, "latency": 0.5})
    prompt = TrialParameters(**FLAWLESS)
    on_time, too_late = (Algorithm1Trials(p).draw(random(), (1,))[0, 1] for p in (prompt, late))
    # 0.5 s at 0.1 m/s, to within the 5 mm that it drives from picture to picture.
    assert abs(too_late - on_time) == pytest.approx(0.05, abs=0.0051)


def test_twice_the_side_at_twice_the_speed_is_twice_the_error() -> None:
    def drawn(scale: float) -> np.ndarray:
        parameters = TrialParameters(
            side=1.5 * scale, along_std=0.05 * scale, lateral_std=0.022 * scale
        )
        algorithm = Algorithm1Parameters(speed=0.1 * scale)
        return Algorithm1Trials(parameters, algorithm=algorithm).draw(random(3), (5,))

    np.testing.assert_allclose(drawn(2.0), 2 * drawn(1.0), rtol=1e-6)


def test_what_never_ends_is_no_number() -> None:
    drawn = Algorithm1Trials(TrialParameters(limit=1.0)).draw(random(), (2, 3))
    assert drawn.shape == (2, 3, 2)
    assert np.isnan(drawn).all()
    some = Algorithm1Trials(TrialParameters(limit=14.0)).draw(random(), (60,))
    lost = np.isnan(some)
    assert (lost[:, 0] == lost[:, 1]).all()
    assert 0 < lost[:, 0].sum() < 60


def test_resection_is_better_in_the_same_worlds() -> None:
    parameters = TrialParameters(centre_bias=0.0)
    ours, theirs = build_by_resection(20, 2, parameters), build_by_algorithm1(20, 2, parameters)
    assert np.isfinite(ours.seconds).all()
    assert np.abs(ours.aside).mean() < np.abs(theirs.aside).mean() / 5
    assert np.abs(ours.along).mean() < np.abs(theirs.along).mean() / 3


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("side", 0.0),
        ("period", -0.05),
        ("focal_length", math.nan),
        ("pixel_noise", -1.0),
        ("latency", math.inf),
        ("centre_bias", math.nan),
        ("limit", 0.01),
    ],
)
def test_nonsense_is_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{field} is {value}: must be"):
        TrialParameters(**{field: value})


def test_a_picture_too_narrow_is_refused() -> None:
    with pytest.raises(ValueError, match=r"dt is 280\.0: must be less than half_width = 250 px"):
        Algorithm1Trials(TrialParameters(half_width=250.0))
