from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from systems.controllers.kanayama import Kanayama
from systems.controllers.replay_supervisor import (
    STATUSES,
    Memory,
    ReplayState,
    ReplaySupervisor,
    SupervisorParameters,
    View,
    radius_95,
    supervise,
)
from systems.messages import Scan
from systems.planners.route_clearance import RouteClearance
from tests.replay_world import Circuit, Drive, Truth, circuit, replay

P = SupervisorParameters()


def view(now: float = 10.0, **changes: Any) -> View:
    usual: dict[str, Any] = {
        "known": True, "radius": 0.01, "accepted": 5.0, "refused": 0.0, "restarts": 0.0,
        "arrived": False, "distance": 0.0, "free": math.inf, "speed": 0.5,
    }  # fmt: skip
    return View(now=now, **(usual | changes))


SEEN = Memory(accepted=5.0, seen=10.0)


def test_with_all_well_nothing_is_taken_away() -> None:
    assert supervise(view(), SEEN, P)[:2] == ("driving", 1.0)


@pytest.mark.parametrize(
    ("changes", "status"),
    [
        ({"known": False}, "waiting"),
        ({"arrived": True}, "arrived"),
        ({"radius": 0.3}, "lost"),
        ({"refused": 3.0}, "doubtful"),
        ({"restarts": 1.0}, "relocalised"),
        ({"distance": 0.5}, "off_route"),
        ({"free": math.nan}, "blind_ahead"),
        ({"free": 0.1}, "blocked"),
    ],
)
def test_it_stands_for_each_reason(changes: dict[str, Any], status: str) -> None:
    assert supervise(view(**changes), SEEN, P)[:2] == (status, 0.0)


def test_without_sight_it_slows_and_then_stands_until_it_sees_again() -> None:
    found = [supervise(view(10.0 + age), SEEN, P)[:2] for age in (0.4, 2.75, 4.999, 5.1)]
    assert [status for status, _ in found] == ["driving", "blind", "blind", "lost"]
    assert [scale for _, scale in found] == pytest.approx([1.0, 0.7, 0.4, 0.0], abs=1e-3)
    status, scale, memory = supervise(view(20.0, accepted=6.0), SEEN, P)
    assert (status, scale) == ("driving", 1.0)
    assert memory.seen == 20.0


def test_a_place_less_sure_is_driven_more_slowly() -> None:
    status, scale, _ = supervise(view(radius=0.125), SEEN, P)
    assert status == "blind"
    assert scale == pytest.approx(0.7)
    P_xy = np.diag([1e-4, 4e-4, 9.0])
    assert radius_95(P_xy) == pytest.approx(0.02 * math.sqrt(5.991))
    c, s = math.cos(0.7), math.sin(0.7)
    turned = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    assert radius_95(turned @ P_xy @ turned.T) == pytest.approx(radius_95(P_xy))


def test_it_can_stop_before_an_obstacle_from_every_speed_it_lets_pass() -> None:
    v, free = 0.5, 1.0
    for _ in range(400):
        _, scale, _ = supervise(view(free=free, speed=0.5), SEEN, P)
        v = max(scale * 0.5, v - P.deceleration * 0.05)  # what brakes no faster than stated
        free -= v * 0.05
    assert free == pytest.approx(P.stop_distance, abs=0.03)
    assert v < 0.02


def test_it_goes_on_when_the_way_has_been_free_for_a_while() -> None:
    _, _, memory = supervise(view(10.0, free=0.1), SEEN, P)
    assert supervise(view(10.9, accepted=6.0), memory, P)[:2] == ("blocked", 0.0)
    assert supervise(view(11.1, accepted=6.0), memory, P)[:2] == ("driving", 1.0)


def test_a_refusal_now_and_then_does_no_harm() -> None:
    memory = SEEN
    for k in range(20):
        now = 10.0 + 0.1 * k
        status, _, memory = supervise(
            view(now, accepted=5.0 + k // 2, refused=float(k - k // 2)), memory, P
        )
        assert status == "driving"


def test_it_stands_while_a_new_estimate_settles() -> None:
    _, _, memory = supervise(view(10.0, restarts=1.0, refused=9.0), SEEN, P)
    later = {"restarts": 1.0, "refused": 9.0, "accepted": 6.0}
    assert supervise(view(10.9, **later), memory, P)[0] == "relocalised"
    assert supervise(view(11.1, **later), memory, P)[0] == "driving"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stop_after": 0.5}, "stop_after"),
        ({"stop_radius": math.inf}, "stop_radius"),
        ({"slowest": 0.0}, "slowest"),
        ({"deceleration": 0.0}, "deceleration"),
    ],
)
def test_parameters_that_make_no_sense_are_refused(changes: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SupervisorParameters(**changes)


# --- In the loop ---


class Post(LeafSystem):
    """A lidar that sees nothing but a post, which stands there for some time."""

    def __init__(self, place: np.ndarray, until: float) -> None:
        super().__init__()
        self._place, self._until = place, until
        self._pose = self.DeclareVectorInputPort("pose", 3)
        self.DeclareAbstractOutputPort("scan", lambda: AbstractValue.Make(Scan()), self._calc)

    def _calc(self, context: Any, output: Any) -> None:
        now = context.get_time()
        x, y, theta = self._pose.Eval(context)
        ranges = np.full(360, math.inf)
        angles = -math.pi + np.radians(np.arange(360))
        dx, dy = self._place[0] - x, self._place[1] - y
        bearing = angles + theta - math.atan2(dy, dx)
        distance = math.hypot(dx, dy)
        hit = (np.cos(bearing) > 0) & (np.abs(distance * np.sin(bearing)) < 0.05)
        if now < self._until:
            ranges[hit] = distance - 0.05
        output.set_value(Scan(stamp=now, range_max=10.0, ranges=ranges))


def supervised(
    world: Circuit, truth: Truth, duration: float, post: tuple[np.ndarray, float] | None = None
) -> tuple[Drive, list[tuple[float, str]]]:
    """A drive under supervision, and when its status changed."""
    statuses: list[tuple[float, str]] = []
    tracker = Kanayama(route=world.route)

    def wire(builder: DiagramBuilder, parts: dict[str, LeafSystem]) -> LeafSystem:
        supervisor = builder.AddSystem(ReplaySupervisor())
        parts["supervisor"] = supervisor
        for source, port, to in (
            ("tracker", "command", "command"), ("ekf", "covariance", "covariance"),
            ("ekf", "health", "estimator_health"), ("tracker", "state", "tracking"),
        ):  # fmt: skip
            builder.Connect(parts[source].GetOutputPort(port), supervisor.GetInputPort(to))
        if post is not None:
            lidar = builder.AddSystem(Post(*post))
            clearance = builder.AddSystem(RouteClearance(route=world.route))
            builder.Connect(parts["robot"].GetOutputPort("pose"), lidar.GetInputPort("pose"))
            builder.Connect(parts["ekf"].GetOutputPort("pose"), clearance.GetInputPort("pose"))
            builder.Connect(lidar.GetOutputPort("scan"), clearance.GetInputPort("scan"))
            builder.Connect(tracker.state_output_port(), clearance.GetInputPort("tracking"))
            builder.Connect(
                clearance.free_distance_output_port(), supervisor.free_distance_input_port()
            )

        class Watch(LeafSystem):
            def __init__(self) -> None:
                super().__init__()
                self._input = self.DeclareAbstractInputPort(
                    "state", AbstractValue.Make(ReplayState())
                )
                self.DeclarePeriodicPublishEvent(0.05, 0.0, self._note)

            def _note(self, context: Any) -> None:
                status = self._input.Eval(context).status
                if not statuses or statuses[-1][1] != status:
                    statuses.append((context.get_time(), status))

        watch = builder.AddSystem(Watch())
        builder.Connect(supervisor.GetOutputPort("state"), watch.GetInputPort("state"))
        return supervisor

    drive = replay(world, tracker, truth=truth, duration=duration, wire=wire)
    return drive, statuses


def speed(drive: Drive) -> np.ndarray:
    return np.hypot(*np.diff(drive.pose[:, :2], axis=0).T) * 100.0


def test_blind_for_long_it_slows_stops_and_goes_on() -> None:
    world = circuit(3)
    drive, statuses = supervised(world, Truth(blind=(5.0, 15.0)), 20.0)
    words = [status for _, status in statuses]
    assert words == ["waiting", "driving", "blind", "lost", "driving"]
    times = {status: t for t, status in statuses}
    assert times["blind"] == pytest.approx(5.5, abs=0.2)
    assert times["lost"] == pytest.approx(10.0, abs=0.2)
    assert times["driving"] == pytest.approx(15.0, abs=0.2)
    v = speed(drive)
    assert v[1020:1490].max() < 0.05  # nothing but the yaw noise moves it
    assert v[1600:].mean() > 0.4
    assert np.abs(drive.cross_track(world.route, after=2.0)).max() < 0.05


def test_put_elsewhere_it_stands_finds_itself_and_drives_on() -> None:
    world = circuit(2)
    moved = (8.0, (0.12, 0.2, 0.3))
    drive, statuses = supervised(world, Truth(moved=moved), 20.0)
    words = [status for _, status in statuses]
    assert words == ["waiting", "driving", "doubtful", "relocalised", "driving"]
    assert statuses[2][0] < 8.7
    assert statuses[-1][0] < 11.5
    offset = np.abs(drive.cross_track(world.route))
    assert offset[820:850].max() > 0.1
    assert offset[1500:].max() < 0.02
    assert np.abs(drive.errors()[1500:, :2]).max() < 0.03


def test_it_stops_before_what_stands_on_the_route_and_waits() -> None:
    world = circuit(4)
    place = world.route.poses_at(float(world.route.time_at(4.0)))[:2]
    drive, statuses = supervised(world, Truth(), 30.0, (place, 18.0))
    words = [status for _, status in statuses]
    assert words[-4:] == ["driving", "slowing", "blocked", "driving"]
    times = [t for t, _ in statuses]
    distance = np.hypot(*(drive.pose[:, :2] - place).T)
    # 0.16 m to the front, 0.25 m to leave, 0.05 m of the post.
    assert distance[:1800].min() == pytest.approx(0.46, abs=0.06)
    assert times[-1] == pytest.approx(19.0, abs=0.3)
    assert distance[1800:].min() < 0.1
    assert set(words) <= set(STATUSES)
