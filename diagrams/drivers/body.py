"""Bodies of robots with two driven sides in a station: multibody model or kinematic twin."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

from pydrake.systems.framework import BasicVector, OutputPort
from pydrake.systems.primitives import Integrator, MatrixGain, PassThrough

from diagrams.channels import truth_signal
from diagrams.station import Robot, StationBuilder
from diagrams.viewer import Ghost, ghost_of
from plants.body_state import BodyState, TwinState
from plants.differential_drive import (
    DifferentialDriveParameters,
    KinematicDifferentialDrive,
    add_differential_drive,
    hull,
    hull_radius,
)
from plants.marker_ring import SIDES, MarkerRing, add_marker_ring
from plants.wheels import Sides, joint_matrices, servo_matrix, wheel_speeds
from systems.angles import spatial_pose


class WheeledBody(ABC):
    """What all robots with two driven sides have in a station; a subclass says what they are."""

    @property
    @abstractmethod
    def sides(self) -> Sides:
        """Its kinematics."""

    @property
    @abstractmethod
    def hull_radius(self) -> float:
        """Radius of the circle that holds the robot, m."""

    @property
    @abstractmethod
    def hull(self) -> list[float]:
        """[front, rear, half_width] of the rectangle about base_link that holds the robot, m."""

    @abstractmethod
    def ghost(self) -> Ghost:
        """Returns how it looks where it believes to be."""

    @abstractmethod
    def add_model(self, station: StationBuilder, robot: Robot) -> None:
        """Adds the robot to the plant, at its start."""

    def to_wheel_speeds(self, command: list[float]) -> list[float]:
        """Returns [right, left] (rad/s) of a command [v, omega]."""
        return wheel_speeds(command, self.sides)

    def add_state(self, station: StationBuilder, robot: Robot) -> None:
        """Adds what says where the robot is and takes its wheel speeds; exports the truth."""
        plant = station.plant
        body = plant.GetBodyByName("base_link", robot.model)
        robot.frame_id = plant.GetBodyFrameIdOrThrow(body.index())
        if station.dynamics == "multibody":
            robot.state = BodyState.AddToBuilder(station.builder, plant, robot.model)
            robot.state.set_name(f"{robot.name}.state")
            servos = station.add(
                MatrixGain(servo_matrix(plant, robot.model)), f"{robot.name}.servos"
            )
            station.connect(
                servos.get_output_port(), plant.get_desired_state_input_port(robot.model)
            )
            robot.wheel_speeds = servos.get_input_port()
            for name, matrix in zip(
                ("wheel_angles", "wheel_rates"), joint_matrices(plant, robot.model), strict=True
            ):
                gain = station.add(MatrixGain(matrix), f"{robot.name}.{name}")
                station.connect(plant.get_state_output_port(robot.model), gain.get_input_port())
                setattr(robot, name, gain.get_output_port())
        else:
            twin = KinematicDifferentialDrive(parameters=self.sides)
            # Declared anew for its default value, which is where the robot starts.
            twin.DeclareContinuousState(BasicVector(robot.start))
            station.add(twin, f"{robot.name}.twin")
            robot.state = station.add(TwinState(), f"{robot.name}.state")
            for name in ("pose", "velocity"):
                station.connect(twin.GetOutputPort(name), robot.state.GetInputPort(f"twin_{name}"))
            robot.twin = twin
            wheels = station.add(PassThrough(2), f"{robot.name}.wheels")
            station.connect(wheels.get_output_port(), twin.wheel_speeds_input_port())
            robot.wheel_speeds = wheels.get_input_port()
            robot.wheel_rates = wheels.get_output_port()
        station.export_output(
            robot.state.GetOutputPort("planar_pose"),
            f"truth.{robot.name}.pose",
            truth_signal(robot.name),
        )

    def wheel_angles(self, station: StationBuilder, robot: Robot) -> OutputPort:
        """Returns the port of the wheels' angles [right, left] (rad); a twin has none until now."""
        if robot.wheel_angles is None:
            integrator = station.add(Integrator(2), f"{robot.name}.wheel_angles")
            station.connect(robot.wheel_rates, integrator.get_input_port())
            robot.wheel_angles = integrator.get_output_port()
        port: OutputPort = robot.wheel_angles
        return port

    def play_state(self, station: StationBuilder, robot: Robot) -> None:
        """Exports the truth of a recorded simulation, if the recording has it."""
        signal = truth_signal(robot.name)
        port = station.play(signal, optional=True)
        if port is not None:
            station.export_output(port, signal.port, signal)


@dataclass
class DifferentialDriveBody(WheeledBody):
    """A robot on two driven wheels.

    Attributes:
        parameters: dimensions and masses.
        ring: markers on its four sides, for other robots to see: the first robot with such a ring
            bears the ids 0 to 3 (front, left, back, right), the next 4 to 7, and so on.
    """

    parameters: DifferentialDriveParameters = field(default_factory=DifferentialDriveParameters)
    ring: MarkerRing | None = None

    @property
    def sides(self) -> Sides:
        """Its kinematics."""
        return self.parameters

    @property
    def hull_radius(self) -> float:
        """Radius of the circle that holds the robot, m."""
        return hull_radius(self.parameters)

    @property
    def hull(self) -> list[float]:
        """[front, rear, half_width] of the rectangle about base_link that holds the robot, m."""
        return hull(self.parameters)

    def ghost(self) -> Ghost:
        """Returns how it looks where it believes to be."""
        p = self.parameters
        return ghost_of(
            length=p.length,
            width=p.width,
            clearance=p.clearance,
            height=p.clearance + p.height,
            wheels={"right_wheel": (0.0, -p.base / 2), "left_wheel": (0.0, p.base / 2)},
            wheel_radius=p.wheel_radius,
            wheel_width=p.wheel_width,
        )

    def add_model(self, station: StationBuilder, robot: Robot) -> None:
        """Adds the robot to the plant, at its start.

        Its wheels are turned by the `motor` (a `MotorModel`) of its drive, else by speed servos.
        """
        plant = station.plant
        motor = getattr(robot.drive, "motor", None)
        robot.model = add_differential_drive(plant, self.parameters, robot.name, motor)
        body = plant.GetBodyByName("base_link", robot.model)
        plant.SetDefaultFloatingBaseBodyPose(body, spatial_pose(robot.start))
        if self.ring is not None:
            station.carried_markers[robot.name] = add_marker_ring(
                plant,
                body,
                self.ring,
                family=station.marker_map.family,
                first_id=len(SIDES) * len(station.carried_markers),
            )
