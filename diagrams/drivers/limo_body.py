"""The body of a LIMO in a station."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from diagrams.drivers.body import WheeledBody
from diagrams.station import Robot, StationBuilder
from diagrams.viewer import Ghost, ghost_of
from plants.limo import LimoParameters, add_limo, hull
from plants.wheels import Sides
from systems.angles import spatial_pose
from systems.validation import require


@dataclass
class LimoBody(WheeledBody):
    """A LIMO in its differential mode; its kinematics have the effective track.

    Attributes:
        parameters: dimensions and masses.
    """

    parameters: LimoParameters = field(default_factory=LimoParameters)

    @property
    def sides(self) -> Sides:
        """Its kinematics."""
        return self.parameters

    @property
    def hull_radius(self) -> float:
        """Radius of the circle that holds the robot, m."""
        front, _, half_width = self.hull
        return math.hypot(front, half_width)

    @property
    def hull(self) -> list[float]:
        """[front, rear, half_width] of the rectangle about base_link that holds the robot, m."""
        return hull(self.parameters)

    def ghost(self) -> Ghost:
        """Returns how it looks where it believes to be."""
        p = self.parameters
        x, y = p.wheelbase / 2, p.track / 2
        return ghost_of(
            length=p.length,
            width=p.track - p.wheel_width,
            clearance=p.clearance,
            height=p.height,
            wheels={
                "front_right": (x, -y), "front_left": (x, y),
                "rear_right": (-x, -y), "rear_left": (-x, y),
            },
            wheel_radius=p.wheel_radius,
            wheel_width=p.wheel_width,
        )  # fmt: skip

    def add_model(self, station: StationBuilder, robot: Robot) -> None:
        """Adds the robot to the plant, at its start; its wheels are turned by speed servos."""
        require(
            getattr(robot.drive, "motor", None) is None,
            f"{robot.name}.drive",
            "dc_motors",
            "wheel_servo: the motors of a LIMO hold their speed",
        )
        plant = station.plant
        robot.model = add_limo(plant, self.parameters, robot.name)
        body = plant.GetBodyByName("base_link", robot.model)
        plant.SetDefaultFloatingBaseBodyPose(body, spatial_pose(robot.start))
