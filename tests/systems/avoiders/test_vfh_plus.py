from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from systems.angles import wrap
from systems.avoiders.base import Hull, View
from systems.avoiders.polar_histogram import (
    binary_histogram,
    free_distance,
    primary_histogram,
    turning_limits,
)
from systems.avoiders.vfh_plus import (
    VfhPlusParameters,
    candidate_directions,
    cheapest,
    choose,
    widened_radius,
)

P = VfhPlusParameters()
ROUND: dict[str, Any] = {"window": P.window, "sectors": P.sectors}
HULL = Hull(0.11, 0.11, 0.0975)
FRESH = np.append(np.zeros(72), math.nan)


def polar(*points: tuple[float, float]) -> np.ndarray:
    """Points by distance (m) and bearing (degrees)."""
    return np.array(
        [[r * math.cos(math.radians(a)), r * math.sin(math.radians(a))] for r, a in points]
    )


def wall(x: float, y_min: float, y_max: float) -> np.ndarray:
    y = np.arange(y_min, y_max + 1e-9, 0.02)
    return np.stack([np.full_like(y, x), y], axis=1)


def view(points: np.ndarray, **changes: Any) -> View:
    values = {
        "now": 0.0,
        "pose": np.zeros(3),
        "goal": np.array([3.0, 0.0]),
        "twist": np.zeros(2),
    }
    return View(points=points.reshape(-1, 2), **{**values, **changes})


def degrees_where(mask: np.ndarray) -> set[int]:
    return {int(d) if d <= 180 else int(d) - 360 for d in np.flatnonzero(mask) * 5}


def test_a_point_fills_the_sectors_that_the_robot_would_meet_it_in() -> None:
    # asin(0.25 / 1) = 14.5 degrees to either side; it counts 1 - (1 / 1.5)^2.
    density = primary_histogram(polar((1.0, 0)), 0.25, **ROUND)
    assert degrees_where(density > 0) == {-10, -5, 0, 5, 10}
    np.testing.assert_allclose(density[[0, 1, 2, 70, 71]], 1 - 1 / 2.25)


def test_points_add_up_and_go_around_the_back() -> None:
    density = primary_histogram(polar((1.0, 175), (0.5, -170)), 0.25, **ROUND)
    # The first from 160.5 to 189.5 degrees, the second (30 degrees) from 160 to 220.
    assert degrees_where(density > 0) == {*range(160, 181, 5), *range(-175, -139, 5)}
    far, near = 1 - 1 / 2.25, 1 - 0.25 / 2.25
    assert density[32] == pytest.approx(near)  # 160
    assert density[36] == pytest.approx(far + near)  # 180
    assert density[44] == pytest.approx(near)  # 220


def test_a_point_nearer_than_the_radius_fills_half_the_circle() -> None:
    density = primary_histogram(polar((0.2, 90)), 0.25, **ROUND)
    assert degrees_where(density > 0) == set(range(0, 181, 5))


def test_what_is_beyond_the_window_does_not_count() -> None:
    assert not primary_histogram(polar((1.51, 0)), 0.25, **ROUND).any()


def test_between_the_thresholds_a_sector_stays_as_it_was() -> None:
    density = np.array([0.1, 0.5, 0.9, 0.1, 0.5, 0.9])
    before = np.array([False, False, False, True, True, True])
    after = binary_histogram(density, before, 0.4, 0.8)
    assert after.tolist() == [False, False, True, False, True, True]


def test_a_robot_at_speed_cannot_turn_into_what_is_beside_it() -> None:
    # Circles of radius 0.2 m about (0, +-0.2); widened by 0.2 m they reach out to 0.4 m.
    right, left = turning_limits(np.array([[0.3, 0.3]]), 0.2, 0.2)
    assert left == pytest.approx(math.pi / 4)
    assert right == -math.pi
    right, left = turning_limits(np.array([[0.3, -0.3], [-0.1, -0.3], [0.5, 0.5]]), 0.2, 0.2)
    assert left == math.pi  # the third is 0.58 m from the centre
    assert right == pytest.approx(-math.pi / 4)
    assert turning_limits(np.zeros((0, 2)), 0.2, 0.2) == (-math.pi, math.pi)


def free_at(*ranges: tuple[int, int]) -> np.ndarray:
    free = np.zeros(72, bool)
    for first, last in ranges:
        free[np.arange(first // 5, last // 5 + 1) % 72] = True
    return free


def test_candidates_by_hand() -> None:
    wide = math.radians(80)
    # 50 to 65 is narrow (20 degrees): its middle. 100 to 250 is wide: 40 degrees inside its edges,
    # which are those of its sectors, 97.5 and 252.5.
    found = candidate_directions(free_at((50, 65), (100, 250)), math.radians(0), wide)
    assert sorted(round(math.degrees(c), 6) % 360 for c in found) == [57.5, 137.5, 212.5]
    # Across the first sector.
    found = candidate_directions(free_at((350, 365)), math.radians(90), wide)
    np.testing.assert_allclose(np.degrees(found), [-2.5])
    # The target where it is free.
    found = candidate_directions(free_at((350, 365)), math.radians(6), wide)
    np.testing.assert_allclose(np.degrees(found), [-2.5, 6.0])
    assert candidate_directions(np.ones(72, bool), 1.23, wide) == [1.23]


def test_the_cost_weighs_target_heading_and_the_last_choice() -> None:
    candidates = [math.radians(40), math.radians(-50)]
    assert cheapest(candidates, 0.0, 0.0, math.nan, P) == candidates[0]
    # 5 * 40 + 2 * 40 + 2 * 90 = 460 against 5 * 50 + 2 * 50 + 2 * 0 = 350.
    assert cheapest(candidates, 0.0, 0.0, math.radians(-50), P) == candidates[1]
    # 5 * 40 + 2 * 90 = 380 against 5 * 50 + 0 = 250.
    assert cheapest(candidates, 0.0, math.radians(-50), math.nan, P) == candidates[1]
    # The target outweighs both: 5 * 10 + 4 * 60 against 5 * 70.
    far = [math.radians(10), math.radians(70)]
    assert cheapest(far, 0.0, math.radians(70), math.radians(70), P) == far[0]


def test_a_disc_gets_as_far_as_it_touches() -> None:
    points = np.array([[1.0, 0.0], [0.5, 0.3]])
    found = free_distance(points, np.radians([0.0, 90.0, 180.0]), 0.2)
    np.testing.assert_allclose(found, [0.8, math.inf, math.inf])
    # Within the disc: no way nearer, all ways off.
    inside = free_distance(np.array([[0.1, 0.0]]), np.radians([0.0, 60.0, 120.0]), 0.2)
    np.testing.assert_allclose(inside, [0.0, 0.0, math.inf])
    # Against a search by small steps.
    random = np.random.default_rng(3)
    points = random.uniform(-1, 1, (40, 2))
    points = points[np.hypot(*points.T) > 0.2]
    for bearing in random.uniform(-3, 3, 10):
        steps = np.arange(0, 3, 0.001)[:, None] * [math.cos(bearing), math.sin(bearing)]
        gaps = np.hypot(*(points[:, None] - steps).transpose(2, 0, 1)).min(axis=0)
        expected = 0.001 * np.argmax(gaps < 0.2) if (gaps < 0.2).any() else math.inf
        found = free_distance(points, np.array([bearing]), 0.2)[0]
        assert found == pytest.approx(expected, abs=0.002)


def test_the_safety_distance_gives_way() -> None:
    assert widened_radius(np.array([2.0]), HULL, 0.08) == pytest.approx(HULL.radius + 0.08)
    assert widened_radius(np.array([0.2, 1.0]), HULL, 0.08) == pytest.approx(0.19)
    assert widened_radius(np.array([0.05]), HULL, 0.08) == HULL.half_width
    assert widened_radius(np.zeros(0), HULL, 0.08) == pytest.approx(HULL.radius + 0.08)


@pytest.mark.parametrize("aside", [-0.15, -0.08, 0.0, 0.08, 0.15])
def test_a_passage_of_60_cm_is_free_lengthwise_wherever_the_robot_stands_in_it(
    aside: float,
) -> None:
    x = np.arange(-2, 2, 0.02)
    walls = [np.stack([x, np.full_like(x, y - aside)], axis=1) for y in (-0.3, 0.3)]
    choice = choose(view(np.concatenate(walls)), FRESH, P, HULL)
    assert choice.bearing is not None
    assert abs(choice.bearing) < math.radians(20)
    assert choice.bearing * aside <= 1e-9  # never toward the near wall


def test_a_free_way_is_left_alone() -> None:
    for points in (np.zeros((0, 2)), polar((1.6, 0)), wall(1.0, 0.4, 1.5)):
        choice = choose(view(points, twist=np.array([0.3, 0.0])), FRESH, P, HULL)
        assert choice.clear
        np.testing.assert_array_equal(choice.local_goal, [3.0, 0.0])


def test_it_goes_around_the_shorter_end_of_a_wall() -> None:
    choice = choose(view(wall(1.0, -1.0, 0.3)), FRESH, P, HULL)
    assert choice.bearing is not None
    # Past the end by radius and safety distance, within a sector.
    end = math.atan2(0.3, 1.0) + math.asin((HULL.radius + 0.08) / math.hypot(0.3, 1.0))
    assert end - math.radians(5) < choice.bearing
    assert not choice.clear


def test_the_local_goal_comes_nearer_with_less_room() -> None:
    reaches = []
    for x in (0.8, 0.6, 0.45, 0.35):
        choice = choose(view(wall(x, -0.9, 0.9)), FRESH, P, HULL)
        local = choice.local_goal
        reaches.append(0.0 if local is None else float(np.hypot(*local)))
    assert reaches == sorted(reaches, reverse=True)
    assert reaches[0] <= 0.8 - HULL.radius
    assert reaches[-1] < 0.2


def test_what_stands_behind_the_goal_blocks_nothing() -> None:
    for gap in (0.16, 0.3):
        goal = np.array([0.5, 0.0])
        choice = choose(view(wall(0.5 + gap, -1, 1), goal=goal), FRESH, P, HULL)
        np.testing.assert_array_equal(choice.local_goal, goal)
    assert not choose(view(wall(0.4, -1, 1), goal=goal), FRESH, P, HULL).clear


def test_no_direction_is_free_in_a_ring() -> None:
    ring = polar(*[(0.5, a) for a in range(0, 360, 20)])
    choice = choose(view(ring), FRESH, P, HULL)
    assert choice.bearing is None
    assert not choice.free.any()


def test_at_speed_a_way_behind_needs_a_stop() -> None:
    # A dead end that is open behind: standing, it may turn; at speed it must stop for that.
    x = np.arange(-0.3, 0.45, 0.02)
    sides = [np.stack([x, np.full_like(x, y)], axis=1) for y in (-0.32, 0.32)]
    dead_end = np.concatenate([wall(0.45, -0.32, 0.32), *sides])
    fast = choose(view(dead_end, twist=np.array([0.3, 0.0])), FRESH, P, HULL)
    assert fast.bearing is not None
    assert abs(fast.bearing) > math.radians(120)
    assert fast.local_goal is None


def random_points(seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    return polar(*zip(random.uniform(0.3, 1.4, 15), random.uniform(-180, 180, 15), strict=True))


@pytest.mark.parametrize("seed", range(20))
def test_the_mirror_image_gives_the_mirrored_choice(seed: int) -> None:
    points, flip = random_points(seed), np.array([1.0, -1.0])
    goal, twist = np.array([2.0, 0.713]), np.array([0.25, 0.1])
    one = choose(view(points, goal=goal, twist=twist), FRESH, P, HULL)
    other = choose(view(points * flip, goal=goal * flip, twist=twist * flip), FRESH, P, HULL)
    if one.bearing is None:
        assert other.bearing is None
    else:
        assert other.bearing == pytest.approx(-one.bearing)
    np.testing.assert_array_equal(other.free, one.free[-np.arange(72) % 72])


@pytest.mark.parametrize("seed", range(10))
def test_the_choice_turns_with_everything(seed: int) -> None:
    points = random_points(seed)
    angle = math.radians(35)  # seven sectors: those of the histogram are fixed in map
    one = choose(view(points, goal=np.array([2.0, 0.7])), FRESH, P, HULL)
    c, s = math.cos(angle), math.sin(angle)
    goal = np.array([5 + 2 * c - 0.7 * s, 6 + 2 * s + 0.7 * c])
    other = choose(view(points, pose=np.array([5.0, 6.0, angle]), goal=goal), FRESH, P, HULL)
    assert (one.bearing is None) == (other.bearing is None)
    if one.bearing is not None:
        assert wrap(other.bearing - one.bearing) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("sectors", 2),
        ("window", 0.0),
        ("threshold_low", 0.9),
        ("threshold_high", math.nan),
        ("safety_distance", -0.1),
        ("wide_opening", 0.0),
        ("target_cost", 4.0),
        ("current_cost", -1.0),
        ("previous_cost", 3.5),
        ("max_turn_rate", 0.0),
        ("turn_in_place_below", -0.1),
        ("look_ahead", math.inf),
    ],
)
def test_bad_parameters_are_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match="must be"):
        VfhPlusParameters(**{field: value})
