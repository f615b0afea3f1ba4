from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator

from systems.messages import OccupancyGrid, Scan
from systems.planners.occupancy import (
    OccupancyMapper,
    OccupancyParameters,
    cells_of,
    empty_grid,
    grown,
    moved_too_fast,
    with_scan,
)
from systems.pose_trail import empty_trail, remember

P = OccupancyParameters()
GOOD = 1e-4 * np.eye(3).ravel()


def scan_of(ranges: Any, stamp: float = 0.0, time_increment: float = 0.0) -> Scan:
    ranges = np.asarray(ranges, float)
    return Scan(
        stamp=stamp,
        angle_min=-math.pi,
        angle_increment=2 * math.pi / len(ranges),
        time_increment=time_increment,
        range_min=0.15,
        range_max=12.0,
        ranges=ranges,
    )


def rays_at(pose: Any, scan: Scan) -> np.ndarray:
    n = len(scan)
    return np.stack([np.full(n, pose[0]), np.full(n, pose[1]), pose[2] + scan.angles], axis=-1)


def value_at(grid: OccupancyGrid, x: float, y: float) -> float:
    row, column = cells_of(np.array([x, y]), grid)
    return float(grid.log_odds[row, column])


def room(poses: np.ndarray, half: float = 2.0, lidar: float = 0.0) -> np.ndarray:
    """Ranges (n,) to the walls of a square room, ray i from pose i (n, 3)."""
    n = len(poses)
    angles = -math.pi + 2 * math.pi / n * np.arange(n) + poses[:, 2]
    x = poses[:, 0] + lidar * np.cos(poses[:, 2])
    y = poses[:, 1] + lidar * np.sin(poses[:, 2])
    with np.errstate(divide="ignore"):
        to_x = (half * np.sign(np.cos(angles)) - x) / np.cos(angles)
        to_y = (half * np.sign(np.sin(angles)) - y) / np.sin(angles)
    return np.minimum(np.abs(to_x), np.abs(to_y))


def test_cells_are_where_they_should_be() -> None:
    grid = OccupancyGrid(resolution=0.5, origin=np.array([-1.0, 2.0]), log_odds=np.zeros((4, 6)))
    np.testing.assert_array_equal(cells_of(np.array([-0.9, 2.1]), grid), [0, 0])
    np.testing.assert_array_equal(cells_of(np.array([[0.6, 2.9], [-1.1, 2.0]]), grid),
                                  [[1, 3], [0, -1]])  # fmt: skip


def test_one_ray_frees_the_cells_before_its_end_and_fills_the_last() -> None:
    scan = replace(scan_of([1.02]), angle_min=0.0)
    grid = with_scan(empty_grid(P), scan, np.array([[0.01, 0.01, 0.0]]), P)
    row = grid.log_odds[cells_of(np.array([0.01, 0.01]), grid)[0]]
    first = int(cells_of(np.array([0.01, 0.01]), grid)[1])
    np.testing.assert_allclose(row[first : first + 20], P.miss)
    assert row[first + 20] == pytest.approx(P.hit)
    assert np.count_nonzero(grid.log_odds) == 21


@pytest.mark.parametrize("angle", [0.3, 1.1, 2.5, -0.7, -2.9])
def test_a_slanting_ray_frees_the_cells_that_it_crosses(angle: float) -> None:
    scan = replace(scan_of([2.0]), angle_min=0.0)
    start = np.array([0.013, -0.021])
    grid = with_scan(empty_grid(P), scan, np.array([[*start, angle]]), P)
    direction = np.array([math.cos(angle), math.sin(angle)])
    # Looked at finely, all but what it crosses by less than a step is free; and nothing else.
    fine = start + np.arange(0, 1.97, 0.0005)[:, None] * direction
    crossed, lengths = np.unique(cells_of(fine, grid), axis=0, return_counts=True)
    free = {tuple(cell) for cell in np.argwhere(grid.log_odds < 0)}
    assert free <= {tuple(cell) for cell in crossed}
    long = crossed[lengths * 0.0005 > P.resolution / 2 + 0.001]
    hit = tuple(cells_of(start + 2.0 * direction, grid))
    assert {tuple(cell) for cell in long} - {hit} <= free


def test_a_cell_changes_at_most_once_a_scan_and_a_hit_counts_more() -> None:
    # 360 rays pass through the cell of the lidar, many hit the near wall.
    scan = scan_of(np.full(360, 0.4))
    grid = with_scan(empty_grid(P), scan, rays_at([0.02, 0.02, 0.0], scan), P)
    for value in np.unique(grid.log_odds):
        assert any(value == pytest.approx(x) for x in (0.0, P.miss, P.hit))
    assert value_at(grid, 0.02, 0.02) == pytest.approx(P.miss)
    assert value_at(grid, 0.42, 0.02) == pytest.approx(P.hit)


def test_a_known_room_is_mapped() -> None:
    grid = empty_grid(P)
    for pose in ([0.0, 0.0, 0.3], [-1.0, 0.8, 2.0], [1.2, -1.1, -1.0]):
        poses = np.tile(pose, (360, 1))
        scan = scan_of(room(poses, half=2.025))  # the walls in the middle of their cells
        grid = with_scan(grid, scan, rays_at(pose, scan), P)
    y, x = np.indices(grid.log_odds.shape) * P.resolution + grid.origin[0] + P.resolution / 2
    inside = np.maximum(abs(x), abs(y)) < 1.95
    wall = (np.maximum(abs(x), abs(y)) > 1.99) & (np.maximum(abs(x), abs(y)) < 2.06)
    assert (grid.log_odds[inside] < 0).mean() > 0.99
    assert (grid.log_odds[inside] <= 0).all()
    assert (grid.log_odds[wall] > 0).mean() > 0.9
    assert not grid.log_odds[~inside & ~wall & (np.maximum(abs(x), abs(y)) > 2.06)].any()


def test_values_are_clamped_and_a_moved_obstacle_is_forgotten() -> None:
    near, far = scan_of(np.full(360, 1.0)), scan_of(np.full(360, 2.0))
    rays = rays_at([0.02, 0.02, 0.0], near)
    grid = empty_grid(P)
    for _ in range(30):
        grid = with_scan(grid, near, rays, P)
    assert value_at(grid, 1.02, 0.02) == pytest.approx(P.most)
    assert value_at(grid, 0.5, 0.02) == pytest.approx(P.least)
    scans = 0
    while value_at(grid, 1.02, 0.02) > 0:
        grid = with_scan(grid, far, rays, P)
        scans += 1
    assert scans == math.ceil(P.most / -P.miss)  # 9: under two seconds of a lidar at 5.5 Hz


def test_what_failed_says_nothing_and_what_hit_nothing_frees_a_little() -> None:
    ranges = np.full(360, math.nan)
    ranges[180], ranges[270], ranges[90] = math.inf, 0.1, 20.0
    scan = scan_of(ranges)
    grid = with_scan(empty_grid(P), scan, rays_at([-2.9, 0.02, 0.0], scan), P)
    assert not (grid.log_odds > 0).any()
    assert value_at(grid, -2.9 + P.max_free_range - 0.1, 0.02) == pytest.approx(P.miss)
    assert value_at(grid, -2.9 + P.max_free_range + 0.1, 0.02) == 0
    assert np.count_nonzero(grid.log_odds) == round(P.max_free_range / P.resolution)


def test_a_hit_beyond_reach_frees_the_way_and_fills_nothing() -> None:
    ranges = np.full(360, math.nan)
    ranges[180] = 8.0
    scan = scan_of(ranges)
    grid = with_scan(empty_grid(P), scan, rays_at([0.02, 0.02, 0.0], scan), P)
    assert value_at(grid, 5.9, 0.02) == pytest.approx(P.miss)
    assert not (grid.log_odds > 0).any()


@pytest.mark.parametrize("point", [[4.2, 0.0], [-3.6, 0.1], [0.0, 9.0], [0.0, -3.01], [5.0, -5.0]])
def test_the_grid_grows_and_keeps_what_it_knew(point: list[float]) -> None:
    random = np.random.default_rng(0)
    grid = replace(empty_grid(P), log_odds=random.normal(size=(120, 120)).astype(np.float32))
    larger = grown(grid, np.array([point]), growth=1.0, max_side=60.0)
    row, column = cells_of(np.array(point), larger)
    assert 0 <= row < larger.log_odds.shape[0]
    assert 0 <= column < larger.log_odds.shape[1]
    for x, y in random.uniform(-3, 3, (100, 2)):
        assert value_at(larger, x, y) == value_at(grid, x, y)
    assert np.count_nonzero(larger.log_odds) == np.count_nonzero(grid.log_odds)
    assert grown(larger, np.array([point]), growth=1.0, max_side=60.0) is larger


def test_the_grid_does_not_grow_for_ever() -> None:
    with pytest.raises(ValueError, match=r"longer than 60\.0 m"):
        grown(empty_grid(P), np.array([[1e6, 0.0]]), growth=1.0, max_side=60.0)


def test_what_counts_as_too_fast() -> None:
    trail = empty_trail(duration=1.0, rate=10.0)
    for k in range(10):
        trail = remember(trail, k / 10, np.array([0.02 * k, 0.0, 0.05 * k]))
    limits = {"max_speed": 0.3, "max_turn_rate": 0.6}
    assert not moved_too_fast(trail, 0.12, 0.3, **limits)
    assert moved_too_fast(trail, 0.12, 0.3, max_speed=0.1, max_turn_rate=0.6)
    assert moved_too_fast(trail, 0.12, 0.3, max_speed=0.3, max_turn_rate=0.4)
    trail[5, 1] += 0.1  # a jump, and back
    assert moved_too_fast(trail, trail[5, 0] - 0.05, trail[5, 0] + 0.02, **limits)


# --- The block ---

LIDAR = [0.05, 0.0, 0.0]


class Rig:
    def __init__(self, **parameters: Any) -> None:
        self.mapper = OccupancyMapper(
            lidar_pose=LIDAR, parameters=OccupancyParameters(**parameters), rate=20.0
        )
        self.simulator = Simulator(self.mapper)
        self.context = self.simulator.get_mutable_context()

    def look(
        self, t: float, scan: Scan, pose: Any = (0.0, 0.0, 0.0), covariance: Any = GOOD
    ) -> OccupancyGrid:
        """The grid at time t."""
        self.mapper.scan_input_port().FixValue(self.context, AbstractValue.Make(scan))
        self.mapper.pose_input_port().FixValue(self.context, np.array(pose, float))
        self.mapper.covariance_input_port().FixValue(self.context, np.ravel(covariance))
        self.simulator.AdvanceTo(t)
        grid: OccupancyGrid = self.mapper.grid_output_port().Eval(self.context)
        return grid

    @property
    def counts(self) -> dict[str, int]:
        counts = self.mapper.health_output_port().Eval(self.context).counts
        return {reason: number for reason, number in counts.items() if number}


def test_before_the_first_scan_nothing_is_known() -> None:
    rig = Rig()
    grid = rig.look(0.21, Scan())
    assert math.isnan(grid.stamp)
    assert grid.log_odds.shape == (120, 120)
    assert not grid.log_odds.any()
    assert rig.counts == {}


def test_each_scan_is_used_once() -> None:
    rig = Rig()
    scan = scan_of(np.full(360, 1.02))
    once = rig.look(0.01, scan)
    assert once.stamp == 0.0
    assert value_at(once, 1.06, 0.01) == pytest.approx(P.hit)
    again = rig.look(0.31, scan)
    assert again is once
    assert value_at(rig.look(0.36, replace(scan, stamp=0.34)), 1.06, 0.01) == pytest.approx(
        2 * P.hit
    )


@pytest.mark.parametrize("motion", [[0.3, 0.9], [0.0, 0.95], [0.5, -0.5]])
def test_a_scan_made_on_the_move_is_straight(motion: list[float]) -> None:
    v, omega = motion
    rig = Rig()

    def pose(t: Any) -> np.ndarray:
        x = v / omega * np.sin(omega * t)
        y = v / omega * (1 - np.cos(omega * t))
        return np.stack([x, y, 3.0 + omega * t + 0 * x], axis=-1)  # theta passes pi

    def on_port(t: float) -> np.ndarray:
        return np.array([*pose(t)[:2], math.remainder(pose(t)[2], 2 * math.pi)])

    for k in range(21):
        rig.look(k * 0.05 + 0.01, Scan(), on_port(k * 0.05))
    stamp, increment = 0.80, 0.18 / 360
    times = stamp + increment * np.arange(360)
    ranges = room(pose(times), half=2.025, lidar=LIDAR[0])
    grid = rig.look(1.06, scan_of(ranges, stamp, increment), on_port(1.05))
    assert rig.counts == {}
    filled = np.argwhere(grid.log_odds > 0)
    centres = (filled[:, ::-1] + 0.5) * grid.resolution + grid.origin
    # Every hit is in a cell of the walls.
    assert len(centres) > 150
    np.testing.assert_allclose(np.abs(centres).max(axis=1), 2.025, atol=0.026)
    # Taken as if from where it stands now, they would be elsewhere.
    wrong = with_scan(empty_grid(P), scan_of(ranges), rays_at(pose(1.05), scan_of(ranges)), P)
    filled = np.argwhere(wrong.log_odds > 0)
    centres = (filled[:, ::-1] + 0.5) * grid.resolution + grid.origin
    assert np.abs(np.abs(centres).max(axis=1) - 2.025).max() > 0.1


@pytest.mark.parametrize(
    "covariance",
    [
        np.diag([0.03, 0.0, 0.0]),
        np.diag([0.0, 0.0, 0.02]),
        [[0.015, 0.014, 0], [0.014, 0.015, 0], [0, 0, 1e-4]],  # 17 cm along a diagonal
        np.diag([1e6, 1e6, 1e6]),
        np.diag([math.nan, 0.0, 0.0]),
        np.diag([-1.0, 0.0, 0.0]),
    ],
)
def test_while_lost_no_scan_is_used(covariance: Any) -> None:
    rig = Rig()
    grid = rig.look(0.01, scan_of(np.full(360, 1.0)), covariance=covariance)
    assert math.isnan(grid.stamp)
    assert rig.counts == {"lost": 1}
    rig.look(0.31, scan_of(np.full(360, 1.0)))
    assert rig.counts == {"lost": 1}  # it is not used later either
    assert rig.look(0.36, scan_of(np.full(360, 1.0), stamp=0.34)).stamp == 0.34


def test_bad_samples_are_dropped_and_counted() -> None:
    rig = Rig()
    good = scan_of(np.full(360, 1.0))
    grid = rig.look(0.01, good)
    for t, scan, reason in (
        (0.06, replace(good, stamp=0.051, ranges=np.full(360, math.nan)), "garbled_scan"),
        (0.11, replace(good, stamp=-5.0), "stale_scan"),
        (0.16, replace(good, stamp=9.0), "stale_scan"),
    ):
        before = rig.counts.get(reason, 0)
        assert rig.look(t, scan) is grid
        assert rig.counts[reason] == before + 1
    assert rig.look(0.21, replace(good, stamp=0.19), (math.nan, 0.0, 0.0)) is grid
    assert rig.counts["bad_pose"] == 2  # the pose, and a scan that it does not reach to
    assert rig.look(0.26, replace(good, stamp=0.22), (0.5, 0.0, 0.0)) is grid  # a jump
    assert rig.counts["too_fast"] == 1
    for t in (0.31, 0.36, 0.41):
        rig.look(t, Scan(), (0.5, 0.0, 0.0))
    assert rig.look(0.46, replace(good, stamp=0.45), (0.5, 0.0, 0.0)) is not grid
    assert sum(rig.counts.values()) == 6


def test_a_robot_that_leaves_takes_the_grid_with_it_as_far_as_is_allowed() -> None:
    rig = Rig(max_side=20.0)
    good = scan_of(np.full(360, 1.0))
    assert rig.look(0.01, good, (9.0, -4.0, 0.0)).log_odds.shape == (160, 280)
    for t in (0.26, 0.51, 0.76):
        rig.look(t, Scan(), (1e7, 0.0, 0.0))
    rig.look(0.81, replace(good, stamp=0.79), (1e7, 0.0, 0.0))
    assert rig.counts["out_of_bounds"] == 1


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("resolution", 0.0),
        ("hit", -0.1),
        ("miss", 0.1),
        ("least", math.nan),
        ("extent", [0.0, 0.0, -1.0, 1.0]),
        ("extent", [0.0, 0.0, 1.0]),
        ("extent", [0.0, 0.0, 100.0, 1.0]),
        ("max_scan_age", math.inf),
    ],
)
def test_parameters_out_of_range_are_refused(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{field} is "):
        OccupancyParameters(**{field: value})


def test_a_lidar_pose_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="lidar_pose is"):
        OccupancyMapper(lidar_pose=[0.0, math.nan, 0.0])
