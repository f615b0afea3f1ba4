"""Obstacles in a station: how far the robot is from them, what it touches, what moves."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydrake.geometry import Role
from pydrake.systems.analysis import Simulator

from diagrams.scenario import load_scenario
from diagrams.station import Station
from plants.moving import MODEL

BOXES = """[{position: [-1.6, 0.2], size: [0.3, 0.2, 0.4], heading_deg: 25},
            {position: [1.5, 0.4], size: [0.5, 0.1, 0.3], heading_deg: -70}]"""
CYLINDERS = "[{position: [0.2, 0.3], radius: 0.15}]"
MOVING = "[{radius: 0.2, path: [[0.0, -1.2], [0.0, -0.5]], speed: 0.2}]"
OVERRIDES = [
    f"world.arena.boxes={BOXES}",
    f"world.arena.cylinders={CYLINDERS}",
    f"world.arena.moving={MOVING}",
]


# The bundled room's walls and markers, and nothing else; wheels that do as they are told.
BARE = (
    "world.arena.boxes=[]",
    "world.arena.cylinders=[]",
    "robot.drive={type: wheel_servo, rate: 50.0}",
    "robot.sensors.imu={type: imu}",
)


def a_station(*overrides: str, dynamics: str = "multibody") -> Station:
    scenario = load_scenario("navigation_open", [*BARE, *overrides])
    return Station(
        world=scenario.world,
        robots={"robot": scenario.robot},
        sight="projected",
        time_step=0.01,
        dynamics=dynamics,
    )


def test_the_robot_in_its_room_is_as_far_from_things_as_drake_says() -> None:
    station = a_station(*OVERRIDES)
    context = station.CreateDefaultContext()
    plant = station.plant
    own = plant.GetMyMutableContextFromRoot(context)
    robot = station.robots["robot"]
    base = plant.GetBodyByName("base_link", robot.model)
    rng = np.random.default_rng(5)
    apart = overlapping = 0
    for _ in range(300):
        x, y, theta = rng.uniform([-2.4, -1.9, -3.2], [2.4, 1.9, 3.2])
        q = [math.cos(theta / 2), 0.0, 0.0, math.sin(theta / 2), x, y, 0.0]
        positions = plant.GetPositions(own, robot.model)
        start = base.floating_positions_start() - 2  # the moving cylinder's come before
        positions[start : start + 7] = q
        plant.SetPositions(own, robot.model, positions)
        moving = plant.GetModelInstanceByName(MODEL)
        plant.SetPositions(own, moving, rng.uniform(-0.5, 0.5, 2))
        query = station.GetOutputPort("scene.query_object").Eval(context)
        inspector = query.inspector()

        def mine(geometry: object, inspector: object = inspector) -> bool:
            return "robot::" in inspector.GetName(geometry)  # type: ignore[attr-defined]

        drake = min(
            pair.distance
            for pair in query.ComputeSignedDistancePairwiseClosestPoints()
            if mine(pair.id_A) != mine(pair.id_B)
            and "ground" not in inspector.GetName(pair.id_A) + inspector.GetName(pair.id_B)
        )
        ours = station.GetOutputPort("truth.robot.clearance").Eval(context)[0]
        if drake > 0:
            apart += 1
            assert ours == pytest.approx(drake, abs=1e-3)
        else:
            overlapping += 1
            # Deep inside, up or down is the shorter way out, which a plan does not know.
            assert ours < 1e-6
            if drake > -0.02:
                assert ours == pytest.approx(drake, abs=1e-3)
    assert apart > 150
    assert overlapping > 20


@pytest.mark.parametrize("dynamics", ["multibody", "kinematic"])
def test_a_robot_that_drives_into_a_wall_has_one_contact(dynamics: str) -> None:
    station = a_station("robot.start={x: -1.8, y: 1.0, heading_deg: 90}", dynamics=dynamics)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.GetInputPort("robot.drive.command").FixValue(context, [0.3, 0.0])
    clearance = station.GetOutputPort("truth.robot.clearance")
    contacts = station.GetOutputPort("truth.robot.contacts")
    # From x = -1.8 the wall in the west is 0.675 m away, less the wheel, whose ball reaches 0.1125.
    assert clearance.Eval(context)[0] == pytest.approx(0.675 - 0.1125, abs=1e-3)
    simulator.AdvanceTo(2.0)
    assert contacts.Eval(context)[0] == 0
    simulator.AdvanceTo(3.5)  # its nose stands at 1.11 + 0.3 t, and the wall's face is at 1.975
    assert contacts.Eval(context)[0] == 1
    if dynamics == "multibody":
        assert clearance.Eval(context)[0] == pytest.approx(0.0, abs=1e-3)
    else:  # nothing stops a twin
        assert clearance.Eval(context)[0] < -0.1
    station.GetInputPort("robot.drive.command").FixValue(context, [-0.3, 0.0])
    simulator.AdvanceTo(6.0)
    assert clearance.Eval(context)[0] > 0.1
    assert contacts.Eval(context)[0] == 1


def moving_places(station: Station, context: Any) -> np.ndarray:
    """Where SceneGraph has the moving cylinders, (n, 2) m."""
    query = station.GetOutputPort("scene.query_object").Eval(context)
    inspector = query.inspector()
    frames = [
        inspector.GetFrameId(g)
        for g in inspector.GetAllGeometryIds(Role.kProximity)
        if "moving_" in inspector.GetName(g)
    ]
    return np.array([query.GetPoseInWorld(frame).translation()[:2] for frame in frames])


@pytest.mark.parametrize("dynamics", ["multibody", "kinematic"])
def test_what_moves_is_where_its_path_says_whatever_the_dynamics(dynamics: str) -> None:
    two = "[{radius: 0.1, path: [[0, -1.2], [0, -0.5]], speed: 0.2, pause: 0.5}, {radius: 0.1, \
            path: [[1.5, 1.5], [1.8, 1.2], [1.8, 0.5]], speed: 0.25}]"
    station = a_station(f"world.arena.moving={two}", dynamics=dynamics)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.GetInputPort("robot.drive.command").FixValue(context, [0.0, 0.0])
    start = station.GetOutputPort("truth.robot.pose").Eval(context).copy()
    cylinders = load_scenario(
        "navigation_open", [*BARE, f"world.arena.moving={two}"]
    ).world.arena.moving
    for t in np.arange(0.0, 9.0, 0.45):
        simulator.AdvanceTo(t)
        expected = [cylinder.motion(t)[0] for cylinder in cylinders]
        tolerance = 0.02 if dynamics == "multibody" else 1e-9
        np.testing.assert_allclose(moving_places(station, context), expected, atol=tolerance)
    # The robot's own positions are not mixed up with theirs.
    pose = station.GetOutputPort("truth.robot.pose").Eval(context)
    np.testing.assert_allclose(pose, start, atol=2e-3)


def test_a_cylinder_that_comes_along_pushes_the_robot_and_counts_as_a_touch() -> None:
    # It comes from behind, along the robot's way, and the wheels stand still.
    moving = "world.arena.moving=[{radius: 0.12, path: [[-1.8, -0.6], [-1.8, 0.6]], speed: 0.2}]"
    station = a_station(moving, "robot.start={x: -1.8, y: 0.0, heading_deg: 90}")
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.GetInputPort("robot.drive.command").FixValue(context, [0.0, 0.0])
    clearance = station.GetOutputPort("truth.robot.clearance")
    contacts = station.GetOutputPort("truth.robot.contacts")
    assert clearance.Eval(context)[0] == pytest.approx(0.6 - 0.12 - 0.11, abs=1e-3)
    simulator.AdvanceTo(1.5)
    assert contacts.Eval(context)[0] == 0
    simulator.AdvanceTo(4.0)
    assert contacts.Eval(context)[0] == 1
    assert clearance.Eval(context)[0] == pytest.approx(0.0, abs=1e-3)
    place = moving_places(station, context)[0]
    pose = station.GetOutputPort("truth.robot.pose").Eval(context)
    assert pose[1] == pytest.approx(place[1] + 0.12 + 0.11, abs=5e-3)
    assert pose[1] > 0.2


@pytest.mark.parametrize("dynamics", ["multibody", "kinematic"])
def test_a_cylinder_hides_a_marker_while_it_stands_before_it(dynamics: str) -> None:
    tags = "{family: 4x4_50, size: 0.15, tags: [{id: 1, position: [2.4, 1.0, 0.25], \
             facing_deg: 180}]}"
    # At the first point it stands between camera and marker; 0.6 m aside it does not.
    moving = "[{radius: 0.15, path: [[1.9, 1.0], [1.9, 1.6]], speed: 0.3, pause: 0.5}]"
    station = a_station(
        f"world.markers={tags}",
        f"world.arena.moving={moving}",
        "robot.start={x: 1.2, y: 1.0, heading_deg: 0}",
        dynamics=dynamics,
    )
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.GetInputPort("robot.drive.command").FixValue(context, [0.0, 0.0])
    detections = station.GetOutputPort("robot.front_camera.detections")
    seen = {}
    for t in (0.2, 2.3, 4.95, 7.3):
        simulator.AdvanceTo(t)
        seen[t] = detections.Eval(context).ids.tolist()
    assert seen == {0.2: [], 2.3: [1], 4.95: [], 7.3: [1]}
