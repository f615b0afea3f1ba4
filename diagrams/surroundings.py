"""What a station does about obstacles: those that move, and the truth about clearance and contacts.

A simulated station, or the recording of one, exports `truth.{robot}.clearance` and
`truth.{robot}.contacts` (see `plants.clearance`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.systems.framework import OutputPort
from pydrake.systems.primitives import Adder, AffineSystem, MatrixGain, Multiplexer
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from diagrams.channels import Signal
from plants.arena import ArenaParameters
from plants.body_state import TwinPositions
from plants.clearance import ClearanceMonitor
from plants.footprint import footprint
from plants.moving import MODEL, MovingObstacles, starting_points
from systems.io.ros_types import message_class
from systems.io.stencils import Stencil

if TYPE_CHECKING:
    from diagrams.station import Robot, StationBuilder


def add_motion(station: StationBuilder, arena: ArenaParameters, robots: int) -> OutputPort | None:
    """Makes the moving obstacles move in a multibody plant.

    Args:
        station: its plant is finalized.
        arena: what stands and moves there.
        robots: how many there are, for whom the obstacles may wait (see `let_wait`).

    Returns:
        The port of their true positions, [x, y, ...] (m); None when nothing moves.
    """
    moving = arena.moving
    if not moving:
        return None
    motion = station.add(MovingObstacles(cylinders=moving, robots=robots), "moving")
    if station.dynamics == "kinematic":
        return motion.positions_output_port()
    plant = station.plant
    model = plant.GetModelInstanceByName(MODEL)
    station.connect(motion.desired_state_output_port(), plant.get_desired_state_input_port(model))
    starts = starting_points(moving)
    n = len(starts)
    to_positions = AffineSystem(
        A=np.zeros((0, 0)),
        B=np.zeros((0, 2 * n)),
        f0=np.zeros(0),
        C=np.zeros((n, 0)),
        D=np.eye(n, 2 * n),
        y0=starts,
    )
    positions = station.add(to_positions, "moving_positions")
    station.connect(plant.get_state_output_port(model), positions.get_input_port())
    return positions.get_output_port()


def let_wait(station: StationBuilder, arena: ArenaParameters, robots: list[Robot]) -> None:
    """Shows moving obstacles where the robots are, if there are such obstacles.

    Args:
        station: with `add_motion` done.
        arena: what stands and moves there.
        robots: all of them, with their states.
    """
    if not arena.moving:
        return
    poses = station.add(Multiplexer([3] * len(robots)), "robot_poses")
    for k, robot in enumerate(robots):
        station.connect(robot.state.GetOutputPort("planar_pose"), poses.get_input_port(k))
    motion = station.builder.GetSubsystemByName("moving")
    station.connect(poses.get_output_port(), motion.GetInputPort("robots"))


def show_twins(station: StationBuilder, arena: ArenaParameters, robots: list[Robot]) -> None:
    """Moves the geometry of kinematic twins and of moving obstacles.

    Args:
        station: whose plant is a model only, not simulated.
        arena: what stands and moves there.
        robots: those that have a twin.
    """
    plant = station.plant
    to_geometry = station.add(
        MultibodyPositionToGeometryPose(plant, input_multibody_state=False), "twin_geometry"
    )
    source = plant.get_source_id()
    station.connect(to_geometry.get_output_port(), station.scene_graph.get_source_pose_port(source))
    twins = station.add(
        TwinPositions(plant=plant, models=[robot.name for robot in robots]), "twin_positions"
    )
    for robot in robots:
        station.connect(robot.twin.pose_output_port(), twins.GetInputPort(robot.name))
    positions = twins.get_output_port()
    if arena.moving:
        positions = _with_moving(station, positions)
    station.connect(positions, to_geometry.get_input_port())


def _with_moving(station: StationBuilder, positions: OutputPort) -> OutputPort:
    """Adds the displacements of the moving obstacles to positions in which they are zero."""
    plant = station.plant
    model = plant.GetModelInstanceByName(MODEL)
    n = plant.num_positions(model)
    from_plant = np.zeros((2 * n, plant.num_positions()))
    for row, displacement in zip(from_plant, np.eye(n), strict=False):
        plant.SetPositionsInArray(model, displacement, row)
    gain = station.add(MatrixGain(from_plant.T), "moving_positions")
    motion = station.builder.GetSubsystemByName("moving")
    station.connect(motion.GetOutputPort("desired_state"), gain.get_input_port())
    both = station.add(Adder(2, plant.num_positions()), "all_positions")
    station.connect(positions, both.get_input_port(0))
    station.connect(gain.get_output_port(), both.get_input_port(1))
    return both.get_output_port()


def add_clearance(
    station: StationBuilder, arena: ArenaParameters, robot: Robot, moving: OutputPort | None
) -> None:
    """Exports the truth about a robot's clearance and contacts, or plays it back if recorded.

    Args:
        station: its plant is finalized.
        arena: what stands and moves there.
        robot: whose truth it is.
        moving: port of the moving obstacles' positions, if any.
    """
    signals = [clearance_signal(robot.name), contacts_signal(robot.name)]
    if not station.simulated:
        for signal in signals:
            port = station.play(signal, optional=True)
            if port is not None:
                station.export_output(port, signal.port, signal)
        return
    monitor = station.add(
        ClearanceMonitor(
            footprint=footprint(station.plant, station.scene_graph.model_inspector(), robot.model),
            standing=arena.footprints(),
            moving_radii=[cylinder.radius for cylinder in arena.moving],
        ),
        f"truth.{robot.name}",
    )
    station.connect(robot.state.GetOutputPort("planar_pose"), monitor.pose_input_port())
    if moving is not None:
        station.connect(moving, monitor.moving_input_port())
    ports = (monitor.clearance_output_port(), monitor.contacts_output_port())
    for port, signal in zip(ports, signals, strict=True):
        station.export_output(port, signal.port, signal)


def clearance_signal(robot: str) -> Signal:
    """Returns the signal of the distance from a robot's hull to the nearest obstacle, m."""
    return Signal(
        port=f"truth.{robot}.clearance",
        topic=f"/truth/{robot}/clearance",
        encode=Stencil(lambda _: message_class("std_msgs/msg/Float64")(np.nan)),
        decode=_number,
        model=1,
        rate=10.0,
        played=False,
    )


def contacts_signal(robot: str) -> Signal:
    """Returns the signal of how often a robot touched something so far."""
    return Signal(
        port=f"truth.{robot}.contacts",
        topic=f"/truth/{robot}/contacts",
        encode=lambda value, _: message_class("std_msgs/msg/UInt32")(int(value[0])),
        decode=_number,
        model=1,
        rate=10.0,
        played=False,
    )


def _number(message: Any) -> np.ndarray:
    return np.array([float(message.data)])
