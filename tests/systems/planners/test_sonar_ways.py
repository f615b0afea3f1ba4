"""A formation that hears its way through clutter: range finders, grid and planner, without a plant.

Robots are where they are said to be, but for a few millimetres, and move along straight lines.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from plants.formation_arena import (
    FormationArena,
    FormationArenaParameters,
    formation_arena,
    known_obstacles,
)
from systems.messages import Scan
from systems.planners.formation_course import FormationMove, Memory, Report, after
from systems.planners.formation_ground import FormationParameters, past
from systems.planners.formation_lattice import fit_lattice
from systems.planners.formation_obstacles import Obstacles, clearance
from systems.planners.formation_planner import RULES
from systems.planners.sonar_grid import (
    SonarGridParameters,
    empty_sonar_grid,
    rectangles,
    with_cones,
)
from systems.planners.sonar_obstacles import RingGeometry, cones_of
from systems.raycasting import Solids
from systems.sensors.ultrasonic import UltrasonicParameters, measured_ranges, true_ranges

ROOM = FormationParameters(max_expansions=5000)
GRID = SonarGridParameters()
RING = UltrasonicParameters(sensors=24, offset=0.12, range_max=2.6)
GEOMETRY = RingGeometry(np.zeros(3), RING.offset, RING.half_angle)
HEIGHT = 0.35


class Explorers:
    """Four robots that know nothing of the arena but what they hear."""

    def __init__(self, made: FormationArena, seed: int) -> None:
        standing = [obstacle for _, obstacle in made.arena.standing()]
        self.solids = Solids([o.shape() for o in standing], [o.pose() for o in standing])
        self.truth = known_obstacles(made.arena)
        self.destination = made.destination
        self.lattice, vertices = fit_lattice(made.start, ROOM.side)
        self.memory = Memory(dict(enumerate(vertices)))
        self.poses = np.column_stack([made.start, np.zeros(4)])
        self.random = np.random.default_rng(seed)
        self.grid = empty_sonar_grid(GRID)
        self.obstacles = Obstacles()
        self.nearest = math.inf
        self.time = 0.0

    def listen(self, robots: list[int], times: int = 1) -> None:
        for _ in range(times):
            self.time += 0.5
            for k in robots:
                x, y, theta = self.poses[k]
                X_WU = RigidTransform(RotationMatrix.MakeZRotation(theta), [x, y, HEIGHT])
                ranges = measured_ranges(true_ranges(self.solids, X_WU, RING), RING, self.random)
                scan = Scan(
                    stamp=self.time,
                    angle_min=0.0,
                    angle_increment=2 * math.pi / RING.sensors,
                    range_min=RING.range_min,
                    range_max=RING.range_max,
                    ranges=ranges,
                )
                told = self.poses[k] + self.random.normal(0.0, [0.005, 0.005, 0.003])
                cones, _ = cones_of(scan, told, GEOMETRY, np.zeros((0, 2)), np.zeros(0), GRID)
                self.grid = with_cones(self.grid, cones, self.time, GRID)
        shapes = rectangles(self.grid, GRID.max_shapes)
        if not np.array_equal(shapes, self.obstacles.polygons):
            self.obstacles = Obstacles(self.time, "map", polygons=shapes)

    def look(self, outcome: int = 0) -> FormationMove:
        report = Report(
            time=self.time,
            positions=self.poses[:, :2].copy(),
            failed=np.zeros(4, int),
            obstacles=self.obstacles,
            destination=self.destination,
            outcome=outcome,
        )
        self.memory = after(self.memory, report, self.lattice, ROOM, RULES["astar"])
        return self.memory.move

    def drive(self, move: FormationMove) -> bool:
        """Drives until the robot is there, or something else is planned; whether it is."""
        k = move.mover
        vertex = move.points[-1]
        beyond = past(move.points[-2], vertex, ROOM.beyond)
        for a, b in pairwise([self.poses[k, :2].copy(), *move.points, beyond, vertex]):
            steps = max(1, round(float(np.hypot(*(b - a))) / 0.2))
            if np.hypot(*(b - a)) > 1e-6 and b is not vertex:
                self.poses[k, 2] = math.atan2(b[1] - a[1], b[0] - a[0])
            for share in np.arange(1, steps + 1) / steps:
                self.poses[k, :2] = here = a + share * (b - a)
                self.nearest = min(self.nearest, clearance(self.truth, here, here))
                self.listen([k])
                if self.look() is not move:
                    return False
        return True

    def go(self, most: int) -> str:
        """Moves until nothing is left to do; returns what the planner says then."""
        self.listen([0, 1, 2, 3], 4)
        move = self.look()
        for _ in range(most):
            if move.status != "moving":
                break
            done = self.drive(move)
            self.listen([0, 1, 2, 3], 3)
            move = self.look(int(done))
        return move.status


@pytest.mark.parametrize("seed", [0, 4])
def test_they_hear_their_way_through_clutter(seed: int) -> None:
    made = formation_arena(seed, FormationArenaParameters(slack=0.1))
    robots = Explorers(made, seed)
    assert robots.go(60) == "reached"
    assert robots.nearest > ROOM.robot_radius  # from the axis
    assert len(robots.obstacles) <= GRID.max_shapes
