"""What keeps a robot with a lidar off obstacles, wired between waypoints and wheels.

    sequencer -> planner -> avoider -> controller -> search -> monitor -> drive

Planner and avoider may be left out (`none`); an avoider that drives itself (it has an output
`command`) takes the controller's place. The monitor is there whenever there is a lidar.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context

from diagrams.mission import FRAME_RATE, Wiring
from diagrams.surroundings_viewer import SurroundingsViewer
from diagrams.tables import Table
from systems.controllers.collision_monitor import CollisionMonitor
from systems.planners.occupancy import OccupancyMapper
from systems.planners.progress import ProgressMonitor

if TYPE_CHECKING:
    from diagrams.navigation import NavigationScenario

AVOIDERS = Table(
    "avoider",
    {
        "dwa": "systems.avoiders.dwa:DwaAvoider",
        "sector": "systems.avoiders.sector:SectorAvoider",
        "vfh_plus": "systems.avoiders.vfh_plus:VfhPlus",
    },
    resources=frozenset({"lidar_pose", "hull"}),
    optional=True,
)
PLANNERS = Table(
    "planner",
    {"astar": "systems.planners.astar:AStarPlanner"},
    resources=frozenset({"hull"}),
    optional=True,
)


class Avoidance:
    """The blocks between waypoints and wheels of one robot.

    Args:
        wiring: has the station and the sequencer, the controller, the estimator and the search.
        scenario: which blocks, and their parameters.
        robot: prefix of its ports.

    Raises:
        ScenarioError: a block that is refused, or does not fit.
    """

    def __init__(self, wiring: Wiring, scenario: NavigationScenario, robot: str) -> None:
        self._wiring = wiring
        self._robot = robot
        self._lidar = scenario.lidar
        if self._lidar is None:
            return
        lidar = scenario.robot.sensors[self._lidar].build()
        self._lidar_pose = lidar.planar_mounting()
        hull = scenario.robot.body.build().hull
        if scenario.planner is not None:
            wiring.add(
                OccupancyMapper(parameters=scenario.mapper, lidar_pose=self._lidar_pose), "mapper"
            )
            wiring.add(scenario.planner.build(hull=hull), "planner")
        if scenario.avoider is not None:
            wiring.add(scenario.avoider.build(lidar_pose=self._lidar_pose, hull=hull), "avoider")
        monitor = CollisionMonitor(
            parameters=scenario.monitor, hull=hull, lidar_pose=self._lidar_pose.tolist()
        )
        wiring.add(monitor, "monitor")
        wiring.add(ProgressMonitor(parameters=scenario.progress), "progress")

    def connect(self) -> None:
        """Connects the blocks, from the next waypoint to the wheels."""
        wiring, goal = self._wiring, "sequencer.goal"
        if wiring.has_block("planner"):
            self._connect("mapper", pose="estimator.pose", covariance="estimator.covariance")
            self._connect("planner", pose="estimator.pose", goal=goal, grid="mapper.grid")
            goal = "planner.goal"
        command = "controller.command"
        if wiring.has_block("avoider"):
            self._connect("avoider", pose="estimator.pose", goal=goal)
            goal = "avoider.goal"
            if wiring.has_output("avoider.command"):
                command = "avoider.command"
        wiring.connect_if_wanted(goal, "controller.goal")
        wiring.connect(command, "search.command")
        command = "search.command"
        if wiring.has_block("monitor"):
            wiring.connect(command, "monitor.command")
            self._connect("monitor")
            command = "monitor.command"
            self._connect("progress", pose="estimator.pose", goal="sequencer.goal")
            if wiring.has_output("planner.path"):
                wiring.connect("planner.path", "progress.path")
        wiring.connect(command, f"{self._robot}.drive.command")

    def _connect(self, block: str, **sources: str) -> None:
        """Connects those inputs that a block has; scan and sent command go to whoever wants."""
        sources |= {
            "scan": f"{self._robot}.{self._lidar}.scan",
            "sent": f"{self._robot}.drive.sent",
        }
        if block == "avoider":
            sources["command"] = sources.pop("sent")
        for port, source in sources.items():
            self._wiring.connect_if_wanted(source, f"{block}.{port}")

    def show(self, meshcat: Meshcat) -> None:
        """Adds what shows scan, sectors, path and grid in Meshcat."""
        if self._lidar is None:
            return
        wiring = self._wiring
        wiring.add(
            SurroundingsViewer(meshcat=meshcat, lidar_pose=self._lidar_pose, rate=FRAME_RATE),
            "surroundings",
        )
        sources = {
            "pose": "estimator.pose",
            "scan": f"{self._robot}.{self._lidar}.scan",
            "state": "avoider.state",
            "path": "planner.path",
            "grid": "mapper.grid",
        }
        for port, source in sources.items():
            if wiring.has_output(source):
                wiring.connect(source, f"surroundings.{port}")

    def blocked(self, context: Context) -> bool:
        """Whether the robot has given up.

        The avoider found no free direction, the planner no way, or the robot comes no nearer.

        Args:
            context: of the whole diagram.
        """
        verdicts = {
            "avoider.state": lambda state: state.status == "blocked",
            "planner.reachable": lambda reachable: reachable[0] == 0,
            "progress.stuck": lambda stuck: stuck[0] == 1,
        }
        wiring = self._wiring
        return any(
            verdict(wiring.value(name, context))
            for name, verdict in verdicts.items()
            if wiring.has_output(name)
        )
