"""Drivers of the wheels."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from diagrams.channels import command_signal
from diagrams.station import Robot, StationBuilder
from plants.motors import DcMotors, MotorModel, MotorParameters
from systems.controllers.wheel_drive import WheelDrive, WheelDriveParameters
from systems.controllers.wheel_pwm import WheelPwm
from systems.validation import require


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
        drive = _add_wheel_drive(station, robot, self.parameters)
        if station.simulated:
            station.connect(drive.wheel_speeds_output_port(), robot.wheel_speeds)


@dataclass
class DcMotorDrive:
    """Geared DC motors behind an L298, driven blindly: the robot knows its commands only.

    The robot's own model of the motors takes both to be nominal, without load: the real ones are
    unequal (`right_gain`, `left_gain`), have their inertia, and steps of 1/255. The station's ports
    are those of `WheelServo`. Commands are scaled down to what the nominal motors reach at full
    duty. On kinematic twins the motors are at their steady speeds at once.

    Attributes:
        parameters: limits and rate.
        motors: motors, bridge, battery.
    """

    parameters: WheelDriveParameters = field(default_factory=WheelDriveParameters)
    motors: MotorParameters = field(default_factory=MotorParameters)

    @property
    def motor(self) -> MotorModel:
        """The nominal motor."""
        return MotorModel(self.motors)

    def add(self, station: StationBuilder, robot: Robot) -> None:
        """Wires the drive into a station."""
        nominal = self.motor
        drive = _add_wheel_drive(station, robot, self.parameters, nominal.max_speed)
        if not station.simulated:
            return
        name = drive.get_name()
        pwm = station.add(WheelPwm(to_duty=nominal.duty), f"{name}.pwm")
        motors = station.add(DcMotors(parameters=self.motors), f"{name}.motors")
        station.connect(drive.wheel_speeds_output_port(), pwm.wheel_speeds_input_port())
        station.connect(pwm.pwm_output_port(), motors.pwm_input_port())
        if station.dynamics == "multibody":
            require(
                robot.wheel_rates is not None,
                f"{robot.name}.drive",
                "dc_motors",
                "wheel_servo: of this body nothing tells how the wheels turn",
            )
            station.connect(robot.wheel_rates, motors.wheel_speeds_input_port())
            station.connect(motors.servo_speeds_output_port(), robot.wheel_speeds)
        else:
            station.connect(motors.steady_speeds_output_port(), robot.wheel_speeds)


def _add_wheel_drive(
    station: StationBuilder,
    robot: Robot,
    parameters: WheelDriveParameters,
    max_wheel_speed: float = math.inf,
) -> Any:
    """Adds the sampling of the command, exports the ports of a drive, returns the block."""
    name = f"{robot.name}.drive"
    drive = station.add(
        WheelDrive(
            to_wheel_speeds=robot.body.to_wheel_speeds,
            parameters=parameters,
            max_wheel_speed=max_wheel_speed,
        ),
        name,
    )
    station.export_input(drive.command_input_port(), f"{name}.command")
    station.export_output(drive.health_output_port(), f"{name}.health")
    signal = command_signal(name, parameters.rate)
    # Played back it is what was sent when the recording was made: the estimator must not hear of
    # commands that no wheel got.
    sent = drive.sent_output_port() if station.simulated else station.play(signal)
    station.export_output(sent, signal.port, signal)
    return drive
