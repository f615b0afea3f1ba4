from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from systems.planners.route import Route, load_route, route_from_json


def circle(radius: float = 2.0, v: float = 0.5, n: int = 252, way: float = 1.0) -> Route:
    """A closed circle about the origin, to the left for way 1, to the right for -1."""
    step = 2 * math.pi * radius / v / n
    t = step * np.arange(n)
    a = way * v / radius * t
    return Route(
        t, radius * np.cos(a), radius * np.sin(a), a + way * math.pi / 2, np.full(n, v),
        np.full(n, way * v / radius), closed=True,
    )  # fmt: skip


def straight(length: float = 3.0, v: float = 0.5, heading: float = 0.0) -> Route:
    t = 0.05 * np.arange(round(length / v / 0.05) + 1)
    c, s = math.cos(heading), math.sin(heading)
    one = np.ones(len(t))
    return Route(t, c * v * t, s * v * t, heading * one, v * one, 0 * one)


def test_a_circle_has_its_length_time_and_curvature() -> None:
    route = circle()
    assert route.length == pytest.approx(4 * math.pi, abs=1e-7)
    assert route.duration == pytest.approx(8 * math.pi)
    times = np.linspace(-3, 40, 501)
    np.testing.assert_allclose(route.curvature_at(times), 0.5)
    poses = route.poses_at(times)
    np.testing.assert_allclose(np.hypot(poses[:, 0], poses[:, 1]), 2.0, atol=1e-8)
    along = np.arctan2(poses[:, 1], poses[:, 0]) + math.pi / 2
    np.testing.assert_allclose(np.cos(along - poses[:, 2]), 1.0, atol=1e-12)
    np.testing.assert_allclose(route.run_at(times), 0.5 * times, atol=1e-7)
    np.testing.assert_allclose(route.time_at(0.5 * times), times, atol=1e-6)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_the_closest_place_of_a_circle_lies_on_the_ray_from_its_centre(way: float) -> None:
    route = circle(way=way)
    rng = np.random.default_rng(0)
    for angle, radius in zip(rng.uniform(0, 2 * np.pi, 50), rng.uniform(1.5, 2.5, 50), strict=True):
        p = radius * np.array([math.cos(angle), math.sin(angle)])
        place = route.closest(p)
        # Left of a circle to the left is inside.
        assert place.offset == pytest.approx(way * (2.0 - radius), abs=1e-6)
        assert place.distance == pytest.approx(abs(2.0 - radius), abs=1e-6)
        assert math.cos(way * 0.25 * place.time - angle) == pytest.approx(1.0, abs=1e-9)


def test_the_end_of_a_lap_is_as_near_as_its_beginning() -> None:
    route = circle()
    for near in (0.1, route.duration - 0.1):
        place = route.closest(np.array([2.1, -0.2]), near=near, window=0.5)
        assert place.offset == pytest.approx(2 - math.hypot(2.1, 0.2), abs=1e-6)
        assert place.time > route.duration - 1.0


def test_a_window_holds_to_its_own_branch_of_a_crossing() -> None:
    a = np.linspace(0, 2 * math.pi, 400, endpoint=False)
    x, y = 2 * np.sin(a), 2 * np.sin(a) * np.cos(a)
    dx, dy = 2 * np.cos(a), 2 * np.cos(2 * a)
    rate = 0.3
    theta = np.unwrap(np.arctan2(dy, dx))
    omega = np.gradient(theta, a) * rate
    eight = Route(a / rate, x, y, theta, rate * np.hypot(dx, dy), omega, closed=True)
    there = eight.closest(np.array([0.02, -0.03]), near=0.1, window=0.5)
    back = eight.closest(np.array([0.02, -0.03]), near=eight.duration / 2, window=0.5)
    assert min(there.time, eight.duration - there.time) < 0.2
    assert back.time == pytest.approx(eight.duration / 2, abs=0.2)


def test_an_open_route_ends() -> None:
    route = straight()
    assert route.duration == pytest.approx(6.0)
    np.testing.assert_allclose(route.poses_at(100.0), [3.0, 0.0, 0.0])
    np.testing.assert_array_equal(route.speeds_at([-1.0, 6.0, 7.0]), np.zeros((3, 2)))
    beyond = route.closest(np.array([3.3, 0.4]))
    assert beyond.time == pytest.approx(6.0)
    assert beyond.offset == pytest.approx(0.4)
    assert beyond.distance == pytest.approx(0.5)


def test_a_file_gives_the_route_back(tmp_path: Path) -> None:
    route = circle(way=-1.0)
    object.__setattr__(route, "limits", {"max_speed": 0.5})
    route.save(tmp_path / "route.json")
    again = load_route(tmp_path / "route.json")
    assert again.closed
    assert again.limits == {"max_speed": 0.5}
    times = np.linspace(0, 30, 77)
    np.testing.assert_allclose(again.poses_at(times), route.poses_at(times), atol=1e-8)
    np.testing.assert_allclose(again.speeds_at(times), route.speeds_at(times), atol=1e-8)


def broken(**changes: object) -> dict[str, object]:
    content = straight().to_json()
    for key, value in changes.items():
        if callable(value):
            content[key] = value(content[key])
        else:
            content[key] = value
    return content


def at(k: int, value: object) -> object:
    return lambda column: [*column[:k], value, *column[k + 1 :]]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "the route is"),
        (broken(speed=[]), "unknown key 'speed'"),
        ({"t": []}, "lacks the key 'closed'"),
        (broken(closed=1), "closed is 1: must be true or false"),
        (broken(x=at(3, None)), r"x\[3\] is None: must be a number"),
        (broken(theta=at(7, math.nan)), r"theta\[7\] is nan: must be finite"),
        (broken(v=lambda v: v[:-1]), "length of v is 120: must be 121"),
        (broken(t=at(5, 0.27)), r"t\[5\] is 0.27: must be 0.05 s after t\[4\]"),
        (broken(x=at(9, 0.6)), r"from t = 0.40 s to 0.45 s the route goes 0.4 m"),
        (
            broken(theta=lambda th: [1.6] * len(th), v=lambda v: [4.0] * len(v)),
            r"from t = 0.00 s to 0.05 s the route goes",
        ),
        (broken(limits={"max_speed": "fast"}), "limits.max_speed is 'fast'"),
    ],
)
def test_what_is_no_route_is_refused(content: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        route_from_json(content)


def test_a_closed_route_that_does_not_meet_its_beginning_is_refused() -> None:
    content = straight().to_json() | {"closed": True}
    with pytest.raises(ValueError, match=r"from t = 6\.00 s to 6.05 s the route goes 3 m"):
        route_from_json(content)


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"route .*none.json: No such file"):
        load_route(tmp_path / "none.json")
    path = tmp_path / "cut.json"
    path.write_text(json.dumps(straight().to_json())[:100])
    with pytest.raises(ValueError, match=r"route .*cut.json is not JSON"):
        load_route(path)
