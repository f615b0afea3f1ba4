from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator

from systems.controllers.braking import (
    CollisionMonitorParameters,
    are_safe,
    clearance,
    stopping_paths,
)
from systems.controllers.collision_monitor import (
    CollisionMonitor,
    move,
    safe_command,
    still_hidden,
)
from systems.messages import Scan

HULL = [0.11, 0.11, 0.093]
LIDAR = [0.02, 0.0, 0.3]
P = CollisionMonitorParameters()
STAND = np.zeros(2)
CORNER = math.hypot(0.11, 0.093)


def pass_on(command: Any, points: Any, sent: Any = STAND) -> tuple[np.ndarray, float]:
    """What becomes of a command; the wheels already do what they were told."""
    points = np.asarray(points, float).reshape(-1, 2)
    sent = np.array(sent, float)
    return safe_command(np.array(command, float), sent, sent, points, np.array(HULL), P)


def wall(distance: float, direction: float, length: float = 2.0) -> np.ndarray:
    """Points of a straight wall whose nearest one is at that distance and direction."""
    along = np.arange(-length / 2, length / 2, 0.005)
    c, s = math.cos(direction), math.sin(direction)
    return np.stack([distance * c - along * s, distance * s + along * c], axis=-1)


# --- The pieces ---


@pytest.mark.parametrize(
    ("point", "distance"),
    [
        ([0.21, 0.0], 0.1),
        ([-0.35, 0.05], 0.24),
        ([0.0, -0.103], 0.01),
        ([0.14, 0.133], 0.05),  # 3, 4, 5 from the corner
        ([0.3, 0.093], 0.1),
        ([0.1, 0.0], -0.1),
        ([0.0, 0.05], -0.043),
    ],
)
def test_clearance_of_the_rectangle(point: list[float], distance: float) -> None:
    hull = np.array([0.2, 0.05, 0.093]) if point == [0.3, 0.093] else np.array(HULL)
    if point == [0.1, 0.0]:
        hull = np.array([0.3, 0.0001, 0.2])
        distance = -0.1001
    assert clearance(np.array(point), hull) == pytest.approx(distance)


def test_driving_along_an_arc_ends_on_the_circle() -> None:
    pose = np.array([1.0, 2.0, 0.5])
    ahead = move(pose, np.array([0.4, 0.0]), 2.0)
    np.testing.assert_allclose(ahead, [1 + 0.8 * math.cos(0.5), 2 + 0.8 * math.sin(0.5), 0.5])
    # Half a circle of radius 0.5 m to the left.
    back = move(pose, np.array([0.5, 1.0]), math.pi)
    np.testing.assert_allclose(
        back, [1 - math.sin(0.5), 2 + math.cos(0.5), 0.5 + math.pi], atol=1e-12
    )


@pytest.mark.parametrize("v", [0.3, -0.2])
def test_the_way_to_a_stop_is_that_of_physics(v: float) -> None:
    # Reaction and slowdown at v, then v^2 / 2a.
    path = stopping_paths(np.array([[v, 0.0]]), *[np.array([v, 0.0])] * 2, P)[0]
    expected = abs(v) * (P.reaction_time + P.slowdown_time) + v**2 / (2 * P.deceleration)
    assert abs(path[-1, 0]) == pytest.approx(expected, abs=1e-3)
    assert not path[:, 1:].any()
    # From standing: it must gain the speed first, at the same rate.
    path = stopping_paths(np.array([[v, 0.0]]), STAND, STAND, P)[0]
    assert abs(path[-1, 0]) == pytest.approx(abs(v) * P.slowdown_time, abs=2e-3)


def test_the_way_to_a_stop_turns_as_integrated_step_by_step() -> None:
    command, sent, held = np.array([0.25, -1.2]), np.array([0.1, 1.5]), np.array([0.2, 1.0])
    change, dt = np.array([P.deceleration, P.turn_deceleration]), 1e-4
    pose, speed = np.zeros(3), sent.copy()
    for k in range(12000):
        t = k * dt
        phase = (t >= P.reaction_time) + (t >= P.reaction_time + P.slowdown_time)
        target = (held, command, STAND)[phase]
        speed = speed + np.clip(target - speed, -change * dt, change * dt)
        pose = move(pose, speed, dt)
    path = stopping_paths(command[None], sent, held, P)[0]
    np.testing.assert_allclose(path[-1], pose, atol=3e-3)


# --- What is passed on ---


def test_with_nothing_near_every_command_passes_as_it_is() -> None:
    random = np.random.default_rng(0)
    far = random.uniform(-3, 3, (400, 2))
    far = far[np.hypot(*far.T) > 0.6]
    for command, sent in random.uniform([-0.3, -2.0], [0.3, 2.0], (100, 2, 2)):
        for points in (far, np.zeros((0, 2))):
            allowed, scale = pass_on(command, points, sent)
            assert scale == 1.0
            np.testing.assert_array_equal(allowed, command)


def test_before_a_wall_it_slows_down_and_stops_at_the_margin() -> None:
    scales = [pass_on([0.3, 0.0], wall(0.11 + gap, 0.0))[1] for gap in np.arange(0.3, 0.0, -0.01)]
    assert scales[0] == 1.0
    assert scales == sorted(scales, reverse=True)
    assert len(set(scales)) > 4
    assert pass_on([0.3, 0.0], wall(0.11 + P.margin, 0.0))[1] == 0.0
    # Where theory says: 0.3 m/s from standing, kept for the slowdown time.
    assert pass_on([0.3, 0.0], wall(0.11 + P.margin + 0.13, 0.0))[1] == 1.0
    assert pass_on([0.3, 0.0], wall(0.11 + P.margin + 0.11, 0.0))[1] < 1.0


def test_slowing_keeps_the_arc() -> None:
    allowed, scale = pass_on([0.3, 0.5], wall(0.25, 0.1))
    assert 0 < scale < 1
    np.testing.assert_allclose(allowed, [0.3 * scale, 0.5 * scale])


def test_what_counts_is_the_arc_and_not_what_is_ahead() -> None:
    pillar = [[0.3, 0.0]]
    assert pass_on([0.3, 0.0], pillar, [0.3, 0.0])[1] < 1
    assert pass_on([-0.3, 0.0], pillar, [-0.3, 0.0])[1] == 1
    assert pass_on([0.3, 0.0], [[0.3, 0.093 + P.margin + 0.01]], [0.3, 0.0])[1] == 1
    assert pass_on([0.3, 0.0], [[0.3, 0.093 + P.margin - 0.01]], [0.3, 0.0])[1] < 1
    # Beside the nose: the right turn leaves it alone, the left turn drives into it.
    beside = [[0.22, 0.17]]
    assert pass_on([0.25, -1.5], beside, [0.25, -1.5])[1] == 1
    assert pass_on([0.25, 1.5], beside, [0.25, 1.5])[1] < 1


@pytest.mark.parametrize("direction", np.arange(0, 2 * math.pi, 0.4))
@pytest.mark.parametrize("omega", [1.0, -1.0])
def test_beside_a_wall_it_may_turn_in_place_if_the_corners_pass(
    direction: float, omega: float
) -> None:
    free = wall(CORNER + 0.007, direction)  # less than the margin
    np.testing.assert_array_equal(pass_on([0.0, omega], free)[0], [0.0, omega])


def test_where_the_corners_do_not_pass_it_turns_only_as_far_as_they_do() -> None:
    beside = wall(0.093 + 0.02, math.pi / 2)
    pose, turned = np.zeros(3), 0.0
    for _ in range(100):
        points = (beside - pose[:2]) @ np.array(
            [[math.cos(turned), -math.sin(turned)], [math.sin(turned), math.cos(turned)]]
        )
        turned += 0.05 * pass_on([0.0, 1.0], points)[0][1]
    # A corner at the angle b turned by a reaches R sin(a + b): up to the wall less the margin.
    b = math.atan2(0.093, 0.11)
    most = math.asin((0.113 - P.contact_margin) / CORNER) - b
    assert 0.5 * most < turned <= most + 1e-3


def test_a_command_that_only_its_turn_can_obey_turns_in_place() -> None:
    allowed, scale = pass_on([0.3, 1.0], wall(0.11 + 0.055, 0.0))
    assert scale == 0.0
    np.testing.assert_array_equal(allowed, [0.0, 1.0])


@pytest.mark.parametrize("gap", [-0.02, 0.0, 0.002, 0.02, 0.05])
def test_away_from_what_is_too_near_it_may_drive_and_toward_it_not(gap: float) -> None:
    ahead, behind = wall(0.11 + gap, 0.0), wall(0.11 + gap, math.pi)
    assert pass_on([-0.3, 0.0], ahead)[1] == 1.0
    assert pass_on([0.3, 0.0], behind)[1] == 1.0
    assert not pass_on([0.3, 0.0], ahead)[0].any()
    assert not pass_on([-0.3, 0.0], behind)[0].any()


@pytest.mark.parametrize("gap", [0.01, 0.03, 0.05])
def test_along_a_wall_inside_the_margin_it_may_go_on_but_not_nearer(gap: float) -> None:
    beside = wall(0.093 + gap, math.pi / 2)
    assert pass_on([0.2, 0.0], beside)[1] == 1.0
    assert pass_on([0.2, 0.3], beside)[1] < 1.0


def test_while_it_still_drives_ahead_it_does_not_count_on_reversing_at_once() -> None:
    ahead = wall(0.11 + 0.03, 0.0)
    hull, speed = np.array(HULL), np.array([0.3, 0.0])
    reverse = np.array([[-0.3, 0.0]])
    assert are_safe(reverse, STAND, STAND, ahead, hull, P)[0]
    assert not are_safe(reverse, speed, speed, ahead, hull, P)[0]


# --- The blind zone ---


def scan_of(ranges: np.ndarray, stamp: float = 0.0) -> Scan:
    n = len(ranges)
    return Scan(
        stamp=stamp,
        angle_min=-math.pi,
        angle_increment=2 * math.pi / n,
        time_increment=0.18 / n,
        range_min=0.15,
        range_max=12.0,
        ranges=np.asarray(ranges, float),
    )


def test_what_is_too_near_to_be_seen_is_remembered_until_a_ray_passes() -> None:
    ranges = np.full(360, math.inf)
    scan = scan_of(ranges)
    rays = np.stack([np.zeros(360), np.zeros(360), scan.angles], axis=-1)
    point = np.array([[0.12, 0.0]])
    np.testing.assert_array_equal(still_hidden(point, scan, rays), point)
    ranges = ranges.copy()
    ranges[170] = 2.0  # another direction
    np.testing.assert_array_equal(still_hidden(point, scan_of(ranges), rays), point)
    ranges = ranges.copy()
    ranges[180] = 2.0
    assert len(still_hidden(point, scan_of(ranges), rays)) == 0
    assert len(still_hidden(np.array([[0.16, 0.0]]), scan, rays)) == 0  # would be seen


# --- The block ---


class World:
    """Circles and segments, a robot that follows the drive's limits, and a lidar that turns."""

    def __init__(self, circles: np.ndarray, segments: np.ndarray, seed: int) -> None:
        self.circles, self.segments = circles, segments
        self.random = np.random.default_rng(seed)
        self.pose = np.zeros(3)
        self.sent = np.zeros(2)
        outline = []
        for x, y, r in circles:
            a = np.arange(0, 2 * math.pi, 0.01 / r)
            outline.append(np.stack([x + r * np.cos(a), y + r * np.sin(a)], axis=-1))
        for ax, ay, bx, by in segments:
            s = np.linspace(0, 1, math.ceil(math.hypot(bx - ax, by - ay) / 0.005) + 1)[:, None]
            outline.append(np.array([[ax, ay]]) * (1 - s) + np.array([[bx, by]]) * s)
        self.outline = np.concatenate(outline)

    def gap(self, pose: np.ndarray) -> float:
        """From the hull to the nearest obstacle."""
        c, s = math.cos(pose[2]), math.sin(pose[2])
        offset = self.outline - pose[:2]
        x = np.abs(offset[:, 0] * c + offset[:, 1] * s) - 0.11
        y = np.abs(offset[:, 1] * c - offset[:, 0] * s) - 0.093
        apart = np.where((x < 0) & (y < 0), np.maximum(x, y), np.hypot(x.clip(0), y.clip(0)))
        return float(apart.min())

    def ranges(self, poses: np.ndarray) -> np.ndarray:
        """What each ray measures from its own pose."""
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        o = poses[:, :2] + np.stack([c * LIDAR[0], s * LIDAR[0]], axis=-1)
        angle = -math.pi + 2 * math.pi / len(poses) * np.arange(len(poses))
        angle = angle + poses[:, 2] + LIDAR[2]
        d = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        found = np.full(len(poses), math.inf)
        for x, y, r in self.circles:
            m = np.array([x, y]) - o
            b = (m * d).sum(axis=1)
            q = b * b - (m * m).sum(axis=1) + r * r
            t = b - np.sqrt(np.maximum(q, 0))
            found = np.where((q > 0) & (t > 0), np.minimum(found, t), found)
        for ax, ay, bx, by in self.segments:
            e, m = np.array([bx - ax, by - ay]), np.array([ax, ay]) - o
            det = d[:, 0] * e[1] - d[:, 1] * e[0]
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (m[:, 0] * e[1] - m[:, 1] * e[0]) / det
                u = (m[:, 0] * d[:, 1] - m[:, 1] * d[:, 0]) / det
            hit = (t > 0) & (u >= 0) & (u <= 1)
            found = np.where(hit, np.minimum(found, t), found)
        return np.where(found < 0.15, math.inf, found)  # too near looks like nothing at all


class Rig:
    """The monitor between commands and a robot in a world, drive at 50 Hz, lidar at 5.5 Hz."""

    def __init__(self, world: World, rate: float = 20.0, **parameters: float) -> None:
        self.world = world
        self.monitor = CollisionMonitor(
            hull=HULL,
            lidar_pose=LIDAR,
            parameters=CollisionMonitorParameters(**parameters),
            rate=rate,
        )
        self.simulator = Simulator(self.monitor)
        self.context = self.simulator.get_mutable_context()
        self.command, self.scan = np.zeros(2), Scan()
        self.dt, self.k = 0.01, 0
        self.look_every = round(1 / (rate * self.dt))
        self.poses: list[np.ndarray] = []
        self.smallest_gap = math.inf

    @property
    def counts(self) -> Any:
        return self.monitor.health_output_port().Eval(self.context).counts

    @property
    def scale(self) -> float:
        return self.monitor.scale(self.context)

    def step(self) -> np.ndarray:
        """A hundredth of a second; returns what the monitor passes on."""
        world = self.world
        turn = 18  # steps
        self.poses.append(world.pose)
        if self.k % turn == turn - 1:
            t = np.arange(turn)
            times = np.linspace(0, turn - 1, 360)
            poses = np.array(self.poses[-turn:])
            at_rays = np.stack([np.interp(times, t, column) for column in poses.T], axis=-1)
            scan = scan_of(world.ranges(at_rays), stamp=(self.k - turn + 1) * self.dt)
            self.scan = replace(scan, time_increment=self.dt * (turn - 1) / 359)
        if self.k % self.look_every == 0:
            for port, value in (
                (self.monitor.command_input_port(), self.command),
                (self.monitor.scan_input_port(), AbstractValue.Make(self.scan)),
                (self.monitor.sent_input_port(), world.sent),
            ):
                port.FixValue(self.context, value)
            self.simulator.AdvanceTo(self.k * self.dt + 1e-4)
        allowed = self.monitor.command_output_port().Eval(self.context).copy()
        if self.k % 2 == 0:
            change = np.array([1.0, 10.0]) * 2 * self.dt
            world.sent = world.sent + np.clip(allowed - world.sent, -change, change)
        world.pose = move(world.pose, world.sent, self.dt)
        if self.k % 3 == 0:
            self.smallest_gap = min(self.smallest_gap, world.gap(world.pose))
        self.k += 1
        return allowed


def slab(start: np.ndarray, along: np.ndarray) -> list[list[float]]:
    """The four sides of a wall 5 cm thick; of a thin one a ray may meet neither side nor end."""
    across = 0.05 * np.array([-along[1], along[0]]) / np.hypot(*along)
    corners = [start, start + along, start + along + across, start + across]
    return [[*corners[k], *corners[(k + 1) % 4]] for k in range(4)]


def crowded(seed: int) -> World:
    """A room of 3 m with pillars and free-standing walls, the robot where nothing is too near."""
    random = np.random.default_rng(seed)
    circles = [[*random.uniform(-1.5, 1.5, 2), random.uniform(0.03, 0.2)] for _ in range(10)]
    corners = np.array([[-1.6, -1.6], [1.6, -1.6], [1.6, 1.6], [-1.6, 1.6]])
    segments = [[*corners[k], *corners[(k + 1) % 4]] for k in range(4)]
    for _ in range(4):
        segments += slab(random.uniform(-1.5, 1.5, 2), random.uniform(-0.8, 0.8, 2))
    world = World(np.array(circles), np.array(segments), seed)
    while world.gap(world.pose) < 0.1:  # to be seen at all
        world.pose = random.uniform([-1.4, -1.4, -3.1], [1.4, 1.4, 3.1])
    return world


def reckless(rig: Rig, random: np.random.Generator) -> np.ndarray:
    """A command at random, or one at full speed toward the nearest obstacle."""
    if random.integers(2):
        command = random.uniform([-0.15, -1.5], [0.3, 1.5])
        command[int(random.integers(2))] *= random.integers(2)
        return command
    offset = rig.world.outline - rig.world.pose[:2]
    dx, dy = offset[np.argmin(np.hypot(*offset.T))]
    bearing = math.remainder(math.atan2(dy, dx) - rig.world.pose[2], 2 * math.pi)
    back = abs(bearing) > math.pi / 2
    turn = math.remainder(bearing + math.pi, 2 * math.pi) if back else bearing
    return np.array([-0.3 if back else 0.3, 1.5 * np.sign(turn) * min(abs(turn), 1.0)])


@pytest.mark.parametrize(("rate", "seeds"), [(20.0, range(8)), (50.0, range(2))])
def test_whatever_is_commanded_nothing_is_touched(rate: float, seeds: range) -> None:
    moved = 0.0
    for seed in seeds:
        rig = Rig(crowded(seed), rate=rate)
        random = np.random.default_rng(1000 + seed)
        change_at = 0
        for k in range(1500):
            if k >= change_at:  # kept for a while or changed at once
                rig.command = reckless(rig, random)
                change_at = k + int(random.choice([3, 20, 100, 200]))
            rig.step()
            moved += abs(rig.world.sent[0]) * rig.dt
        assert rig.smallest_gap > 0, f"seed {seed}"
        assert rig.counts["slowed"] > 10, f"seed {seed}"  # it was put to the test
    assert moved > 0.5 * len(seeds)  # and not by standing still


@pytest.mark.parametrize("seed", range(4))
def test_without_the_monitor_the_same_robot_hits_something(seed: int) -> None:
    # The proof above proves something only if the commands are dangerous.
    world = crowded(seed)
    random = np.random.default_rng(1000 + seed)
    gaps = []
    for k in range(3000):
        if k % 100 == 0:
            command = random.uniform([-0.15, -1.5], [0.3, 1.5])
        world.pose = move(world.pose, command, 0.01)
        gaps.append(world.gap(world.pose))
    assert min(gaps) < 0


@pytest.mark.parametrize("seed", range(3))
def test_it_slows_only_for_what_is_there(seed: int) -> None:
    # Whatever was slowed would have come nearer than the margin, give or take the lidar's gaps.
    rig = Rig(crowded(seed))
    random = np.random.default_rng(2000 + seed)
    p = CollisionMonitorParameters()
    change = np.array([p.deceleration, p.turn_deceleration])
    slowed = 0
    for k in range(2000):
        if k % 50 == 0:
            rig.command = random.uniform([0.05, -1.0], [0.3, 1.0])
        before = rig.world.pose, rig.world.sent.copy()
        looks = k % 20 == 0
        rig.step()
        if not looks or k < 40 or rig.scale == 1:
            continue
        slowed += 1
        pose, speed = before
        gap = rig.world.gap(pose)
        for j in range(60):
            t = j * 0.02
            target = rig.command if t < p.reaction_time + p.slowdown_time else STAND
            speed = speed + np.clip(target - speed, -change * 0.02, change * 0.02)
            pose = move(pose, speed, 0.02)
            gap = min(gap, rig.world.gap(pose))
        assert gap < p.margin + 0.02
    assert slowed > 5


def test_it_stops_before_a_wall_drives_off_and_gets_out_of_a_corner() -> None:
    walls = np.array([[1.0, -2.0, 1.0, 2.0], [-2.0, 0.6, 2.0, 0.6]])
    rig = Rig(World(np.zeros((0, 3)), walls, 0))
    rig.command = np.array([0.3, 0.0])
    for _ in range(800):
        rig.step()
    # Stands at the margin, within what the slowest step drives on.
    assert 0.04 < rig.world.gap(rig.world.pose) < 0.09
    assert np.abs(rig.world.sent).max() < 0.01
    rig.command = np.array([0.3, -1.0])  # a controller that cannot reverse
    for _ in range(400):
        rig.step()
    assert rig.world.gap(rig.world.pose) > 0.2
    assert rig.smallest_gap > 0.005


def test_a_wall_inside_the_blind_zone_is_not_forgotten() -> None:
    # Half a margin before the wall the lidar sees nothing straight ahead.
    rig = Rig(
        World(np.array([[0.5, 0.0, 0.05]]), np.zeros((0, 4)), 0), margin=0.01, slowdown_time=0.1
    )
    rig.command = np.array([0.3, 0.0])
    for _ in range(600):
        rig.step()
    ahead = 0.45 - rig.world.pose[0] - LIDAR[0]
    assert ahead < 0.15
    assert not np.isfinite(rig.scan.ranges).any()
    assert rig.smallest_gap > 0.003
    rig.world = World(np.array([[3.0, 0.0, 1.0]]), np.zeros((0, 4)), 0)  # it goes away
    rig.world.pose = rig.poses[-1]
    x = rig.world.pose[0]
    for _ in range(100):
        rig.step()
    assert rig.world.pose[0] > x + 0.1


def test_faulty_scans_and_commands_stop_the_robot_and_are_counted() -> None:
    rig = Rig(World(np.array([[2.0, 0.0, 0.1]]), np.zeros((0, 4)), 0))
    monitor, context = rig.monitor, rig.context
    good = scan_of(np.full(360, 3.0))

    def look(t: float, scan: Scan, command: Any = (0.3, 0.2), sent: Any = (0.3, 0.2)) -> Any:
        monitor.command_input_port().FixValue(context, list(command))
        monitor.scan_input_port().FixValue(context, AbstractValue.Make(scan))
        monitor.sent_input_port().FixValue(context, list(sent))
        rig.simulator.AdvanceTo(t)
        return monitor.command_output_port().Eval(context).tolist()

    stop = [0.0, 0.0]
    assert monitor.command_output_port().Eval(context).tolist() == stop
    assert look(0.01, Scan()) == stop
    assert look(0.06, replace(good, stamp=0.05)) == [0.3, 0.2]
    assert look(0.11, replace(good, stamp=0.05, ranges=np.full(360, math.nan))) == stop
    assert look(0.16, replace(good, stamp=0.05, ranges=np.full(360, -1.0))) == stop
    assert look(0.21, replace(good, stamp=0.05, range_max=math.nan)) == stop
    assert look(0.26, replace(good, stamp=0.05, ranges=np.zeros(0))) == stop
    assert look(0.31, replace(good, stamp=-0.4)) == stop
    assert look(0.36, good, command=(math.nan, 0.0)) == stop
    assert look(0.41, good, command=(0.1, math.inf)) == stop
    assert look(0.46, good, sent=(math.nan, 0.0)) == stop
    assert look(0.51, good, command=(0.1, -0.1)) == [0.1, -0.1]
    assert look(0.71, good) == stop  # it has grown old
    assert rig.counts == {
        "no_scan": 2,
        "stale_scan": 4,  # of the first two samples one came at 0
        "garbled_scan": 3,
        "slowed": 0,
        "stopped": 0,
        "bad_command": 3,
    }


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"hull": [0.1, 0.1]}, "hull is"),
        ({"hull": [0.1, 0.1, 0.0]}, "hull is"),
        ({"lidar_pose": [0.1, math.nan, 0.0]}, "lidar_pose is"),
        ({"rate": 0.0}, "rate is 0.0"),
    ],
)
def test_nonsense_is_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CollisionMonitor(**({"hull": HULL, "lidar_pose": LIDAR} | arguments))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("deceleration", 0.0),
        ("turn_deceleration", math.nan),
        ("reaction_time", -0.1),
        ("slowdown_time", 0.0),
        ("margin", -0.01),
        ("contact_margin", 0.07),
        ("max_scan_age", math.inf),
    ],
)
def test_parameters_out_of_range_are_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{field} is {value}: must be "):
        CollisionMonitorParameters(**{field: value})
