"""The body of a differential-drive robot in a station: multibody model or kinematic twin."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import BasicVector
from pydrake.systems.primitives import MatrixGain

from diagrams.channels import truth_signal
from diagrams.station import Robot, StationBuilder
from plants.body_state import BodyState, TwinState
from plants.differential_drive import (
    DifferentialDriveParameters,
    KinematicDifferentialDrive,
    add_differential_drive,
    hull_radius,
    wheel_speeds,
)
from systems.angles import spatial_pose


@dataclass
class DifferentialDriveBody:
    """A robot on two driven wheels.

    Attributes:
        parameters: dimensions and masses.
    """

    parameters: DifferentialDriveParameters = field(default_factory=DifferentialDriveParameters)

    @property
    def hull_radius(self) -> float:
        """Radius of the circle that holds the robot, m."""
        return hull_radius(self.parameters)

    def to_wheel_speeds(self, command: np.ndarray) -> list[float]:
        """Returns [right, left] (rad/s) of a command [v, omega]."""
        return wheel_speeds(command, self.parameters)

    def add_model(self, plant: MultibodyPlant, robot: Robot) -> None:
        """Adds the robot to the plant, at its start."""
        robot.model = add_differential_drive(plant, self.parameters, robot.name)
        body = plant.GetBodyByName("base_link", robot.model)
        plant.SetDefaultFloatingBaseBodyPose(body, spatial_pose(robot.start))

    def add_state(self, station: StationBuilder, robot: Robot) -> None:
        """Adds what says where the robot is and takes its wheel speeds; exports the truth."""
        plant = station.plant
        body = plant.GetBodyByName("base_link", robot.model)
        robot.frame_id = plant.GetBodyFrameIdOrThrow(body.index())
        if station.dynamics == "multibody":
            robot.state = BodyState.AddToBuilder(station.builder, plant, robot.model)
            robot.state.set_name(f"{robot.name}.state")
            # The servos follow the speeds; their gain on positions is zero.
            to_servos = np.vstack([np.zeros((2, 2)), np.eye(2)])
            servos = station.add(MatrixGain(to_servos), f"{robot.name}.servos")
            station.connect(
                servos.get_output_port(), plant.get_desired_state_input_port(robot.model)
            )
            robot.wheel_speeds = servos.get_input_port()
        else:
            twin = KinematicDifferentialDrive(parameters=self.parameters)
            # Declared anew for its default value, which is where the robot starts.
            twin.DeclareContinuousState(BasicVector(robot.start))
            station.add(twin, f"{robot.name}.twin")
            robot.state = station.add(TwinState(), f"{robot.name}.state")
            for name in ("pose", "velocity"):
                station.connect(twin.GetOutputPort(name), robot.state.GetInputPort(f"twin_{name}"))
            robot.twin = twin
            robot.wheel_speeds = twin.wheel_speeds_input_port()
        station.export_output(
            robot.state.GetOutputPort("planar_pose"),
            f"truth.{robot.name}.pose",
            truth_signal(robot.name),
        )

    def play_state(self, station: StationBuilder, robot: Robot) -> None:
        """Exports the truth of a recorded simulation, if the recording has it."""
        signal = truth_signal(robot.name)
        port = station.play(signal, optional=True)
        if port is not None:
            station.export_output(port, signal.port, signal)
