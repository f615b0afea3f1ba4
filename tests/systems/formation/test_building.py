import math
from dataclasses import replace

import numpy as np
import pytest

from systems.formation.bearing_filter import BearingFilterParameters
from systems.formation.bearings import lateral_pixels
from systems.formation.building import (
    BACK,
    FORWARD,
    HOLD,
    Algorithm1Parameters,
    Motion,
    SettlingParameters,
    algorithm1,
    settle,
)
from systems.formation.trials import (
    TrialParameters,
    beacons_of,
    build_by_algorithm1,
    build_by_resection,
)
from systems.formation.triangles import next_vertex

FOCAL = 485.0
BEACONS = beacons_of(1.5)
ANCHOR, VERTEX = BEACONS[2], next_vertex(BEACONS)
BIASED = TrialParameters()
CALIBRATED = replace(BIASED, centre_bias=0.0)
PLAIN, OURS = Algorithm1Parameters(), SettlingParameters()


def pixels(along: float, aside: float, turned: float = 0.0) -> np.ndarray:
    """What shows from a place near the vertex, turned away from the anchor's centring."""
    turned += math.atan2(aside, VERTEX[0] + along)
    return lateral_pixels(np.array([*(VERTEX + np.array([along, aside])), turned]), BEACONS, FOCAL)[
        0
    ]


def test_at_the_vertex_it_is_done() -> None:
    motion = algorithm1(pixels(0, 0), FORWARD, FOCAL, PLAIN)
    assert motion.done
    assert motion.command.tolist() == [0.0, 0.0]
    # 215 px/m along: 7 px are 33 mm; 249 px/m aside: 24 px are 96 mm.
    assert algorithm1(pixels(0.030, 0), FORWARD, FOCAL, PLAIN).done
    assert not algorithm1(pixels(0.040, 0), FORWARD, FOCAL, PLAIN).done
    assert algorithm1(pixels(0, 0.090), FORWARD, FOCAL, PLAIN).done
    assert not algorithm1(pixels(0, 0.105), FORWARD, FOCAL, PLAIN).done


def test_while_both_exceed_dt_it_goes_on_otherwise_back() -> None:
    as_printed = Algorithm1Parameters(beyond=0.0, short=0.0)
    assert algorithm1(pixels(-0.1, 0), FORWARD, FOCAL, as_printed).command[0] > 0
    assert algorithm1(pixels(0.1, 0), FORWARD, FOCAL, as_printed).command[0] < 0
    # The shunt: forward until well beyond, back until well short.
    assert algorithm1(pixels(0.08, 0), FORWARD, FOCAL, PLAIN).direction == FORWARD
    assert algorithm1(pixels(0.14, 0), FORWARD, FOCAL, PLAIN).direction == BACK
    assert algorithm1(pixels(0.08, 0), BACK, FOCAL, PLAIN).direction == BACK
    assert algorithm1(pixels(-0.09, 0), BACK, FOCAL, PLAIN).direction == FORWARD


@pytest.mark.parametrize("turned", [0.1, -0.1])
@pytest.mark.parametrize("direction", [FORWARD, BACK])
def test_the_anchor_is_kept_in_the_middle(turned: float, direction: float) -> None:
    omega = algorithm1(pixels(0.1, 0, turned), direction, FOCAL, PLAIN).command[1]
    assert omega * turned < 0


@pytest.mark.parametrize("aside", [0.12, -0.12])
@pytest.mark.parametrize("direction", [FORWARD, BACK])
def test_it_steers_to_the_axis_driving_either_way(aside: float, direction: float) -> None:
    u = pixels(0.08, aside)
    assert u[2] == pytest.approx(0, abs=1e-9)
    v, omega = algorithm1(u, direction, FOCAL, PLAIN).command
    assert v * omega * aside < 0


def test_which_beacon_stands_on_which_side_does_not_matter() -> None:
    u = pixels(0.05, 0.12, 0.02)
    other = algorithm1(u[[1, 0, 2]], FORWARD, FOCAL, PLAIN)
    assert other.command == pytest.approx(algorithm1(u, FORWARD, FOCAL, PLAIN).command)


def test_without_side_beacons_it_goes_on_and_without_the_anchor_it_stands() -> None:
    u = pixels(-0.3, 0)
    u[:2] = np.nan
    assert algorithm1(u, BACK, FOCAL, PLAIN).command[0] > 0
    u = pixels(-0.3, 0)
    u[2] = np.nan
    motion = algorithm1(u, FORWARD, FOCAL, PLAIN)
    assert motion.command.tolist() == [0.0, 0.0]
    assert not motion.done


def test_settling_is_forward_back_hold_done() -> None:
    def at(along: float, direction: float, held: float = 0.0, aside: float = 0.0) -> Motion:
        pose = np.array([*(VERTEX + np.array([along, aside])), 0.0])
        return settle(pose, VERTEX, ANCHOR, direction, held, OURS)

    assert at(0.1, FORWARD).direction == FORWARD
    assert at(0.21, FORWARD).direction == BACK
    assert at(0.1, BACK).command[0] < 0
    assert at(0.0, BACK).direction == HOLD
    assert at(0.0, HOLD, 0.5).command.tolist() == [0.0, 0.0]
    assert not at(0.0, HOLD, 0.5).done
    assert at(0.001, HOLD, 2.0).done
    assert at(0.004, HOLD, 2.0).direction == BACK  # too far along: straight back
    assert at(-0.004, HOLD, 2.0).direction == FORWARD
    assert at(0.0, HOLD, 2.0, aside=0.004).direction == FORWARD  # aside: it needs room


@pytest.mark.parametrize("direction", [FORWARD, BACK])
def test_a_lateral_error_dies_out_driving_either_way(direction: float) -> None:
    pose, far = (
        np.array([*(VERTEX + np.array([0.0, 0.02])), 0.0]),
        VERTEX + np.array([1.5 * direction, 0.0]),
    )
    for _ in range(120):
        v, omega = settle(pose, far, ANCHOR, direction, 0.0, OURS).command
        assert v * direction > 0
        pose = pose + 0.05 * np.array([v * np.cos(pose[2]), v * np.sin(pose[2]), omega])
    assert abs(pose[1]) < 0.0005
    assert abs(pose[2]) < 0.01


def test_algorithm1_has_the_papers_errors() -> None:
    outcome = build_by_algorithm1(200, 0, BIASED)
    assert np.isfinite(outcome.seconds).all()
    assert 25e-3 <= np.abs(outcome.aside).mean() <= 40e-3
    assert 8e-3 <= np.abs(outcome.along).mean() <= 18e-3


def test_resection_is_an_order_better() -> None:
    outcome = build_by_resection(200, 0, CALIBRATED)
    assert np.isfinite(outcome.seconds).all()
    assert np.abs(outcome.aside).mean() <= 3e-3
    assert np.abs(outcome.along).mean() <= 2e-3
    assert outcome.nees.mean() == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize(("told", "aside"), [(0.0, 8e-3), (3.0, 4e-3)])
def test_resection_with_a_bias_untold_and_as_a_state(told: float, aside: float) -> None:
    noise = BearingFilterParameters(centre_std=told)
    outcome = build_by_resection(200, 0, BIASED, noise=noise)
    assert np.abs(outcome.aside).mean() <= aside
    assert np.abs(outcome.along).mean() <= 3e-3
    # Consistent only if the filter knows that there may be one.
    assert (outcome.nees.mean() < 1.3) == (told > 0)


def test_a_seed_repeats() -> None:
    first, again = (build_by_algorithm1(5, 3, BIASED) for _ in range(2))
    assert np.array_equal(first.aside, again.aside)


def test_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match="dt is 0"):
        Algorithm1Parameters(dt=0.0)
    with pytest.raises(ValueError, match="min_speed is 1"):
        SettlingParameters(min_speed=1.0)
