"""Drivers of lidars: simulated, or played back."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from diagrams.channels import scan_signal
from diagrams.station import Robot, StationBuilder
from systems.sensors import lidar
from systems.validation import require, require_non_negative


@dataclass
class Lidar:
    """A turning lidar that scans a plane parallel to the ground: an RPLIDAR A1M8.

    Port of the station: `{robot}.{device}.scan` (Scan). It looks through the robot that carries it.

    Attributes:
        parameters: rate, limits and noise.
        latency: from the last ray of a turn to the arrival of the scan, s.
        position: [x, y, z] of the middle of the scan plane in base_link, m.
        yaw_deg: where the lidar's x axis points in base_link, positive to the left.
    """

    parameters: lidar.LidarParameters = field(default_factory=lidar.LidarParameters)
    latency: float = 0.0
    position: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.14])
    yaw_deg: float = 0.0

    def __post_init__(self) -> None:
        require_non_negative(latency=self.latency)
        require(
            len(self.position) == 3 and bool(np.isfinite(self.position).all()),
            "position",
            self.position,
            "[x, y, z] in metres",
        )
        require(math.isfinite(self.yaw_deg), "yaw_deg", self.yaw_deg, "finite")

    def mounting(self) -> RigidTransform:
        """Returns `X_BL`, the pose of the lidar in base_link."""
        return RigidTransform(RollPitchYaw(0.0, 0.0, math.radians(self.yaw_deg)), self.position)

    def planar_mounting(self) -> NDArray[np.float64]:
        """Returns [x (m), y (m), yaw (rad)] of the lidar in base_link."""
        return np.array([*self.position[:2], math.radians(self.yaw_deg)])

    def add(self, station: StationBuilder, robot: Robot, device: str) -> None:
        """Wires the lidar into a station."""
        name = f"{robot.name}.{device}"
        frame_id = name.replace(".", "/")
        station.mountings[frame_id] = (robot.name, self.mounting())
        signal = scan_signal(name, self.parameters.rate)
        if station.simulated:
            plant = station.plant
            own = [plant.GetBodyFrameIdOrThrow(i) for i in plant.GetBodyIndices(robot.model)]
            sensor = station.add(
                lidar.Lidar(
                    parent_frame=robot.frame_id,
                    X_PL=self.mounting(),
                    parameters=self.parameters,
                    latency=self.latency,
                    seed=station.seed,
                    name=name,
                    frame_id=frame_id,
                    transparent_frames=own,
                ),
                name,
            )
            station.connect(
                station.scene_graph.get_query_output_port(), sensor.query_object_input_port()
            )
            station.connect(
                robot.state.GetOutputPort("spatial_velocity"), sensor.spatial_velocity_input_port()
            )
            scan = sensor.scan_output_port()
        else:
            scan = station.play(signal)
        station.export_output(scan, signal.port, signal)
