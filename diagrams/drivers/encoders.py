"""Driver of wheel encoders."""

from __future__ import annotations

from dataclasses import dataclass, field

from diagrams.channels import ticks_signal
from diagrams.station import Robot, StationBuilder
from systems.estimators.wheel_speeds import WheelSpeeds
from systems.sensors.wheel_encoders import WheelEncoderParameters, WheelEncoders
from systems.validation import require, require_positive


@dataclass
class Encoders:
    """Encoders on both wheels.

    Port of the station: `{robot}.{device}.ticks` (output, [right, left]).

    Attributes:
        parameters: resolution.
        rate: Hz.
    """

    parameters: WheelEncoderParameters = field(default_factory=WheelEncoderParameters)
    rate: float = 50.0

    def __post_init__(self) -> None:
        require_positive(rate=self.rate)

    def speeds(self) -> WheelSpeeds:
        """Returns the block that makes speeds of the ticks."""
        return WheelSpeeds(ticks_per_turn=self.parameters.ticks_per_turn, rate=self.rate)

    def add(self, station: StationBuilder, robot: Robot, device: str) -> None:
        """Wires the encoders into a station."""
        name = f"{robot.name}.{device}"
        signal = ticks_signal(name, self.rate, self.parameters.ticks_per_turn)
        if station.simulated:
            encoders = station.add(WheelEncoders(parameters=self.parameters, rate=self.rate), name)
            require(
                hasattr(robot.body, "wheel_angles"),
                f"{name}.type",
                "wheel_encoders",
                "a sensor that fits: of this body nothing tells how far its wheels have turned",
            )
            angles = robot.body.wheel_angles(station, robot)
            station.connect(angles, encoders.wheel_angles_input_port())
            ticks = encoders.ticks_output_port()
        else:
            ticks = station.play(signal)
        station.export_output(ticks, signal.port, signal)
