from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydrake.geometry import GeometrySet, Role
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from plants.arena import ArenaParameters, add_arena, check_free, check_markers
from plants.moving import MovingCylinder
from plants.obstacles import BoxObstacle, CylinderObstacle, Wall
from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap

ARENA = ArenaParameters(
    walls=[
        Wall(start=[2.0, -2.0], end=[2.0, 2.0]),  # 50 mm thick: its near face is at x = 1.975
        Wall(start=[0.0, 1.0], end=[1.0, 2.0], thickness=0.1, height=0.4),
    ]
)

MOVING = MovingCylinder(radius=0.1, path=[[-1.0, 0.5], [-1.0, -0.5]], speed=0.2, height=0.4)
FULL = ArenaParameters(
    walls=ARENA.walls,
    boxes=[
        BoxObstacle(position=[-1.0, -1.0], size=[0.4, 0.2, 0.3], heading_deg=90.0),
        BoxObstacle(position=[-1.0, 1.5], size=[0.3, 0.3, 0.5], heading_deg=30.0),
    ],
    cylinders=[CylinderObstacle(position=[0.5, -1.0], radius=0.2, height=0.5)],
    moving=[MOVING],
)


def a_marker(X_WM: RigidTransform, size: float = 0.1, marker_id: int = 7) -> MarkerMap:
    marker = Marker(marker_id, X_WM, size)
    return MarkerMap(family("DICT_4X4_50"), 0.1, {marker_id: marker})


def on_the_wall(x: float, y: float = 0.0, z: float = 0.3, yaw: float = np.pi) -> RigidTransform:
    return RigidTransform(RollPitchYaw(0.0, 0.0, yaw), [x, y, z])


def test_an_arena_of_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match="ground is 0: must be greater than 0"):
        ArenaParameters(ground=0)
    through = MovingCylinder(radius=0.1, path=[[0.0, 0.0], [3.0, 0.0]], speed=0.2)
    with pytest.raises(
        ValueError, match=r"moving\[1\]: its path leads through walls\[0\]: 1\.125 m"
    ):
        ArenaParameters(walls=ARENA.walls, moving=[MOVING, through])
    beside = MovingCylinder(radius=0.1, path=[[0.0, 0.0], [1.0, 0.0], [1.0, -1.0]], speed=0.2)
    pole = CylinderObstacle(position=[1.15, -0.5], radius=0.1)
    with pytest.raises(
        ValueError, match=r"moving\[0\]: its path leads through cylinders\[0\]: 0\.050"
    ):
        ArenaParameters(cylinders=[pole], moving=[beside])


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


@pytest.mark.parametrize(
    ("X_WM", "name"),
    [
        (on_the_wall(-1.0, -1.0, 0.2), "boxes\\[0\\]"),
        (on_the_wall(-0.8995, -1.0, 0.2, yaw=0.0), "boxes\\[0\\]"),  # half a millimetre before it
        (on_the_wall(-1.0, 1.5, 0.3), "boxes\\[1\\]"),
        (on_the_wall(0.6, -0.9, 0.3), "cylinders\\[0\\]"),
    ],
)
def test_a_marker_in_a_box_or_cylinder_is_refused_by_name(X_WM: RigidTransform, name: str) -> None:
    with pytest.raises(ValueError, match=rf"marker 7 is -?0\.\d+ m from {name}: must be at least"):
        build(FULL, a_marker(X_WM))


def test_markers_before_and_above_boxes_and_cylinders_are_welcome() -> None:
    for X_WM in (
        on_the_wall(-0.898, -1.0, 0.2, yaw=0.0),
        on_the_wall(-1.0, -1.0, 0.4),
        on_the_wall(0.5, -1.0, 0.6),
        on_the_wall(0.702, -1.0, 0.3, yaw=0.0),
    ):
        check_markers(FULL, a_marker(X_WM))


@pytest.mark.parametrize(
    ("point", "said"),
    [
        ([-1.0, -1.1], r"lies in boxes\[0\]: the robot needs 0\.200 m of room"),
        ([-0.75, -1.0], r"is 0\.150 m from boxes\[0\]"),
        ([-1.0, 1.5], r"lies in boxes\[1\]"),
        ([0.5, -0.9], r"lies in cylinders\[0\]"),
        ([0.5, -0.65], r"is 0\.150 m from cylinders\[0\]"),
    ],
)
def test_points_at_boxes_and_cylinders_are_refused_by_name(point: list[float], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        check_free(FULL, point, 0.2, "waypoints[0]")


def test_of_what_moves_only_the_start_has_to_keep_away() -> None:
    check_free(FULL, [-1.0, 0.5], 0.2, "waypoints[0]")
    check_free(FULL, [-1.0, 0.0], 0.2, "robot.start", moving=True)  # it comes there later
    with pytest.raises(ValueError, match=r"robot\.start = \[-1, 0\.45\] lies in moving\[0\]"):
        check_free(FULL, [-1.0, 0.45], 0.2, "robot.start", moving=True)


def build(arena: ArenaParameters, markers: MarkerMap) -> Any:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.01)
    add_arena(plant, arena, markers)
    plant.Finalize()
    return builder.Build(), scene_graph


def test_the_arena_stands_in_drake_as_it_is_described() -> None:
    diagram, scene_graph = build(FULL, a_marker(on_the_wall(1.9)))
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
    boxes: dict[str, list[Any]] = {"wall": list(FULL.walls), "box": list(FULL.boxes)}
    for name, kind in boxes.items():
        for k, box in enumerate(kind):
            by_drake = geometry(f"{name}_{k}")
            for p in rng.uniform([-1, -1, 0.01], [3, 3, 1], (20, 3)):
                assert by_drake(p) == pytest.approx(box.distance(p)[0], abs=1e-9)
    for name, x, y, top in (("cylinder_0", 0.5, -1.0, 0.5), ("moving_0", -1.0, 0.5, 0.401)):
        by_drake, radius = geometry(name), 0.2 if name == "cylinder_0" else 0.1
        assert by_drake([x + 0.5, y, 0.3]) == pytest.approx(0.5 - radius)
        assert by_drake([x, y - 0.5, 0.3]) == pytest.approx(0.5 - radius)
        assert by_drake([x, y, 1.0]) == pytest.approx(1.0 - top)
    assert geometry("ground")([40.0, -40.0, 0.5]) == pytest.approx(0.5)
    # Whatever one bumps into is seen by cameras and by who watches.
    for name in ("wall_0", "box_1", "cylinder_0", "moving_0"):
        for role in (Role.kProximity, Role.kPerception, Role.kIllustration):
            ids = inspector.GetGeometryIds(GeometrySet(inspector.GetAllGeometryIds()), role)
            assert sum(inspector.GetName(g).endswith(name) for g in ids) == 1
    # A marker is seen, not touched.
    for role, count in ((Role.kPerception, 2), (Role.kIllustration, 2), (Role.kProximity, 0)):
        ids = inspector.GetGeometryIds(GeometrySet(inspector.GetAllGeometryIds()), role)
        assert sum("marker_7" in inspector.GetName(g) for g in ids) == count
