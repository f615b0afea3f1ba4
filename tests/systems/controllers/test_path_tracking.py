from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from systems.controllers.kanayama import Kanayama, KanayamaParameters
from systems.controllers.mpc import Mpc
from systems.controllers.path_tracking import (
    PathTracker,
    TrackingParameters,
    advance,
    begin,
    driven,
    error_of,
    limited,
)
from systems.controllers.pure_pursuit import PurePursuit
from systems.controllers.tvlqr import Tvlqr
from tests.systems.controllers.tracking import circle, closed_loop, mirrored, straight

KINDS = [Kanayama, PurePursuit, Tvlqr, Mpc]
P = TrackingParameters()


def test_the_error_and_the_pose_it_is_seen_from_give_the_pose_back() -> None:
    rng = np.random.default_rng(0)
    for a, b in rng.uniform(-2, 2, (20, 2, 3)):
        ahead, left, turn = error_of(a, b)
        c, s = math.cos(b[2]), math.sin(b[2])
        again = [b[0] + c * ahead - s * left, b[1] + s * ahead + c * left, b[2] + turn]
        np.testing.assert_allclose(again[:2], a[:2])
        assert math.cos(again[2] - a[2]) == pytest.approx(1.0)


def test_driving_a_quarter_of_a_circle_leads_where_it_should() -> None:
    pose = driven(np.array([1.0, 2.0, math.pi / 2]), np.array([math.pi / 2, math.pi / 2]), 1.0)
    np.testing.assert_allclose(pose, [0.0, 3.0, math.pi], atol=1e-12)


def test_a_speed_that_cannot_be_had_keeps_the_curve() -> None:
    p = TrackingParameters(max_speed=0.5, max_acceleration=100, max_turn_acceleration=100)
    np.testing.assert_allclose(limited(np.array([1.0, 0.8]), np.zeros(2), 1.0, p), [0.5, 0.4])


def test_commands_change_no_faster_than_allowed_and_stay_within_limits() -> None:
    p = TrackingParameters(max_acceleration=1.0, max_turn_acceleration=4.0, max_turn_rate=1.0)
    np.testing.assert_allclose(limited(np.array([0.5, 3.0]), np.zeros(2), 0.1, p), [0.1, 0.4])
    np.testing.assert_allclose(limited(np.array([0.5, 1.0]), np.zeros(2), 0.1, p), [0.1, 0.2])
    before = np.array([0.3, -0.9])
    np.testing.assert_allclose(limited(np.array([-1.0, -3.0]), before, 0.1, p), [0.2, -1.0])
    np.testing.assert_allclose(limited(np.array([-1.0, 0.0]), np.zeros(2), 1.0, p), [0.0, 0.0])
    # One that is beyond them comes back no faster.
    np.testing.assert_allclose(limited(np.zeros(2), np.array([0.9, 3.0]), 0.1, p), [0.8, 2.6])


def test_the_reference_waits_at_the_end_of_its_leash_for_a_robot_that_stands() -> None:
    route = straight()
    pose = np.array([1.0, 0.02, 0.0])
    progress = begin(route, pose)
    for _ in range(100):
        progress = advance(route, progress, pose, 0.05, P)
    assert progress.place * 0.4 == pytest.approx(1.0)
    assert progress.reference * 0.4 == pytest.approx(1.0 + P.leash)
    assert progress.offset == pytest.approx(0.02)
    # And is pulled along by one that is ahead.
    progress = advance(route, progress, np.array([1.4, 0.0, 0.0]), 0.05, P)
    assert progress.reference * 0.4 == pytest.approx(1.4 - P.leash)


def test_a_robot_put_elsewhere_is_found_on_all_of_the_route() -> None:
    route = circle()
    progress = begin(route, np.zeros(3))
    progress = advance(route, progress, np.array([0.05, 3.02, math.pi]), 0.05, P)
    assert progress.place % route.duration == pytest.approx(route.duration / 2, rel=0.02)
    assert progress.distance == pytest.approx(0.02, abs=2e-3)


def test_laps_go_on_across_the_end_of_a_lap() -> None:
    route = circle()
    for way in (1, -1):  # also backwards over it
        progress = begin(route, route.poses_at(0.0))
        for k in range(1, 200):
            progress = advance(route, progress, route.poses_at(way * 0.3 * k), 0.05, P)
        assert progress.place == pytest.approx(way * 0.3 * 199, abs=1e-3)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("start", [(0.0, 0.15, 0.0), (-0.05, -0.1, 0.4), (0.0, 0.0, -0.6)])
def test_every_tracker_comes_to_a_circle_and_stays(
    kind: Callable[..., PathTracker], start: tuple[float, float, float]
) -> None:
    poses, commands, _ = closed_loop(kind(route=circle()), start, 15.0)
    off = np.hypot(poses[:, 0], poses[:, 1] - 1.5) - 1.5
    assert np.abs(off[1000:]).max() < 2e-3
    assert np.abs(off).max() < 0.2
    np.testing.assert_allclose(commands[-1], [0.4, 0.4 / 1.5], atol=0.01)


@pytest.mark.parametrize("kind", KINDS)
def test_every_tracker_drives_the_mirror_image_of_a_mirrored_route(
    kind: Callable[..., PathTracker],
) -> None:
    left, _, _ = closed_loop(kind(route=circle()), (0.0, 0.1, -0.2), 4.0)
    right, _, _ = closed_loop(kind(route=mirrored(circle())), (0.0, -0.1, 0.2), 4.0)
    np.testing.assert_allclose(right, left * [1, -1, -1], atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_every_tracker_stops_at_the_end_of_an_open_route(
    kind: Callable[..., PathTracker],
) -> None:
    tracker = kind(route=straight(2.0))
    poses, commands, end = closed_loop(tracker, (0.0, 0.05, 0.0), 12.0)
    assert poses[-1, 0] == pytest.approx(2.0, abs=0.04)
    assert abs(poses[-1, 1]) < 0.01
    np.testing.assert_array_equal(commands[-1], [0.0, 0.0])
    state = tracker.state_output_port().Eval(end)
    assert state.status == "arrived"
    assert state.run == pytest.approx(2.0, abs=0.04)


def test_the_laps_asked_for_are_driven() -> None:
    tracker = Kanayama(route=circle(0.5), laps=2.0)
    _, commands, end = closed_loop(tracker, (0.0, 0.0, 0.0), 20.0)
    state = tracker.state_output_port().Eval(end)
    assert state.status == "arrived"
    assert 2.0 <= state.laps < 2.05
    assert commands[1400, 0] > 0.3  # the second lap is under way
    np.testing.assert_array_equal(commands[-1], [0.0, 0.0])


class Rig:
    """A tracker whose inputs are given by hand."""

    def __init__(self, **parameters: float) -> None:
        self.tracker = Kanayama(route=straight(), parameters=KanayamaParameters(**parameters))
        self.simulator = Simulator(self.tracker)
        self.context = self.simulator.get_mutable_context()

    def after(
        self, t: float, pose: list[float], known: bool = True, sent: list[float] | None = None
    ) -> np.ndarray:
        covariance = (1e-4 if known else 1e6) * np.eye(3)
        self.tracker.pose_input_port().FixValue(self.context, pose)
        self.tracker.covariance_input_port().FixValue(self.context, covariance.ravel())
        if sent is not None:
            self.tracker.sent_input_port().FixValue(self.context, sent)
        self.simulator.AdvanceTo(t)
        return np.array(self.tracker.command_output_port().Eval(self.context))

    @property
    def state(self) -> object:
        return self.tracker.state_output_port().Eval(self.context)


def test_it_waits_for_an_estimate() -> None:
    rig = Rig()
    np.testing.assert_array_equal(rig.after(0.2, [0.0, 0.0, 0.0], known=False), [0.0, 0.0])
    assert rig.state.status == "waiting"  # type: ignore[attr-defined]
    assert rig.after(0.4, [0.0, 0.0, 0.0])[0] > 0.1
    assert rig.state.status == "tracking"  # type: ignore[attr-defined]


def test_what_is_not_finite_stops_it_and_is_counted() -> None:
    rig = Rig()
    assert rig.after(0.5, [0.1, 0.0, 0.0])[0] > 0.1
    np.testing.assert_array_equal(rig.after(0.61, [math.nan, 0.0, 0.0]), [0.0, 0.0])
    assert rig.after(0.8, [0.1, 0.0, 0.0], sent=[math.inf, 0.0])[0] > 0.1
    counts = rig.tracker.health_output_port().Eval(rig.context).counts
    assert counts["bad_pose"] == 3
    assert counts["bad_sent"] == 3
    rig.after(0.86, [math.nan, 0.0, 0.0], sent=[math.inf, 0.0])
    counts = rig.tracker.health_output_port().Eval(rig.context).counts
    assert (counts["bad_pose"], counts["bad_sent"]) == (5, 5)


def test_a_delay_is_foreseen() -> None:
    rig = Rig(delay=0.2)
    rig.after(0.01, [1.0, 0.0, 0.0], sent=[0.4, 0.0])
    assert rig.state.run == pytest.approx(1.08)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"leash": 0.0}, "leash"),
        ({"window": 0.1}, "at least twice the leash"),
        ({"min_speed": 0.1}, "min_speed"),
        ({"delay": -0.1}, "delay"),
        ({"max_turn_rate": math.nan}, "max_turn_rate"),
    ],
)
def test_parameters_that_make_no_sense_are_refused(changes: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TrackingParameters(**changes)


def test_arguments_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match="laps"):
        Kanayama(route=circle(), laps=0.0)
    with pytest.raises(ValueError, match="rate"):
        Tvlqr(route=circle(), rate=0.0)
