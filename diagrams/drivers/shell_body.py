"""The body of a SnailBot in a station: on the shell of another, perhaps with one of its own."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import OutputPort
from pydrake.systems.primitives import MatrixGain

from diagrams.channels import number_signal, shell_truth_signal
from diagrams.shell_world import ShellWorldParameters
from diagrams.station import Robot, StationBuilder
from plants.body_state import BodyState
from plants.magnets import MagneticAdhesion, MagnetParameters
from plants.relative_pose import RelativePose
from plants.rocking import RockingBody
from plants.rocking_motion import RockingParameters
from plants.shell import ShellParameters, add_shell
from plants.snailbot import (
    SnailBotParameters,
    add_snailbot,
    carried_shell_pose,
    servo_matrix,
    stance,
    wheel_speeds,
)
from systems.pose_vector import PoseToVector
from systems.shell.layout import misplaced
from systems.validation import require


@dataclass
class ShellStart:
    """Where a robot stands on a shell at the start.

    Attributes:
        roll_deg: heading about the outward normal, 0 toward the pole, positive to the left.
        pitch_deg: latitude.
        yaw_deg: longitude.
        on: whose shell: `reference`, or a robot that carries one; left out, that of the robot
            before it, the first one's the reference.
    """

    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    on: str = ""

    def __post_init__(self) -> None:
        for name in ("roll_deg", "pitch_deg", "yaw_deg"):
            value = getattr(self, name)
            require(math.isfinite(value), name, value, "finite")
        require(abs(self.pitch_deg) <= 90, "pitch_deg", self.pitch_deg, "from -90 to 90")

    def pose(self) -> np.ndarray:
        """Returns [roll, pitch, yaw] (rad)."""
        return np.radians([self.roll_deg, self.pitch_deg, self.yaw_deg])


@dataclass
class SnailBotBody:
    """A robot on six magnetic wheels.

    Ports of the station, of a simulated robot: `truth.{robot}.pose` (vector of 7: quaternion and
    place of base_link in the frame of the shell that it stands on, as `PoseToVector` gives them),
    `truth.{robot}.margin` (see `plants.magnets.adhesion_margin`), `truth.{robot}.detached`.

    Attributes:
        parameters: dimensions and masses.
        magnets: of the wheels.
        rocking: how the upper body, with camera and inertial sensor, sways on its springs.
        carries_shell: whether it has a shell on its back, for another robot.
        shell: what all shells are like; the world's.
    """

    parameters: SnailBotParameters = field(default_factory=SnailBotParameters)
    magnets: MagnetParameters = field(default_factory=MagnetParameters)
    rocking: RockingParameters = field(default_factory=RockingParameters)
    carries_shell: bool = False
    shell: ShellParameters = field(default_factory=ShellParameters)

    def to_wheel_speeds(self, command: list[float]) -> list[float]:
        """Returns [right, left] (rad/s) of a command [v, omega]."""
        return wheel_speeds(command, self.parameters, self.shell)

    def add_model(self, station: StationBuilder, robot: Robot) -> None:
        """Adds the robot to the plant, where it starts."""
        plant, world = station.plant, station.world
        assert isinstance(world, ShellWorldParameters)
        known = ", ".join(station.shells)
        require(
            robot.on in station.shells,
            f"{robot.name}.start.on",
            robot.on,
            f"whose shell is there before it: {known}",
        )
        robot.model = add_snailbot(plant, self.parameters, self.shell, robot.name)
        base = plant.GetBodyByName("base_link", robot.model)
        X_WR = station.shells[robot.on].X_WR
        X_WB = X_WR @ stance(robot.start, self.parameters, self.shell)
        plant.SetDefaultFloatingBaseBodyPose(base, X_WB)
        if self.carries_shell:
            X_BR = carried_shell_pose(self.parameters, self.shell)
            model = add_shell(plant, self.shell, f"{robot.name}_shell", base.body_frame(), X_BR)
            # Each shell's markers are misplaced in their own way.
            seed = station.seed + 2**53 * len(station.shells)
            bound = math.radians(world.placement_tolerance_deg)
            markers = misplaced(station.marker_map, bound=bound, seed=seed)
            world.finish_shell(station, robot.name, model, X_WB @ X_BR, markers)

    def add_state(self, station: StationBuilder, robot: Robot) -> None:
        """Adds what says where the robot is and takes its wheel speeds; exports the truth."""
        plant = station.plant
        base = plant.GetBodyByName("base_link", robot.model)
        robot.frame_id = plant.GetBodyFrameIdOrThrow(base.index())
        if self.rocking.bound > 0:
            robot.state = RockingBody.AddToBuilder(
                station.builder,
                plant,
                robot.model,
                station.scene_graph,
                parameters=self.rocking,
                seed=station.seed,
                name=f"{robot.name}.rocking",
            )
            robot.frame_id = robot.state.frame_id
        else:
            robot.state = BodyState.AddToBuilder(station.builder, plant, robot.model)
            robot.state.set_name(f"{robot.name}.state")
        servos = station.add(
            MatrixGain(servo_matrix(plant, robot.model, self.parameters, self.shell)),
            f"{robot.name}.servos",
        )
        station.connect(servos.get_output_port(), plant.get_desired_state_input_port(robot.model))
        robot.wheel_speeds = servos.get_input_port()
        self._add_magnets(station, robot)
        self._add_truth(station, robot)

    def _add_magnets(self, station: StationBuilder, robot: Robot) -> None:
        plant = station.plant
        adhesion = station.add(
            MagneticAdhesion(
                plant=plant,
                model=robot.model,
                shell=station.shells[robot.on].model,
                wheel_radius=self.parameters.wheel_radius,
                shell_parameters=self.shell,
                parameters=self.magnets,
                carried=carried_by(station, robot.name),
            ),
            f"{robot.name}.magnets",
        )
        station.connect(plant.get_state_output_port(), adhesion.state_input_port())
        station.pulls.append(adhesion.generalized_forces_output_port())
        for name, rate in (("margin", 10.0), ("detached", 10.0)):
            signal = number_signal(f"truth.{robot.name}.{name}", rate)
            station.export_output(adhesion.GetOutputPort(name), signal.port, signal)

    def _add_truth(self, station: StationBuilder, robot: Robot) -> None:
        pose = station.add(
            RelativePose(parent=station.shells[robot.on].frame_id, child=robot.frame_id),
            f"{robot.name}.true_pose",
        )
        station.connect(station.scene_graph.get_query_output_port(), pose.query_object_input_port())
        vector = station.add(PoseToVector(), f"truth.{robot.name}")
        station.connect(pose.pose_output_port(), vector.pose_input_port())
        signal = shell_truth_signal(robot.name)
        station.export_output(vector.vector_output_port(), signal.port, signal)

    def play_state(self, station: StationBuilder, robot: Robot) -> None:
        """Exports the truth of a recorded simulation, if the recording has it."""
        name = robot.name
        for signal in (
            shell_truth_signal(name),
            number_signal(f"truth.{name}.margin", 10.0),
            number_signal(f"truth.{name}.detached", 10.0),
        ):
            port: OutputPort | None = station.play(signal, optional=True)
            if port is not None:
                station.export_output(port, signal.port, signal)


def carried_by(station: StationBuilder, name: str) -> list[ModelInstanceIndex]:
    """Returns the model instances that a robot carries: its shell, who stands on it, and so on."""
    carried = []
    if name in station.shells:
        carried.append(station.shells[name].model)
        for other in station.robots.values():
            if other.on == name:
                carried += [other.model, *carried_by(station, other.name)]
    return carried
