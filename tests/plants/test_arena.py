from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydrake.geometry import GeometrySet, Role
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from plants.arena import ArenaParameters, Wall, add_arena, check_free, check_markers
from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap

ARENA = ArenaParameters(
    walls=[
        Wall(start=[2.0, -2.0], end=[2.0, 2.0]),  # 50 mm thick: its near face is at x = 1.975
        Wall(start=[0.0, 1.0], end=[1.0, 2.0], thickness=0.1, height=0.4),
    ]
)


def a_marker(X_WM: RigidTransform, size: float = 0.1, marker_id: int = 7) -> MarkerMap:
    marker = Marker(marker_id, X_WM, size)
    return MarkerMap(family("DICT_4X4_50"), 0.1, {marker_id: marker})


def on_the_wall(x: float, y: float = 0.0, z: float = 0.3, yaw: float = np.pi) -> RigidTransform:
    return RigidTransform(RollPitchYaw(0.0, 0.0, yaw), [x, y, z])


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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": [0.0]}, "start is .*: must be"),
        ({"end": [0.0, math.nan]}, "end is .*: must be"),
        ({"end": [0.0, 0.0]}, "end is .*: must be another point than start"),
        ({"thickness": 0.0}, "thickness is 0.0: must be greater than 0"),
        ({"height": -1.0}, "height is -1.0: must be greater than 0"),
    ],
)
def test_a_wall_of_nonsense_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Wall(**({"start": [0.0, 0.0], "end": [1.0, 0.0]} | change))


def test_an_arena_of_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match="ground is 0: must be greater than 0"):
        ArenaParameters(ground=0)


@pytest.mark.parametrize(
    ("X_WM", "wall"),
    [
        (on_the_wall(2.0), 0),  # in the middle of it
        (on_the_wall(1.975), 0),  # on its very face
        (on_the_wall(1.9755), 0),  # a fraction of a millimetre in it
        (on_the_wall(1.95, yaw=np.pi / 2), 0),  # across: only one edge is inside
        (on_the_wall(1.96, yaw=np.pi + 0.5), 0),
        (on_the_wall(0.5, y=1.5), 1),
    ],
)
def test_a_marker_in_a_wall_is_refused_by_name(X_WM: RigidTransform, wall: int) -> None:
    markers = a_marker(X_WM)
    with pytest.raises(ValueError, match=rf"marker 7 is -?0\.\d+ m from walls\[{wall}\]: must be"):
        check_markers(ARENA, markers)
    with pytest.raises(ValueError, match=r"marker 7 is "):
        build(ARENA, markers)


@pytest.mark.parametrize(
    "X_WM",
    [
        on_the_wall(1.973),
        on_the_wall(2.027, yaw=0.0),
        on_the_wall(2.0, z=0.7),  # above the wall
        on_the_wall(2.0, y=3.0),  # beside it
    ],
)
def test_a_marker_before_a_wall_is_welcome(X_WM: RigidTransform) -> None:
    check_markers(ARENA, a_marker(X_WM))


def test_a_thin_wall_through_a_marker_is_noticed() -> None:
    # It passes between the corners and the centre.
    sheet = Wall(start=[1.0, 0.03], end=[3.0, 0.03], thickness=0.004)
    markers = a_marker(on_the_wall(2.0), size=0.2)
    with pytest.raises(ValueError, match=r"marker 7 is -0\.\d+ m from walls\[0\]"):
        check_markers(ArenaParameters(walls=[sheet]), markers)


def test_no_marker_is_refused_that_has_room_and_none_accepted_that_has_not() -> None:
    rng = np.random.default_rng(2)
    wall = Wall(start=[0.0, 0.0], end=[0.6, 0.3], thickness=0.1, height=0.4)
    grid = np.linspace(-0.15, 0.15, 61)
    y, z = np.meshgrid(grid, grid)
    square = np.stack([0 * y, y, z]).reshape(3, -1)
    refused = 0
    for _ in range(300):
        X_WM = RigidTransform(
            RollPitchYaw(rng.uniform(-3, 3, 3)), rng.uniform([-0.3, -0.3, -0.1], [0.9, 0.6, 0.6])
        )
        nearest = wall.distance(X_WM.multiply(square).T).min()
        try:
            check_markers(ArenaParameters(walls=[wall]), a_marker(X_WM, size=0.3))
            assert nearest > 0.0009
        except ValueError:
            refused += 1
            assert nearest < 0.005
    assert 50 < refused < 250


def test_points_without_room_are_refused_by_name() -> None:
    check_free(ARENA, [0.0, 0.0], 0.18, "waypoints[0]")
    check_free(ARENA, [1.8, 0.0], 0.17, "waypoints[1]")
    with pytest.raises(
        ValueError,
        match=r"waypoints\[1\] = \[1\.8, 0\] is 0\.175 m from walls\[0\]: the robot needs 0\.180 m",
    ):
        check_free(ARENA, [1.8, 0.0], 0.18, "waypoints[1]")
    with pytest.raises(ValueError, match=r"start = \[0\.5, 1\.5\] lies in walls\[1\]"):
        check_free(ARENA, [0.5, 1.5], 0.1, "start")


def build(arena: ArenaParameters, markers: MarkerMap) -> Any:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.01)
    add_arena(plant, arena, markers)
    plant.Finalize()
    return builder.Build(), scene_graph


def test_the_arena_stands_in_drake_as_it_is_described() -> None:
    diagram, scene_graph = build(ARENA, a_marker(on_the_wall(1.9)))
    context = diagram.CreateDefaultContext()
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    inspector = query.inspector()

    def geometry(name: str) -> Any:
        everything = GeometrySet(inspector.GetAllGeometryIds())
        solids = inspector.GetGeometryIds(everything, Role.kProximity)
        (solid,) = (g for g in solids if inspector.GetName(g).endswith(name))
        return lambda p: next(
            found.distance for found in query.ComputeSignedDistanceToPoint(p) if found.id_G == solid
        )

    rng = np.random.default_rng(1)
    for k, wall in enumerate(ARENA.walls):
        by_drake = geometry(f"wall_{k}")
        for p in rng.uniform([-1, -1, 0.01], [3, 3, 1], (20, 3)):
            assert by_drake(p) == pytest.approx(wall.distance(p)[0], abs=1e-9)
    assert geometry("ground")([40.0, -40.0, 0.5]) == pytest.approx(0.5)
    # A marker is seen, not touched.
    for role, count in ((Role.kPerception, 2), (Role.kIllustration, 2), (Role.kProximity, 0)):
        ids = inspector.GetGeometryIds(GeometrySet(inspector.GetAllGeometryIds()), role)
        assert sum("marker_7" in inspector.GetName(g) for g in ids) == count
