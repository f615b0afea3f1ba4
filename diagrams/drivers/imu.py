"""Drivers of inertial sensors."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from diagrams.channels import imu_signal
from diagrams.station import Robot, StationBuilder
from systems.sensors.imu import Imu, ImuParameters
from systems.validation import require, require_positive


@dataclass
class InertialSensor:
    """A gyro and an accelerometer, in the body's axes.

    Port of the station: `{robot}.{device}.sample` (output, [gyro, accel]).

    Attributes:
        parameters: noise and bias.
        rate: Hz.
        position: [x, y, z] in base_link, m.
    """

    parameters: ImuParameters = field(default_factory=ImuParameters)
    rate: float = 100.0
    position: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.05])

    def __post_init__(self) -> None:
        require_positive(rate=self.rate)
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
        if station.simulated:
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
        else:
            sample = station.play(signal)
        station.export_output(sample, signal.port, signal)
