"""Replay: a robot that knows a map of tags drives a route on its own.

Teaching and replay are the two halves of Martins do Lago Reis, da Silva Ramos, "AprilTag-based
Trajectory Tracking for the LIMOS Robot"; the paper stops after the first, the second is ours.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pydrake.geometry import Meshcat

from diagrams.mission import Mission
from diagrams.navigation import ESTIMATORS
from diagrams.scenario import Scenario
from diagrams.schema import File, file_path
from diagrams.station import RobotParameters
from diagrams.tables import Choice, Table
from diagrams.world import WorldParameters
from plants.arena import check_free
from systems.controllers.replay_supervisor import SupervisorParameters
from systems.markers.layout import MarkerMap, load_map
from systems.markers.localizer import LocalizerParameters
from systems.planners.route import Route, load_route
from systems.planners.route_clearance import ClearanceParameters
from systems.validation import require, require_positive

TRACKERS = Table(
    "controller",
    {
        "kanayama": "systems.controllers.kanayama:Kanayama",
        "mpc": "systems.controllers.mpc:Mpc",
        "pure_pursuit": "systems.controllers.pure_pursuit:PurePursuit",
        "tvlqr": "systems.controllers.tvlqr:Tvlqr",
    },
    resources=frozenset({"route", "laps"}),
)


@dataclass(kw_only=True)
class ReplayKeys:
    """How a route is replayed.

    Attributes:
        camera: which of the sensors looks for tags.
        encoders: which of the sensors counts the wheels' turns.
        imu: which of the sensors measures the yaw rate.
        lidar: which of the sensors looks for what stands on the route; none without one.
        localizer: what is trusted of a picture.
        estimator: a block with the ports command, imu, wheel_speeds, marker_pose,
            marker_alternative, pose, covariance, health; nis if it has any.
        controller: a block with the ports pose, covariance, sent, command, state (see
            `systems.controllers.path_tracking`).
        supervisor: when the robot slows, stops and waits.
        clearance: what counts as standing on the route.
        laps: of a closed route.
    """

    camera: str = "front_camera"
    encoders: str = "encoders"
    imu: str = "imu"
    lidar: str | None = None
    localizer: LocalizerParameters = field(default_factory=LocalizerParameters)
    estimator: Annotated[Choice, ESTIMATORS]
    controller: Annotated[Choice, TRACKERS]
    supervisor: SupervisorParameters = field(default_factory=SupervisorParameters)
    clearance: ClearanceParameters = field(default_factory=ClearanceParameters)
    laps: float = 1.0

    def check_replay(self, robot: RobotParameters) -> None:
        """Refuses sensors that do not fit.

        Raises:
            ValueError: naming the key.
        """
        require_positive(laps=self.laps)
        for key, method in (
            ("camera", "mounting"),
            ("encoders", "speeds"),
            ("imu", "add"),
            ("lidar", "planar_mounting"),
        ):
            robot.require_sensor(key, getattr(self, key), method)
        body = robot.body
        require(hasattr(body.target, "sides"), "robot.body", body.type, "one on wheels")


@dataclass(kw_only=True)
class ReplayScenario(Scenario, ReplayKeys):
    """A robot, a world of tags, what the robot knows of them, and a route.

    Attributes:
        world: the tags as they are.
        robot: what drives.
        map: marker map that the robot knows, in the frame of the world, as `tagtrail map` writes
            it; left out: the tags as they are.
        route: as `tagtrail route` writes it, in the map's frame.
    """

    world: WorldParameters
    robot: RobotParameters
    map: Annotated[str, File("maps")] | None = None
    route: Annotated[str, File("routes")]

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_replay(self.robot)
        start, room = self.robot.start, self.robot.body.build().hull_radius
        check_free(self.world.arena, [start.x, start.y], room, "robot.start", moving=True)
        self.load_route()
        self.load_map()

    def load_route(self) -> Route:
        """Returns the route.

        Raises:
            ValueError: the file is no route; the message names it.
        """
        return load_route(file_path(self.route, "routes"))

    def load_map(self) -> MarkerMap:
        """Returns the tags as the robot knows them.

        Raises:
            ValueError: the file is no map; the message names it.
        """
        if self.map is None:
            return self.world.marker_map()
        return load_map(file_path(self.map, "maps"))

    def build(self, *, meshcat: Meshcat | None = None, out: Path | None = None) -> Mission:
        """Wires station, filter, controller and supervisor.

        Args:
            meshcat: where it is shown, if anywhere.
            out: folder of the run; the recording goes there. None records nothing.

        Raises:
            ValueError: something of the scenario is refused; one line.
        """
        from diagrams.replay_mission import ReplayMission

        return ReplayMission(
            self, known=self.load_map(), route=self.load_route(), meshcat=meshcat, out=out
        )
