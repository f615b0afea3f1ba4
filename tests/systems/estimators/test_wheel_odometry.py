from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from systems.estimators.wheel_odometry import (
    WheelOdometry,
    WheelOdometryParameters,
    effective_track,
    moved,
    moved_covariance,
)
from systems.messages import Health

RADIUS, TRACK, TICKS = 0.045, 0.4, 3600.0
QUIET = WheelOdometryParameters(distance_noise=0.0, turn_noise=0.0, drift_noise=0.0)


def drive(readings: Any, rate: float = 50.0) -> dict[str, Any]:
    """Feeds the block a list of counts, one each reading; returns its outputs."""
    system = WheelOdometry(ticks_per_turn=TICKS, wheel_radius=RADIUS, track=TRACK, rate=rate)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    for k, ticks in enumerate(readings):
        system.ticks_input_port().FixValue(context, np.asarray(ticks, float))
        simulator.AdvanceTo((k + 0.5) / rate)
    names = ("pose", "covariance", "velocity", "health")
    return {name: system.GetOutputPort(name).Eval(context) for name in names}


def ways(right: float, left: float) -> np.ndarray:
    """Counts of ways (m)."""
    return np.array([right, left]) / (2 * math.pi * RADIUS / TICKS)


def test_arcs_by_hand() -> None:
    # Straight; a quarter of a circle of 1 m radius to the left; the same backward.
    np.testing.assert_allclose(
        moved(np.array([1.0, 2.0, math.pi / 2]), 0.5, 0.0), [1, 2.5, math.pi / 2]
    )
    np.testing.assert_allclose(moved(np.zeros(3), math.pi / 2, math.pi / 2), [1, 1, math.pi / 2])
    np.testing.assert_allclose(moved(np.zeros(3), -math.pi / 2, math.pi / 2), [-1, -1, math.pi / 2])
    # In place, past half a turn: the heading is wrapped.
    np.testing.assert_allclose(moved(np.array([0, 0, 3.0]), 0.0, 0.5), [0, 0, 3.5 - 2 * math.pi])


def test_a_circle_closes() -> None:
    # Right wheel on 1.2 m, left one on 0.8 m radius, track 0.4: base_link on 1 m.
    turns = np.linspace(0, 2 * math.pi, 500)
    found = drive([ways(1.2 * a, 0.8 * a) for a in turns])
    np.testing.assert_allclose(found["pose"], 0.0, atol=1e-9)
    half = drive([ways(1.2 * a, 0.8 * a) for a in turns[:250]])
    a = turns[249]
    np.testing.assert_allclose(half["pose"], [math.sin(a), 1 - math.cos(a), a], atol=1e-9)
    step = turns[1] * 50
    np.testing.assert_allclose(half["velocity"], [step, step], rtol=1e-9)


def test_it_starts_where_the_counters_stand() -> None:
    found = drive([[1e6, -5e5]] * 3)
    np.testing.assert_array_equal(found["pose"], 0.0)
    np.testing.assert_array_equal(found["covariance"], 0.0)


def test_what_is_dropped_is_counted_and_made_up_for() -> None:
    steps = [ways(0.01 * k, 0.01 * k) for k in range(10)]
    spoiled = list(steps)
    spoiled[4] = np.array([math.nan, 3.0])
    spoiled[7] = np.array([3.0, math.inf])
    found, plain = drive(spoiled), drive(steps)
    np.testing.assert_allclose(found["pose"], plain["pose"], atol=1e-12)
    assert found["health"].counts == {"bad_ticks": 2, "leap": 0}
    # A counter that starts again loses the way of one reading.
    reset = [s + 1e5 for s in steps[:5]] + [s - steps[5] for s in steps[5:]]
    found = drive(reset)
    assert found["health"].counts == {"bad_ticks": 0, "leap": 1}
    assert found["pose"][0] == pytest.approx(0.08)
    assert isinstance(found["health"], Health)


def test_the_covariance_is_what_many_drives_scatter_by() -> None:
    p = WheelOdometryParameters(distance_noise=0.03, turn_noise=0.05, drift_noise=0.04)
    rng = np.random.default_rng(3)
    n, steps = 20000, 40
    poses, P, pose = np.zeros((n, 3)), np.zeros((3, 3)), np.zeros(3)
    way, turn = 0.05, 0.04
    for _ in range(steps):
        ways_ = way + p.distance_noise * math.sqrt(way) * rng.standard_normal(n)
        spread = math.sqrt(p.turn_noise**2 * turn + p.drift_noise**2 * way)
        turns = turn + spread * rng.standard_normal(n)
        P = moved_covariance(P, pose[2], way, turn, p)
        pose = moved(pose, way, turn)
        middle = poses[:, 2] + turns / 2
        poses += np.stack([ways_ * np.cos(middle), ways_ * np.sin(middle), turns], axis=1)
    scatter = np.cov(poses.T)
    np.testing.assert_allclose(P, scatter, rtol=0.08, atol=0.02 * scatter.max())
    np.testing.assert_array_equal(moved_covariance(np.zeros((3, 3)), 0.3, 1.0, 1.0, QUIET), 0.0)


def test_the_track_of_a_calibration() -> None:
    turns = np.array([2.0, -6.0, 9.5])
    assert effective_track(turns * 0.41 / RADIUS, turns, RADIUS) == pytest.approx(0.41)
    with pytest.raises(ValueError, match="turns is"):
        effective_track([1.0], [0.0], RADIUS)
    with pytest.raises(ValueError, match="differences is"):
        effective_track([1.0], [-1.0], RADIUS)


@pytest.mark.parametrize("name", ["ticks_per_turn", "wheel_radius", "track", "rate", "max_speed"])
def test_nonsense_is_refused(name: str) -> None:
    good = {"ticks_per_turn": TICKS, "wheel_radius": RADIUS, "track": TRACK}
    for value in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match=f"{name} is {value}: must be greater than 0"):
            WheelOdometry(**(good | {name: value}))
    with pytest.raises(ValueError, match="turn_noise is -1"):
        WheelOdometryParameters(turn_noise=-1)
