from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from plants.obstacles import BoxObstacle, CylinderObstacle, Wall
from systems.markers.layout import Marker


def test_distances_from_a_wall() -> None:
    wall = Wall(start=[0.0, 0.0], end=[2.0, 0.0], thickness=0.1, height=1.0)
    points = {
        (1.0, 0.5, 0.5): 0.45,  # beside
        (1.0, -0.5, 0.5): 0.45,
        (3.0, 0.0, 0.5): 1.0,  # beyond its end
        (2.3, 0.45, 0.5): 0.5,  # off its corner: 3, 4, 5
        (1.0, 0.0, 1.5): 0.5,  # above
        (1.0, 0.0, 0.5): -0.05,  # inside: the face is 50 mm away
        (1.98, 0.0, 0.5): -0.02,
    }
    np.testing.assert_allclose(wall.distance(np.array(list(points))), list(points.values()))


def test_a_wall_at_an_angle_has_the_distances_of_one_that_is_not() -> None:
    rng = np.random.default_rng(0)
    straight = Wall(start=[-1.0, 0.0], end=[1.0, 0.0])
    turn = RigidTransform(RollPitchYaw(0, 0, 0.7), [3.0, -2.0, 0.0])
    ends = [turn.multiply(np.array([x, 0.0, 0.0]))[:2].tolist() for x in (-1.0, 1.0)]
    askew = Wall(start=ends[0], end=ends[1])
    assert askew.length == pytest.approx(2.0)
    points = rng.uniform(-2, 2, (50, 3))
    np.testing.assert_allclose(
        askew.distance(turn.multiply(points.T).T), straight.distance(points), atol=1e-12
    )


def test_a_box_is_where_a_wall_of_its_size_is() -> None:
    heading = math.degrees(math.atan2(3.0, 4.0))
    box = BoxObstacle(position=[1.0, 2.0], size=[5.0, 0.4, 0.7], heading_deg=heading)
    wall = Wall(start=[-1.0, 0.5], end=[3.0, 3.5], thickness=0.4, height=0.7)
    assert box.pose().IsNearlyEqualTo(wall.pose(), 1e-12)
    points = np.random.default_rng(1).uniform(-3, 3, (40, 3))
    np.testing.assert_allclose(box.distance(points), wall.distance(points), atol=1e-12)
    np.testing.assert_allclose(
        box.footprint().distances_from(points[:, :2])[0],
        box.distance(np.column_stack([points[:, :2], np.full(40, 0.35)])),
        # Inside, a face may be nearer than the outline: the floor's and the top's are 0.35 m away.
        atol=1e-12,
    )


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        (Wall, {"start": [0.0]}, "start is .*: must be"),
        (Wall, {"end": [0.0, math.nan]}, "end is .*: must be"),
        (Wall, {"end": [0.0, 0.0]}, "end is .*: must be another point than start"),
        (Wall, {"thickness": 0.0}, "thickness is 0.0: must be greater than 0"),
        (Wall, {"height": -1.0}, "height is -1.0: must be greater than 0"),
        (BoxObstacle, {"position": [0.0, math.inf]}, r"position is \[0.0, inf\]: must be \[x, y\]"),
        (BoxObstacle, {"size": [1.0, 1.0]}, r"size is \[1.0, 1.0\]: must be \[length, width, he"),
        (BoxObstacle, {"size": [1.0, 0.0, 1.0]}, "size is .*: must be .* each greater than 0"),
        (BoxObstacle, {"heading_deg": math.nan}, "heading_deg is nan: must be finite"),
        (CylinderObstacle, {"position": [1.0]}, "position is .*: must be"),
        (CylinderObstacle, {"radius": 0.0}, "radius is 0.0: must be greater than 0"),
        (CylinderObstacle, {"height": math.inf}, "height is inf: must be greater than 0"),
    ],
)
def test_nonsense_is_refused(kind: type, change: dict[str, Any], message: str) -> None:
    good: dict[type, dict[str, Any]] = {
        Wall: {"start": [0.0, 0.0], "end": [1.0, 0.0]},
        BoxObstacle: {"position": [0.0, 0.0], "size": [1.0, 1.0, 1.0]},
        CylinderObstacle: {"position": [0.0, 0.0], "radius": 0.2},
    }
    kind(**good[kind])
    with pytest.raises(ValueError, match=message):
        kind(**(good[kind] | change))


def a_marker(x: float, y: float, z: float, size: float = 0.1, *rpy: float) -> Marker:
    return Marker(7, RigidTransform(RollPitchYaw(*(rpy or (0.0, 0.0, 0.0))), [x, y, z]), size)


POLE = CylinderObstacle(position=[1.0, 0.0], radius=0.2, height=0.5)


@pytest.mark.parametrize(
    ("marker", "gap"),
    [
        (a_marker(1.5, 0.0, 0.3), 0.3),  # its face looks away; 0.5 m from the axis
        (a_marker(1.0, 0.5, 0.3), 0.25),  # edge on: from 0.45 beside the axis
        (a_marker(1.0, 0.35, 0.3), 0.1),
        (a_marker(1.0, 0.0, 0.3), -0.2),  # right through it
        (a_marker(1.3, 0.0, 0.8), 0.25),  # its lower edge is over the top
        (a_marker(1.0, 0.0, 0.8), 0.25),
        (a_marker(1.0, 0.0, 0.52), -0.2),  # the lower edge sticks in it
        (a_marker(1.3, 0.0, -0.2), 0.15),  # under the ground
        (a_marker(1.0, 0.0, 0.3, 0.1, 0.0, -math.pi / 2, 0.0), -0.2),  # flat, facing up, inside
        (a_marker(1.0, 0.0, 0.3, 2.0, 0.0, -math.pi / 2, 0.0), -0.2),  # the pole pierces it
    ],
)
def test_gaps_to_a_cylinder_drawn_by_hand(marker: Marker, gap: float) -> None:
    assert POLE.gap(marker) == pytest.approx(gap, abs=1e-6)


def test_a_marker_overlaps_a_cylinder_when_some_of_its_points_do() -> None:
    rng = np.random.default_rng(4)
    grid = np.linspace(-0.15, 0.15, 101)
    y, z = np.meshgrid(grid, grid)
    square = np.stack([0 * y, y, z]).reshape(3, -1)
    inside = 0
    for _ in range(400):
        X_WM = RigidTransform(
            RollPitchYaw(rng.uniform(-3, 3, 3)), rng.uniform([0.5, -0.5, -0.1], [1.5, 0.5, 0.7])
        )
        p = X_WM.multiply(square) - np.array([[1.0], [0.0], [0.0]])
        depth = np.maximum.reduce([np.hypot(p[0], p[1]) - 0.2, -p[2], p[2] - 0.5]).min()
        gap = POLE.gap(Marker(7, X_WM, 0.3))
        if gap < 0:
            inside += 1
            assert depth < 0.004  # the grid's step is 3 mm
        else:
            assert depth > -1e-9
    assert 80 < inside < 320
