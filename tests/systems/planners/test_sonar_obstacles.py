"""Obstacles from the range finders of several robots: grid, rectangles, block."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import Box, Cylinder
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from systems.messages import Scan
from systems.planners.formation_obstacles import Obstacles, clearance
from systems.planners.sonar_grid import (
    Cones,
    SonarGrid,
    SonarGridParameters,
    empty_sonar_grid,
    rectangles,
    with_cones,
)
from systems.planners.sonar_obstacles import (
    RingGeometry,
    SonarObstacles,
    SonarTrustParameters,
    cones_of,
    known_from_others,
)
from systems.raycasting import Solids
from systems.sensors.ultrasonic import UltrasonicParameters, true_ranges

Array = NDArray[np.float64]

GRID = SonarGridParameters(extent=[-3.0, -3.0, 5.0, 4.0])
RING = UltrasonicParameters(sensors=24, offset=0.12, range_max=2.6)
GEOMETRY = RingGeometry(np.zeros(3), RING.offset, RING.half_angle)
HEIGHT = 0.35


def one_cone(face: Any, direction: float, free: float, echo: float = math.nan) -> Cones:
    """A single range finder with a cone of 15 degrees."""
    return Cones(
        np.array([face], float),
        np.array([direction]),
        np.array([math.radians(7.5)]),
        np.array([free]),
        np.array([echo]),
    )


def middles(known: SonarGrid) -> tuple[Array, Array]:
    """Returns x and y of the cells' middles, each of the grid's shape."""
    rows, columns = known.occupied.shape
    g = known.grid
    x = g.origin[0] + (np.arange(columns) + 0.5) * g.resolution
    y = g.origin[1] + (np.arange(rows) + 0.5) * g.resolution
    return tuple(np.meshgrid(x, y))  # type: ignore[return-value]


def listen(known: SonarGrid, cones: Cones, times: int) -> SonarGrid:
    for k in range(times):
        known = with_cones(known, cones, float(k), GRID)
    return known


def test_an_echo_is_an_arc_as_wide_as_the_cone_and_the_sector_before_it_is_free() -> None:
    known = listen(empty_sonar_grid(GRID), one_cone([0, 0], 0.0, 1.87, 2.0), 3)
    x, y = middles(known)
    away, aside = np.hypot(x, y), np.abs(np.arctan2(y, x))
    inside = aside <= math.radians(7.5)
    np.testing.assert_array_equal(known.occupied, inside & (np.abs(away - 2.0) < 0.05))
    np.testing.assert_array_equal(known.grid.log_odds < 0, inside & (away <= 1.87))
    # 2 * 2 m * sin(7.5 degrees) = 0.52 m wide: nothing tells where on it the thing stands.
    assert np.ptp(y[known.occupied]) == pytest.approx(0.52, abs=0.1)


def test_who_hears_through_a_part_of_the_arc_takes_it_back() -> None:
    """A post at (2, 0.2), an echo for the first; the second hears past it, along y = -0.1."""
    post = listen(empty_sonar_grid(GRID), one_cone([0, 0], 0.0, 1.87, 2.01), 3)
    past = listen(post, one_cone([2.9, -0.12], math.pi, 1.5), 2)
    x, y = middles(past)
    gone = post.occupied & ~past.occupied
    assert gone.any()
    assert (y[gone] < 0.05).all()
    assert past.occupied[(np.abs(x - 2.0) < 0.06) & (np.abs(y - 0.2) < 0.06)].any()
    # In whatever order, and time after time.
    again = post
    for k in range(20):
        again = with_cones(again, one_cone([0, 0], 0.0, 1.87, 2.01), float(k), GRID)
        again = with_cones(again, one_cone([2.9, -0.12], math.pi, 1.5), float(k), GRID)
    np.testing.assert_array_equal(again.occupied, past.occupied)


def test_an_echo_that_is_lost_now_and_then_makes_no_hole() -> None:
    heard, lost = one_cone([0, 0], 0.0, 1.87, 2.0), one_cone([0, 0], 0.0, 2.6)
    known = before = listen(empty_sonar_grid(GRID), heard, 5)
    for _ in range(5):
        known = with_cones(known, lost, 0.0, GRID)
        np.testing.assert_array_equal(known.occupied, before.occupied)
        known = listen(known, heard, 4)
    # What has gone is forgotten in the end.
    assert not listen(known, lost, 4).occupied.any()


def test_the_grid_grows_and_keeps_what_it_knows() -> None:
    known = listen(empty_sonar_grid(GRID), one_cone([0, 0], 0.0, 1.87, 2.0), 3)
    larger = with_cones(known, one_cone([-6, -5], 0.0, 1.0, 1.1), 9.0, GRID)
    assert larger.occupied.shape > known.occupied.shape
    before = rectangles(known, 100)
    np.testing.assert_allclose(rectangles(larger, 100), before, atol=1e-9)
    with pytest.raises(ValueError, match="longer than 100"):
        with_cones(known, one_cone([200, 0], 0.0, 1.0), 0.0, GRID)


@pytest.mark.parametrize("share", [0.05, 0.4, 0.8])
def test_rectangles_cover_the_occupied_cells_and_nothing_else(share: float) -> None:
    random = np.random.default_rng(3)
    known = empty_sonar_grid(GRID)
    occupied = random.random(known.occupied.shape) < share
    known = SonarGrid(known.grid, occupied)
    x, y = middles(known)

    def covered(boxes: Array) -> Array:
        times = np.zeros(occupied.shape, int)
        for box in boxes:
            low, high = box.min(axis=0), box.max(axis=0)
            times += (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])
        return times

    boxes = rectangles(known, 10_000)
    np.testing.assert_array_equal(covered(boxes), occupied)
    assert len(boxes) <= occupied.sum()
    few = rectangles(known, 12)
    assert len(few) <= 12
    assert (covered(few)[occupied] == 1).all()
    # Counterclockwise: the shoelace formula gives positive areas.
    after = np.roll(boxes, -1, axis=1)
    areas = (boxes[..., 0] * after[..., 1] - boxes[..., 1] * after[..., 0]).sum(axis=1) / 2
    assert (areas > 0).all()


def test_a_wall_of_cells_is_one_rectangle() -> None:
    known = empty_sonar_grid(GRID)
    occupied = np.zeros(known.occupied.shape, bool)
    occupied[4:9, 10:30] = True
    (box,) = rectangles(SonarGrid(known.grid, occupied), 50)
    np.testing.assert_allclose(box, [[-2, -2.6], [0, -2.6], [0, -2.1], [-2, -2.1]], atol=1e-9)
    assert len(rectangles(known, 50)) == 0


# --- Robots ---

ROBOT = (Box(0.26, 0.22, 0.3), 0.15)
POSES = np.array([[0.0, 0.0, 0.3], [1.5, 0.0, -1.0], [0.75, 1.3, 2.0]])


def heard_by(robot: int, obstacles: list[tuple[Any, RigidTransform]]) -> Array:
    """Returns the exact ranges of a robot among obstacles and the other robots."""
    shapes, poses = [shape for shape, _ in obstacles], [X for _, X in obstacles]
    for k, (x, y, _) in enumerate(POSES):
        if k != robot:
            shapes.append(ROBOT[0])
            poses.append(RigidTransform([x, y, ROBOT[1]]))
    x, y, theta = POSES[robot]
    c, s = math.cos(theta), math.sin(theta)
    X_WU = RigidTransform(np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, HEIGHT]]))
    return true_ranges(Solids(shapes, poses), X_WU, RING)


def scan_of(ranges: Array, stamp: float = 0.0) -> Scan:
    return Scan(
        stamp=stamp,
        angle_min=0.0,
        angle_increment=2 * math.pi / RING.sensors,
        range_min=RING.range_min,
        range_max=RING.range_max,
        ranges=ranges,
    )


def test_robots_are_no_obstacles() -> None:
    scan = scan_of(heard_by(0, []))
    assert np.isfinite(scan.ranges).sum() >= 2  # it does hear them
    radii = np.full(2, 0.3)
    cones, counts = cones_of(scan, POSES[0], GEOMETRY, POSES[1:, :2], radii, GRID)
    assert np.isnan(cones.echoes).all()
    assert counts["on_robot"] == np.isfinite(scan.ranges).sum()
    # Of another place they would be.
    cones, counts = cones_of(scan, POSES[0], GEOMETRY, POSES[1:, :2] + 1.0, radii, GRID)
    assert np.isfinite(cones.echoes).any()


def test_readings_that_are_none_say_nothing() -> None:
    ranges = np.full(24, np.inf)
    ranges[:4] = [math.nan, 2.7, 0.01, 1.0]
    cones, counts = cones_of(
        scan_of(ranges), POSES[0], GEOMETRY, np.zeros((0, 2)), np.zeros(0), GRID
    )
    assert counts["bad_reading"] == 3
    np.testing.assert_array_equal(cones.free[:3], 0.0)
    assert cones.free[3] == pytest.approx(1.0 - 0.05 - 0.03)
    np.testing.assert_array_equal(cones.free[4:], 2.6)
    np.testing.assert_array_equal(np.isfinite(cones.echoes), np.arange(24) == 3)


def test_an_echo_from_far_away_only_says_what_is_free() -> None:
    ranges = np.full(24, np.inf)
    ranges[:2] = [GRID.max_echo_range - 0.01, GRID.max_echo_range + 0.01]
    cones, counts = cones_of(
        scan_of(ranges), POSES[0], GEOMETRY, np.zeros((0, 2)), np.zeros(0), GRID
    )
    np.testing.assert_array_equal(np.isfinite(cones.echoes), np.arange(24) == 0)
    np.testing.assert_allclose(cones.free[:2], ranges[:2] - 0.08)
    assert not any(counts.values())


def test_what_is_known_is_counted_from_the_nearest_known_robot() -> None:
    """All have drifted by a metre together; the third is known to 0.2 m, by x, from them."""
    drift = np.tile(np.diag([1.0, 1.0, 0.01]), (3, 3))
    own = np.diag([1e-4, 1e-4, 1e-6] * 2 + [0.04, 1e-4, 1e-2])
    known = known_from_others(drift + own)
    np.testing.assert_allclose(known[:2], [[math.sqrt(2e-4), math.sqrt(2e-6)]] * 2, rtol=1e-6)
    np.testing.assert_allclose(known[2], [math.sqrt(0.0401), math.sqrt(1.0001e-2)], rtol=1e-3)
    assert np.isinf(known_from_others(np.full((6, 6), math.nan))).all()


class World:
    """The block, told scans by hand."""

    def __init__(self, **arguments: Any) -> None:
        self.block = SonarObstacles(
            robots=3,
            offset=RING.offset,
            half_angle=RING.half_angle,
            parameters=GRID,
            rate=1.0,
            **arguments,
        )
        self.simulator = Simulator(self.block)
        self.context = self.simulator.get_mutable_context()
        self.tell(poses=POSES.ravel())
        for k in range(3):
            self.scan(k, Scan())
        self.looks = 0

    def tell(self, **values: Any) -> None:
        for port, value in values.items():
            self.block.GetInputPort(port).FixValue(self.context, value)

    def scan(self, robot: int, scan: Scan) -> None:
        self.block.scan_input_port(robot).FixValue(self.context, AbstractValue.Make(scan))

    def look(self) -> Obstacles:
        """Looks once, at 0 s, 1 s, ..."""
        self.simulator.AdvanceTo(self.looks + 0.5)
        self.looks += 1
        found: Obstacles = self.block.obstacles_output_port().Eval(self.context)
        return found

    def hear(self, obstacles: list[tuple[Any, RigidTransform]], times: int) -> Obstacles:
        """Lets all robots listen some times."""
        for _ in range(times):
            for k in range(3):
                self.scan(k, scan_of(heard_by(k, obstacles), float(self.looks)))
            found = self.look()
        return found

    @property
    def health(self) -> dict[str, int]:
        counts = self.block.health_output_port().Eval(self.context).counts
        return {reason: number for reason, number in counts.items() if number}


BOX = (Box(0.4, 0.6, 0.5), RigidTransform([2.4, 1.2, 0.25]))
POST = (Cylinder(0.1, 0.5), RigidTransform([-0.6, 0.9, 0.25]))


def test_three_robots_find_a_box_and_a_post_where_they_are() -> None:
    world = World()
    assert math.isnan(world.look().stamp)
    found = world.hear([BOX, POST], 5)
    assert found.stamp <= world.looks - 1
    assert found.frame_id == "map"

    def is_free(x: float, y: float, room: float = 0.0) -> bool:
        place = np.array([x, y])
        return clearance(found, place, place) > room

    # The sides that they hear are taken all along, to within a cell.
    for y in np.arange(0.9, 1.5, 0.05):
        assert not is_free(2.2, y, 0.1), y
    for angle in np.arange(-1.2, 0.9, 0.1):
        assert not is_free(-0.6 + 0.1 * math.cos(angle), 0.9 + 0.1 * math.sin(angle), 0.1), angle
    # Nothing is taken that is farther from either than half a cone is wide.
    middles = found.polygons.mean(axis=1)
    from_box = np.hypot(*np.maximum(np.abs(middles - [2.4, 1.2]) - [0.2, 0.3], 0.0).T)
    from_post = np.hypot(*(middles - [-0.6, 0.9]).T) - 0.1
    widest = GRID.max_echo_range * math.sin(RING.half_angle)
    assert np.minimum(from_box, from_post).max() < widest + 0.1
    # Robots, their triangle and what is well off are free: a cone is 0.5 m wide at 2 m.
    for x, y, _ in POSES:
        assert is_free(x, y, 0.3)
    for place in [(0.75, 0.5), (0.75, -1.2), (1.4, 1.9), (1.5, 0.8), (-0.8, -0.3), (0.1, 1.5)]:
        assert is_free(*place), place
    assert set(world.health) == {"on_robot"}


def test_the_message_is_the_same_one_for_as_long_as_nothing_changes() -> None:
    world = World()
    first = world.hear([BOX], 5)
    assert world.hear([BOX], 3) is first
    assert world.look() is first
    gone = world.hear([], 8)
    assert gone is not first
    assert len(gone) == 0
    assert world.hear([BOX], 8) is not gone


def test_a_scan_counts_once_and_one_that_is_no_good_never() -> None:
    world = World()
    world.scan(0, scan_of(heard_by(0, [BOX, POST]), 0.0))
    for _ in range(3):
        assert len(world.look()) == 0  # one hit is not enough, however often it is looked at
    assert set(world.health) == {"on_robot"}
    world.scan(0, scan_of(heard_by(0, [POST]), 2.0))
    world.look()  # at 3 s
    assert world.health["stale_scan"] == 1
    world.scan(0, scan_of(np.full(24, math.nan), 4.0))
    world.look()
    assert world.health["garbled_scan"] == 1
    world.tell(poses=np.full(9, math.nan))
    world.scan(0, scan_of(heard_by(0, [POST]), 5.0))
    world.look()
    assert world.health["bad_pose"] == 1
    world.tell(poses=(POSES + np.array([500.0, 0.0, 0.0])).ravel())
    world.scan(0, scan_of(heard_by(0, [POST]), 6.0))
    assert len(world.look()) == 0
    assert world.health["out_of_bounds"] == 1


def test_a_robot_that_is_lost_or_turns_is_not_listened_to() -> None:
    world = World()
    world.tell(moving=[1.0, 0.0, 0.0])
    for _ in range(5):
        world.scan(0, scan_of(heard_by(0, [POST]), float(world.looks)))
        assert len(world.look()) == 0
    assert world.health["lost"] == 5
    turned = POSES.copy()
    turned[0, 2] += 0.2  # in a second
    world.tell(moving=np.zeros(3), poses=turned.ravel())
    world.scan(0, scan_of(heard_by(0, [POST]), 5.0))
    world.look()
    assert world.health["turning"] == 1
    # Who moves and is known well is listened to.
    world.tell(moving=[1.0, 0.0, 0.0], poses=POSES.ravel(), covariance=np.eye(9).ravel() * 1e-6)
    world.look()
    for _ in range(3):
        world.scan(0, scan_of(heard_by(0, [POST]), float(world.looks)))
        found = world.look()
    assert len(found) > 0


def test_where_a_lost_robot_may_be_nothing_is_an_obstacle() -> None:
    world = World()
    deviations = np.diag([1e-6] * 6 + [1.0, 1.0, 1e-6])
    world.tell(covariance=deviations.ravel())
    for _ in range(5):
        world.scan(0, scan_of(heard_by(0, [POST]), float(world.looks + 1)))
        found = world.look()
    assert len(found) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"robots": 1}, "robots is 1"),
        ({"robots": 3, "offset": -1.0}, "offset is -1"),
        ({"robots": 3, "half_angle": 2.0}, "half_angle is 2"),
        ({"robots": 3, "ring_pose": [0.0, 0.0]}, "ring_pose"),
        ({"robots": 3, "rate": 0.0}, "rate is 0"),
    ],
)
def test_nonsense_is_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SonarObstacles(**arguments)


@pytest.mark.parametrize(
    "values",
    [
        {"miss": -0.4},
        {"occupied": 3.0},
        {"free": -2.0},
        {"extent": [0.0, 0.0, 0.0, 1.0]},
        {"max_shapes": 0},
        {"resolution": 0.0},
        {"margin": -0.1},
    ],
)
def test_parameters_of_nonsense_are_refused(values: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(values))):
        SonarGridParameters(**values)
    with pytest.raises(ValueError, match="max_turn_rate"):
        SonarTrustParameters(max_turn_rate=0.0)
