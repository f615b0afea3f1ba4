from __future__ import annotations

from typing import Any

import pytest
from pydrake.systems.framework import Diagram, InputPort, OutputPort, PortDataType, System

from diagrams.scenario import load_scenario
from diagrams.station import Station

Port = tuple[str, str, int, str]

SENSORS = ("robot.imu", "robot.front_camera", "robot.front_camera.projector")
WORLD = ("plant", "scene_graph", "robot.state", "robot.twin", "robot.servos")


def station(*overrides: str) -> Station:
    return load_scenario("navigation_open", overrides).build().station


def ports(system: System) -> set[Port]:
    """Every port: direction and name, kind, size, type of its messages."""
    found = set()
    inputs = [system.get_input_port(k) for k in range(system.num_input_ports())]
    outputs = [system.get_output_port(k) for k in range(system.num_output_ports())]
    for direction, entries in (("in", inputs), ("out", outputs)):
        for port in entries:
            kind = str(port.get_data_type())
            message = ""
            if port.get_data_type() == PortDataType.kAbstractValued and direction == "out":
                message = type(port.Allocate().get_value()).__name__
            found.add((f"{direction} {port.get_name()}", kind, port.size(), message))
    return found


def without_truth(found: set[Port]) -> set[Port]:
    return {port for port in found if not port[0].startswith("out truth.")}


@pytest.fixture(scope="module")
def simulated() -> dict[str, set[Port]]:
    return {
        f"{sight}, {dynamics}": ports(station(f"sight={sight}", f"dynamics={dynamics}"))
        for sight in ("rendered", "projected")
        for dynamics in ("multibody", "kinematic")
    }


def test_the_ports_are_those_that_the_design_names(simulated: dict[str, set[Port]]) -> None:
    vector, abstract = str(PortDataType.kVectorValued), str(PortDataType.kAbstractValued)
    assert simulated["rendered, multibody"] == {
        ("in robot.drive.command", vector, 2, ""),
        ("in robot.front_camera.active", vector, 1, ""),
        ("out robot.drive.sent", vector, 2, ""),
        ("out robot.drive.health", abstract, 0, "Health"),
        ("out robot.front_camera.image", abstract, 0, "CameraImage"),
        ("out robot.front_camera.detections", abstract, 0, "Detections"),
        ("out robot.front_camera.health", abstract, 0, "Health"),
        ("out robot.imu.sample", vector, 6, ""),
        ("out scene.query_object", abstract, 0, "QueryObject"),
        ("out truth.robot.clearance", vector, 1, ""),
        ("out truth.robot.contacts", vector, 1, ""),
        ("out truth.robot.pose", vector, 3, ""),
    }


def test_the_ports_do_not_depend_on_how_signals_are_simulated(
    simulated: dict[str, set[Port]],
) -> None:
    first, *others = simulated.values()
    for other in others:
        assert other == first


def test_a_played_back_station_has_the_ports_of_a_simulated_one(
    simulated: dict[str, set[Port]], navigation: Any, rendered: Any
) -> None:
    expected = without_truth(simulated["rendered, multibody"])
    for run in (navigation, rendered):  # without recorded pictures and with them
        played = ports(station(f"recording={run.bag}"))
        assert without_truth(played) == expected
        # A recording of a simulation knows the truth, as a simulation does.
        assert played == simulated["rendered, multibody"]


# What feeds what, down to the blocks of nested diagrams.


def leaves(diagram: Diagram) -> list[System]:
    found = []
    for system in diagram.GetSystems():
        found += leaves(system) if isinstance(system, Diagram) else [system]
    return found


def source(port: OutputPort) -> System:
    system = port.get_system()
    while isinstance(system, Diagram):
        inner, index = system.get_output_port_locator(port.get_index())
        port, system = inner.get_output_port(index), inner
    return system


def targets(port: InputPort) -> list[System]:
    system = port.get_system()
    if not isinstance(system, Diagram):
        return [system]
    locators = system.GetInputPortLocators(port.get_index())
    return [t for inner, index in locators for t in targets(inner.get_input_port(index))]


def feeds(diagram: Diagram) -> dict[str, set[str]]:
    """Name of each block to the names of those whose outputs it reads."""
    found: dict[str, set[str]] = {leaf.get_name(): set() for leaf in leaves(diagram)}

    def visit(diagram: Diagram) -> None:
        for (system, index), (origin, output) in diagram.connection_map().items():
            for target in targets(system.get_input_port(index)):
                found[target.get_name()].add(source(origin.get_output_port(output)).get_name())
        for system in diagram.GetSystems():
            if isinstance(system, Diagram):
                visit(system)

    visit(diagram)
    return found


@pytest.mark.parametrize("dynamics", ["multibody", "kinematic"])
@pytest.mark.parametrize("sight", ["rendered", "projected"])
def test_the_robot_knows_the_world_by_its_sensors_only(sight: str, dynamics: str) -> None:
    overrides = [f"sight={sight}", f"dynamics={dynamics}"]
    reads = feeds(load_scenario("navigation_open", overrides).build().diagram)
    robot = {"robot.drive", "localizer", "estimator", "sequencer", "controller", "search"}
    known: set[str] = set()
    front = set(robot)
    while front:
        block = front.pop()
        known.add(block)
        if block not in SENSORS:
            front |= reads[block] - known
    assert robot < known
    assert known & set(SENSORS) == {
        "robot.imu",
        "robot.front_camera" if sight == "rendered" else "robot.front_camera.projector",
    }
    assert not known & set(WORLD)
    # The walk would have met the world, had it gone on behind the sensors.
    assert set().union(*(reads[sensor] for sensor in SENSORS if sensor in reads)) & set(WORLD)


def test_only_those_who_watch_read_the_truth(tmp_path: Any) -> None:
    scenario = load_scenario("navigation_open", ["sight=projected"])
    mission = scenario.build(out=tmp_path)
    mission.recorder.close()
    readers = {
        system.get_name()
        for (system, _), (origin, output) in mission.diagram.connection_map().items()
        if origin is mission.station
        and origin.get_output_port(output).get_name().startswith("truth.")
    }
    watched = {f"log of truth.robot.{kind}" for kind in ("pose", "clearance", "contacts")}
    assert readers == {*watched, "recorder"}
