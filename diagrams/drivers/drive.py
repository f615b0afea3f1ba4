"""Drivers of the wheels."""

from __future__ import annotations

from dataclasses import dataclass, field

from diagrams.channels import command_signal
from diagrams.station import Robot, StationBuilder
from systems.controllers.wheel_drive import WheelDrive, WheelDriveParameters


@dataclass
class WheelServo:
    """Wheels that follow the commanded speed within their torque.

    Ports of the station: `{robot}.drive.command` (input, [v, omega]), `{robot}.drive.sent`
    (output, the command after the limits, as the robot knows it), `{robot}.drive.health`.

    Attributes:
        parameters: limits and rate.
    """

    parameters: WheelDriveParameters = field(default_factory=WheelDriveParameters)

    def add(self, station: StationBuilder, robot: Robot) -> None:
        """Wires the drive into a station."""
        name = f"{robot.name}.drive"
        drive = station.add(
            WheelDrive(to_wheel_speeds=robot.body.to_wheel_speeds, parameters=self.parameters),
            name,
        )
        station.export_input(drive.command_input_port(), f"{name}.command")
        station.export_output(drive.health_output_port(), f"{name}.health")
        signal = command_signal(name, self.parameters.rate)
        if station.simulated:
            station.connect(drive.wheel_speeds_output_port(), robot.wheel_speeds)
            sent = drive.sent_output_port()
        else:
            # What was sent when the recording was made: the estimator must not hear of commands
            # that no wheel got.
            sent = station.play(signal)
        station.export_output(sent, signal.port, signal)
