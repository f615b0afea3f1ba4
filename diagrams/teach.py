"""Teaching: a LIMO is driven once around a circuit of tags of which one's pose is known.

The robot and the procedure are those of Martins do Lago Reis, da Silva Ramos, "AprilTag-based
Trajectory Tracking for the LIMOS Robot", chapter 3.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from pydrake.geometry import Meshcat

from diagrams.mission import Mission
from diagrams.random_circuit import CIRCUIT
from diagrams.random_world import RandomWorld
from diagrams.scenario import Scenario
from diagrams.station import RobotParameters
from diagrams.tables import Choice, Table
from diagrams.teach_mission import TeachMission
from diagrams.world import WorldParameters
from plants.arena import check_free
from systems.estimators.wheel_odometry import WheelOdometryParameters
from systems.planners.closed_curve import ClosedCurve
from systems.validation import require, require_positive

DRIVERS = Table(
    "driver",
    {
        "person": "systems.io.meshcat_driver:MeshcatDriver",
        "scripted": "systems.controllers.scripted_driver:ScriptedDriver",
    },
    resources=frozenset({"meshcat", "route"}),
)


@dataclass(kw_only=True)
class TeachScenario(Scenario):
    """A robot, a circuit, and who drives.

    Attributes:
        world: the tags; the robot knows their family, their sizes and the anchor's pose.
        robot: what is driven; needs a camera and encoders among its sensors.
        route: [[x, y], ...] through which the circuit goes, m, in the order of travel: the track
            that a driver sees.
        anchor: id of the tag whose pose is known.
        driver: a block with the ports command, finished; pose if it wants to see the robot.
        camera: which of the sensors looks for tags.
        encoders: which of the sensors counts the wheels' turns.
        odometry: how far the wheels are to be trusted.
        pixel_noise: standard deviation of a corner's coordinate, px, for covariances.
    """

    random_world: ClassVar[RandomWorld] = CIRCUIT

    world: WorldParameters
    robot: RobotParameters
    route: list[list[float]]
    anchor: int = 0
    driver: Annotated[Choice, DRIVERS]
    camera: str = "front_camera"
    encoders: str = "encoders"
    odometry: WheelOdometryParameters = field(default_factory=WheelOdometryParameters)
    pixel_noise: float = 0.3

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(pixel_noise=self.pixel_noise)
        for k, point in enumerate(self.route):
            require(
                len(point) == 2 and bool(np.isfinite(point).all()),
                f"route[{k}]",
                point,
                "[x, y] in metres",
            )
        try:
            ClosedCurve(self.route)
        except ValueError as error:
            raise ValueError(f"route: {str(error).removeprefix('points is ')}") from error
        for key, method in (("camera", "mounting"), ("encoders", "speeds")):
            self.robot.require_sensor(key, getattr(self, key), method)
        body = self.robot.body
        require(hasattr(body.target, "sides"), "robot.body", body.type, "one on wheels")
        known = self.world.marker_map()
        ids = ", ".join(map(str, known.markers))
        require(self.anchor in known, "anchor", self.anchor, f"one of the tags: {ids}")
        start = self.robot.start
        room = body.build().hull_radius
        check_free(self.world.arena, [start.x, start.y], room, "robot.start", moving=True)

    @property
    def by_hand(self) -> bool:
        """Whether a person drives, in the browser."""
        return self.driver.type == "person"

    @property
    def realtime_rate(self) -> float:
        """Real time for a person."""
        return 1.0 if self.by_hand else 0.0

    def build(self, *, meshcat: Meshcat | None = None, out: Path | None = None) -> Mission:
        """Wires station, driver and observer.

        Args:
            meshcat: where it is shown, if anywhere.
            out: folder of the run; the recording goes there. None records nothing.

        Raises:
            ValueError: something of the scenario is refused; one line.
        """
        if self.by_hand and meshcat is None and self.recording is None:
            place = self.driver.place
            raise place.error(
                f"{place} is 'person': needs Meshcat's controls in the browser; leave out "
                "--no-meshcat, or choose 'scripted'"
            )
        return TeachMission(self, meshcat=meshcat, out=out)
