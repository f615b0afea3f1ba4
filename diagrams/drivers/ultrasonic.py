"""Drivers of rings of ultrasonic range finders: simulated, or played back."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from diagrams.channels import scan_signal
from diagrams.station import Robot, StationBuilder
from systems.planners.sonar_obstacles import RingGeometry
from systems.sensors.ultrasonic import UltrasonicParameters, UltrasonicRing
from systems.validation import require, require_non_negative


@dataclass
class UltrasonicDriver:
    """Ultrasonic range finders evenly around a robot: HC-SR04s.

    Port of the station: `{robot}.{device}.scan` (Scan). They hear through the robot that carries
    them, and all that stands on the ground. The ground itself must be out of their reach: a real
    floor throws the sound ahead, one in the simulation would echo.

    Attributes:
        parameters: arrangement, rate, limits and noise.
        latency: from a measurement to the arrival of the scan, s.
        position: [x, y, z] of their middle in base_link, m.
        yaw_deg: where the first of them looks in base_link, positive to the left.
    """

    parameters: UltrasonicParameters = field(
        default_factory=lambda: UltrasonicParameters(range_max=2.6)
    )
    latency: float = 0.0
    position: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.35])
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
        p = self.parameters
        height = self.position[2]
        floor = height / math.sin(p.half_angle)
        require(
            p.range_max <= floor,
            "range_max",
            p.range_max,
            f"at most {floor:.3g} m, where the cones meet the floor from {height:g} m above it",
        )

    def mounting(self) -> RigidTransform:
        """Returns `X_BU`, the pose of their middle in base_link."""
        return RigidTransform(RollPitchYaw(0.0, 0.0, math.radians(self.yaw_deg)), self.position)

    def ring(self) -> RingGeometry:
        """Returns where they are, as a map that is made of their scans needs it."""
        pose = np.array([*self.position[:2], math.radians(self.yaw_deg)])
        return RingGeometry(pose, self.parameters.offset, self.parameters.half_angle)

    def add(self, station: StationBuilder, robot: Robot, device: str) -> None:
        """Wires them into a station."""
        name = f"{robot.name}.{device}"
        frame_id = name.replace(".", "/")
        station.mountings[frame_id] = (robot.name, self.mounting())
        signal = scan_signal(name, self.parameters.rate)
        if station.simulated:
            plant = station.plant
            own = [plant.GetBodyFrameIdOrThrow(i) for i in plant.GetBodyIndices(robot.model)]
            sensor = station.add(
                UltrasonicRing(
                    parent_frame=robot.frame_id,
                    X_PU=self.mounting(),
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
            scan = sensor.scan_output_port()
        else:
            scan = station.play(signal)
        station.export_output(scan, signal.port, signal)
