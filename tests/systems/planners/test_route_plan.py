from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap
from systems.planners.route_limits import RouteLimits
from systems.planners.route_plan import RoutePlan, plan_route
from systems.planners.tag_view import TagView
from systems.planners.taught_path import TaughtPath, taught_path
from tests.replay_world import CAMERA, X_BC, Circuit, circuit


def tags_at(*xy: tuple[float, float]) -> MarkerMap:
    kind = family("36h11")
    X = [RigidTransform(RotationMatrix(), [x, y, 0.3]) for x, y in xy]
    return MarkerMap(kind, 0.18, {k: Marker(k, X_WM, 0.18) for k, X_WM in enumerate(X)})


def ring(radius: float = 2.0) -> TaughtPath:
    n = round(2 * math.pi * radius / 0.05)
    a = 2 * math.pi * np.arange(n) / n
    return TaughtPath(radius * np.column_stack([np.cos(a), np.sin(a)]), True)


def taught(world: Circuit, wobble: float = 0.05) -> TaughtPath:
    """As a person drives: weaving, noisy, and a bit farther than once around."""
    route = world.route
    poses = np.column_stack([route.x, route.y, route.theta])
    poses = np.vstack([poses, poses[:30]])
    s = 0.025 * np.arange(len(poses))
    aside = wobble * np.sin(2 * np.pi * s / 1.7)
    aside += np.random.default_rng(0).normal(0, 0.003, len(poses))
    poses[:, 0] -= np.sin(poses[:, 2]) * aside
    poses[:, 1] += np.cos(poses[:, 2]) * aside
    return taught_path(0.05 * np.arange(len(poses)), poses)


@cache
def planned(seed: int, max_speed: float) -> RoutePlan:
    world = circuit(seed)
    view = TagView(world.tags, CAMERA, X_BC)
    return plan_route(taught(world), world.tags, RouteLimits(max_speed=max_speed), view)


@pytest.mark.parametrize(("seed", "max_speed"), [(0, 0.5), (1, 0.9)])
def test_every_limit_holds_at_steps_of_a_centimetre(seed: int, max_speed: float) -> None:
    plan, world = planned(seed, max_speed), circuit(seed)
    limits, route = plan.limits, plan.route
    times = route.time_at(np.arange(0.0, route.length, 0.01))
    poses, (v, omega) = route.poses_at(times), route.speeds_at(times).T
    assert v.max() <= limits.max_speed * 1.001
    assert np.abs(omega).max() <= limits.max_turn_rate * 1.01
    assert np.abs(v * omega).max() <= limits.max_lateral_acceleration * 1.02
    gained = np.diff(v) / np.diff(times)
    assert np.abs(gained).max() <= limits.max_acceleration * 1.05
    # By the curve itself, not by what is said of it: three points a few centimetres apart.
    p = poses[:, :2]
    a, b = p[4:-4] - p[:-8], p[8:] - p[4:-4]
    turned = np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1))
    bend = turned / np.linalg.norm(a, axis=1)
    assert np.abs(bend).max() <= limits.max_curvature
    np.testing.assert_allclose(bend, (omega / v)[4:-4], atol=0.06)
    line = plan.taught.polyline
    to_taught = np.array([np.linalg.norm(line - q, axis=1).min() for q in p])
    assert to_taught.max() <= math.hypot(limits.corridor, 0.03)  # of a polyline's points
    tags = np.array([tag.X_WM.translation()[:2] for tag in world.tags])
    assert np.linalg.norm(p[:, None] - tags, axis=2).min() >= limits.tag_distance
    assert plan.metrics()["two_tag_fraction"] >= 0.95


def test_the_fastest_way_within_a_ring_is_along_its_inner_edge() -> None:
    # Of two per cent of the corridor is made no use.
    limits = RouteLimits(max_speed=0.4, max_lateral_acceleration=1.0)
    plan = plan_route(ring(), tags_at((4.0, 0.0)), limits)
    assert plan.route.duration == pytest.approx(2 * math.pi * (2.0 - 0.147) / 0.4, rel=2e-3)
    # So it is where the bend limits the speed: sqrt(a r) along 2 pi r.
    limits = RouteLimits(max_speed=3.0, max_turn_rate=9.0, max_lateral_acceleration=0.3)
    plan = plan_route(ring(), tags_at((4.0, 0.0)), limits)
    assert plan.route.duration == pytest.approx(2 * math.pi * math.sqrt(1.853 / 0.3), rel=2e-3)
    assert plan.binds["lateral_acceleration"] > 0.95
    assert plan.binds["corridor"] > 0.95
    assert plan.binds["speed"] == 0.0


def test_a_tag_beside_the_ring_pushes_the_route_away() -> None:
    plan = plan_route(ring(), tags_at((1.75, 0.0)), RouteLimits())
    k = int(np.argmin(plan.tag_distance))
    assert 0.35 <= plan.tag_distance[k] <= 0.37
    assert plan.points[k, 0] > 2.08
    assert np.abs(plan.offset).max() <= 0.15
    assert plan.binds["tag_distance"] > 0.01


def test_a_mirrored_path_gives_the_mirrored_route() -> None:
    world = circuit(0)
    path = taught(world)
    other = TaughtPath(path.points * [1.0, -1.0], True)
    away = tags_at((4.0, 0.0))
    left, right = (plan_route(p, away, RouteLimits()) for p in (path, other))
    assert left.route.duration == pytest.approx(right.route.duration, abs=1e-3)
    np.testing.assert_allclose(left.points, right.points * [1.0, -1.0], atol=2e-3)
    np.testing.assert_allclose(left.curvature, -right.curvature, atol=0.02)


def test_it_is_faster_than_what_was_taught() -> None:
    plan = planned(0, 0.5)
    assert plan.route.length < 0.96 * plan.taught.length
    assert plan.route.duration < 0.96 * plan.taught.length / 0.5


def test_an_open_route_begins_and_ends_at_rest() -> None:
    x = np.arange(0, 3.0, 0.05)
    path = TaughtPath(np.column_stack([x, 0.3 * np.sin(x)]), False)
    route = plan_route(path, tags_at((1.0, 2.0)), RouteLimits()).route
    assert not route.closed
    assert route.v[0] == pytest.approx(0.0, abs=1e-6)
    assert route.v[-1] == pytest.approx(0.0, abs=1e-6)
    ends = route.poses_at([0.0, route.duration])[:, :2]
    assert np.linalg.norm(ends - path.points[[0, -1]], axis=1).max() < 0.15


def test_view_is_bought_with_time() -> None:
    world = circuit(2)
    path, view = taught(world), TagView(world.tags, CAMERA, X_BC)
    without = plan_route(path, world.tags, RouteLimits(view_share=0.0), view)
    assert without.metrics()["two_tag_fraction"] < 0.985
    with_it = plan_route(path, world.tags, RouteLimits(view_share=0.985), view)
    assert with_it.metrics()["two_tag_fraction"] >= 0.985
    assert with_it.route.duration > without.route.duration


@pytest.mark.parametrize(
    ("limits", "tags", "message"),
    [
        ({}, tags_at((2.0, 0.0)), r"tag_distance is 0\.1\d+ m at \((2|1)\.\d+, -?0\.0\d\)"),
        ({"max_curvature": 0.3}, tags_at((4.0, 0.0)), "max_curvature is 0.4"),
        ({}, tags_at((30.0, 0.0)), "outside the map: 32.0 m from the nearest tag"),
        ({}, tags_at(), "has no tags"),
    ],
)
def test_limits_that_cannot_hold_are_named_with_the_place(
    limits: dict[str, float], tags: MarkerMap, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        plan_route(ring(), tags, RouteLimits(**limits))


def test_too_few_tags_in_view_are_refused_with_the_place() -> None:
    world = circuit(0)
    some = MarkerMap(world.tags.family, 0.18, {k: world.tags.markers[k] for k in range(12)})
    view = TagView(some, CAMERA, X_BC)
    with pytest.raises(ValueError, match=r"min_tags cannot be kept: fewer than 2 .* along \d+"):
        plan_route(taught(world), some, RouteLimits(), view)


@pytest.mark.parametrize("name", ["max_speed", "corridor", "tag_distance", "view_share"])
def test_limits_must_make_sense(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        RouteLimits(**{name: -1.0})
