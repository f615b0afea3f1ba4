from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from systems.avoiders.base import View
from systems.avoiders.sector import (
    SectorParameters,
    blocking_distances,
    choose,
    choose_sector,
    sector_of,
)

PRINTED = SectorParameters()
FRESH = np.full(5, math.nan)
RADIUS = 0.147


def polar(*points: tuple[float, float]) -> np.ndarray:
    """Points by distance (m) and bearing (degrees)."""
    return np.array(
        [[r * math.cos(math.radians(a)), r * math.sin(math.radians(a))] for r, a in points]
    )


def view(points: np.ndarray, **changes: Any) -> View:
    values = {
        "now": 0.0,
        "pose": np.zeros(3),
        "goal": np.array([3.0, 0.0]),
        "twist": np.zeros(2),
    }
    return View(points=points.reshape(-1, 2), **{**values, **changes})


def blocked_degrees(points: np.ndarray, radius: float, **parameters: Any) -> set[int]:
    distances = blocking_distances(points, SectorParameters(**parameters))
    degrees = np.arange(len(distances)) * 360 // len(distances)
    return {int(d) if d <= 180 else int(d) - 360 for d in degrees[distances <= radius]}


def test_sectors_are_five_degrees_about_the_heading() -> None:
    degrees = np.array([0.0, 2.4, -2.4, 2.6, -2.6, 180.0, -179.0, 90.0])
    assert sector_of(np.radians(degrees), 72).tolist() == [0, 0, 0, 1, 71, 36, 36, 18]


def test_an_obstacle_blocks_its_sector_and_25_degrees_to_either_side() -> None:
    expected = set(range(-15, 36, 5))
    assert blocked_degrees(polar((0.4, 10)), 0.5) == expected
    assert blocked_degrees(polar((0.9, 10)), 1.0) == expected
    assert blocked_degrees(polar((0.9, 10)), 0.5) == set()
    assert blocked_degrees(polar((1.01, 10)), 1.0) == set()


def test_the_printed_50_degrees_block_twice_as_wide() -> None:
    blocked = blocked_degrees(polar((0.4, 10)), 0.5, widening=math.radians(50))
    assert blocked == set(range(-40, 61, 5))


def test_blocking_goes_around_the_back() -> None:
    assert blocked_degrees(polar((0.4, 180)), 0.5) == {
        155,
        160,
        165,
        170,
        175,
        180,
        -175,
        -170,
        -165,
        -160,
        -155,
    }


def test_the_nearest_obstacle_counts() -> None:
    distances = blocking_distances(polar((0.8, 0), (0.3, 20)), PRINTED)
    assert distances[0] == pytest.approx(0.3)  # 20 degrees aside
    assert distances[-2] == pytest.approx(0.8)  # -10: beyond the widening of the near one
    assert math.isinf(distances[30])


@pytest.mark.parametrize(
    ("obstacles", "goal", "expected"),
    [
        ([(0.4, 0)], 5, 30),  # blocked from -25 to 25: 30 is nearer to the goal than -30
        ([(0.4, 0)], -5, -30),
        ([(0.4, 0)], 0, 30),  # both equally near: the left one
        ([(0.4, 0), (0.4, 30)], 5, -30),
        ([(0.9, 0)], 5, 5),  # blocked beyond the search radius only
        ([(0.4, 0)], 90, 90),
    ],
)
def test_the_free_sector_nearest_to_the_goal_is_chosen(
    obstacles: list[tuple[float, float]], goal: float, expected: float
) -> None:
    distances = blocking_distances(polar(*obstacles), PRINTED)
    sector = choose_sector(distances, math.radians(goal), 0.5)
    assert sector == expected // 5 % 72


def test_no_sector_is_free_in_a_ring() -> None:
    ring = polar(*[(0.4, a) for a in range(0, 360, 40)])
    assert choose_sector(blocking_distances(ring, PRINTED), 0.0, 0.5) is None
    assert choose(view(ring), FRESH, PRINTED, RADIUS).bearing is None


def test_a_free_way_is_left_alone() -> None:
    for points in (np.zeros((0, 2)), polar((1.2, 0), (0.3, 90))):
        choice = choose(view(points), FRESH, PRINTED, RADIUS)
        assert choice.clear
        np.testing.assert_array_equal(choice.local_goal, [3.0, 0.0])


def test_a_step_is_half_a_metre_in_the_chosen_direction() -> None:
    choice = choose(view(polar((0.4, 0)), goal=np.array([3.0, 0.1])), FRESH, PRINTED, RADIUS)
    assert not choice.clear
    np.testing.assert_allclose(
        choice.local_goal, [0.5 * math.cos(math.pi / 6), 0.5 * math.sin(math.pi / 6)]
    )


def test_the_robot_turns_before_a_step_aside() -> None:
    points = polar(*[(0.4, a) for a in range(-30, 31, 10)])  # blocked to 55 degrees
    choice = choose(view(points), FRESH, PRINTED, RADIUS)
    assert choice.bearing == pytest.approx(math.radians(60))
    assert choice.local_goal is None


def test_what_stands_behind_the_goal_blocks_nothing() -> None:
    wall = np.stack([np.full(41, 0.45), np.linspace(-1, 1, 41)], axis=1)
    assert not choose(view(wall), FRESH, PRINTED, RADIUS).clear
    near = choose(view(wall, goal=np.array([0.25, 0.0])), FRESH, PRINTED, RADIUS)
    assert near.clear


def test_a_step_is_kept_until_it_ends() -> None:
    post = np.array([0.4, 0.0])
    first = choose(view(post), FRESH, PRINTED, RADIUS)
    assert first.local_goal is not None

    def later(pose: list[float], now: float = 1.0, goal: tuple[float, float] = (3.0, 0.0)) -> Any:
        at = np.array(pose)
        offset = post - at[:2]
        c, s = math.cos(at[2]), math.sin(at[2])
        seen = np.array([c * offset[0] + s * offset[1], c * offset[1] - s * offset[0]])
        return choose(
            view(seen, pose=at, now=now, goal=np.array(goal)), first.memory, PRINTED, RADIUS
        )

    # A little to the left of the way, the goal's sector is still blocked: the same end.
    np.testing.assert_array_equal(later([0.02, 0.08, 0.4]).local_goal, first.local_goal)
    # Another end: too late, the goal has moved on.
    assert not np.allclose(later([0.02, 0.08, 0.4], now=6.0).local_goal, first.local_goal)
    moved = later([0.02, 0.08, 0.4], goal=(3.0, 1.0))
    assert not np.allclose(moved.local_goal, first.local_goal)


def test_a_step_ends_when_something_comes_into_its_way() -> None:
    first = choose(view(polar((0.4, 0))), FRESH, PRINTED, RADIUS)
    newcomer = choose(view(polar((0.4, 0), (0.45, 30)), now=0.2), first.memory, PRINTED, RADIUS)
    assert newcomer.bearing == pytest.approx(math.radians(-30))


def random_points(seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    return polar(*zip(random.uniform(0.25, 1.2, 12), random.uniform(-180, 180, 12), strict=True))


@pytest.mark.parametrize("seed", range(20))
def test_the_mirror_image_gives_the_mirrored_choice(seed: int) -> None:
    points, flip = random_points(seed), np.array([1.0, -1.0])
    goal = np.array([2.0, 0.713])
    one = choose(view(points, goal=goal), FRESH, PRINTED, RADIUS).bearing
    other = choose(view(points * flip, goal=goal * flip), FRESH, PRINTED, RADIUS).bearing
    assert (one is None) == (other is None)
    if one is not None:
        assert other == pytest.approx(-one)


@pytest.mark.parametrize("seed", range(5))
def test_the_choice_turns_with_everything(seed: int) -> None:
    points = random_points(seed)
    one = choose(view(points, goal=np.array([2.0, 0.7])), FRESH, PRINTED, RADIUS)
    c, s = math.cos(1.234), math.sin(1.234)
    turned = choose(
        view(
            points,
            pose=np.array([5.0, 6.0, 1.234]),
            goal=np.array([5 + 2 * c - 0.7 * s, 6 + 2 * s + 0.7 * c]),
        ),
        FRESH,
        PRINTED,
        RADIUS,
    )
    assert turned.bearing == pytest.approx(one.bearing)
    np.testing.assert_array_equal(turned.free, one.free)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("sectors", 3),
        ("block_radius", 0.4),
        ("block_radius", math.nan),
        ("widening", -0.1),
        ("widening", 4.0),
        ("search_radius", 0.0),
        ("step", 0.05),
        ("arrived", -1.0),
        ("step_timeout", 0.0),
        ("turn_first", 0.0),
        ("max_scan_age", 0.0),
        ("give_up_after", -1.0),
    ],
)
def test_bad_parameters_are_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match="must be"):
        SectorParameters(**{field: value})
