"""Drivers of inertial sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from diagrams.channels import imu_signal
from diagrams.station import Robot, StationBuilder
from systems.estimators.gyro_yaw import GyroYaw
from systems.sensors.imu import Imu
from systems.sensors.imu_parameters import Bmi088Parameters, ImuParameters, Mpu6050Parameters
from systems.validation import require, require_non_negative, require_positive


@dataclass
class InertialSensor:
    """A gyro and an accelerometer, in the body's axes.

    Port of the station: `{robot}.{device}.sample` (output, [gyro, accel]).

    Attributes:
        parameters: errors.
        rate: Hz.
        position: [x, y, z] in base_link, m.
        calibration: for so long after the start the offsets are measured, s; they are taken off all
            later samples (see `GyroYaw`). The robot must stand: give its drive as long a `rest`.
    """

    parameters: ImuParameters = field(default_factory=ImuParameters)
    rate: float = 100.0
    position: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.05])
    calibration: float = 0.0

    def __post_init__(self) -> None:
        require_positive(rate=self.rate)
        require_non_negative(calibration=self.calibration)
        require(
            len(self.position) == 3 and bool(np.isfinite(self.position).all()),
            "position",
            self.position,
            "[x, y, z] in metres",
        )

    def add(self, station: StationBuilder, robot: Robot, device: str) -> None:
        """Wires the sensor into a station."""
        name = f"{robot.name}.{device}"
        p = self.parameters
        signal = imu_signal(name, self.rate, p.gyro_noise_density, p.accel_noise_density)
        if not station.simulated:  # the offsets were taken off before it was recorded
            station.export_output(station.play(signal), signal.port, signal)
            return
        imu = station.add(
            Imu(
                parameters=self.parameters,
                rate=self.rate,
                p_BS=np.array(self.position),
                seed=station.seed,
                name=name,
            ),
            name,
        )
        for port in ("pose", "spatial_velocity", "spatial_acceleration"):
            station.connect(robot.state.GetOutputPort(port), imu.GetInputPort(port))
        sample = imu.sample_output_port()
        if self.calibration > 0:
            rest = getattr(getattr(robot.drive, "parameters", None), "rest", math.inf)
            require(
                self.calibration <= rest,
                f"{name}.calibration",
                self.calibration,
                f"at most the {rest:g} s that {robot.name}.drive.rest makes the robot stand",
            )
            yaw = GyroYaw(rate=self.rate, num_samples=math.ceil(self.calibration * self.rate))
            station.add(yaw, f"{name}.offsets")
            station.connect(sample, yaw.imu_input_port())
            sample = yaw.sample_output_port()
        station.export_output(sample, signal.port, signal)


@dataclass
class Mpu6050(InertialSensor):
    """The MPU-6050, by its data sheet; its offsets are measured in the first second."""

    parameters: Mpu6050Parameters = field(default_factory=Mpu6050Parameters)
    calibration: float = 1.0


@dataclass
class Bmi088(InertialSensor):
    """The BMI088, by its data sheet, in base_link's origin; the estimator finds its offsets."""

    parameters: Bmi088Parameters = field(default_factory=Bmi088Parameters)
    rate: float = 300.0
    position: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
