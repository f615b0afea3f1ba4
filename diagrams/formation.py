"""A formation: robots that are each other's landmarks cross open space in equilateral triangles.

The robots of Kang, Kwon, Bae, Kim, "Monocular Vision-Based Swarm Robot Localization Using
Equilateral Triangular Formations".
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat

from diagrams.formation_checks import check_sight, check_sizes
from diagrams.formation_errors import PRESETS, FormationErrors, misplaced
from diagrams.formation_faults import COMMAND, FailAs, RobotFault, check_faults, faults_of
from diagrams.formation_mission import FormationMission
from diagrams.formation_sensing import ring_of
from diagrams.mission import Mission
from diagrams.random_formation import CLUTTER
from diagrams.random_world import RandomWorld
from diagrams.scenario import Scenario
from diagrams.station import Hardware, RobotParameters, Start
from diagrams.tables import Choice, Table
from diagrams.world import WorldParameters
from plants.arena import check_free
from systems.controllers.formation_step import FormationStepParameters
from systems.formation.building import SettlingParameters
from systems.planners.formation_ground import FormationParameters
from systems.planners.formation_lattice import fit_lattice, strip
from systems.planners.formation_turns import FormationTurnsParameters
from systems.planners.sonar_grid import SonarGridParameters
from systems.validation import require, require_positive

Array = NDArray[np.float64]

CONTROLLERS = Table(
    "controller",
    {
        "algorithm1": "systems.controllers.triangle_algorithm1:TriangleAlgorithm1",
        "resection": "systems.controllers.triangle_resection:TriangleResection",
    },
    resources=frozenset({"front_camera", "rear_camera", "step"}),
)
ESTIMATORS = Table(
    "estimator",
    {"formation": "systems.estimators.formation_filter:FormationFilter"},
    resources=frozenset({"start_poses", "camera"}),
    optional=True,
)
CAMERAS = ("front_camera", "rear_camera")
LEAST = 4  # robots


@dataclass(kw_only=True)
class FormationScenario(Scenario):
    """Robots, where they stand, where they are to go.

    Attributes:
        world: obstacles; markers are on the robots.
        robot: what all robots are like; needs the cameras `front_camera` and `rear_camera`, and a
            body with a `ring` of markers.
        robots: how many, robot1, robot2, ...
        start: [[x, y], ...] where they stand at first, m; left out, a strip of triangles.
        heading_deg: of all of them at the start.
        destination: [x, y] m; reached when a robot stands at the vertex nearest to it.
        formation: side of the triangles, and the room that robots need.
        controller: drives one robot through a step: a block with the ports front_detections,
            rear_detections, task, command, status.
        estimator: finds where all robots are: a block with the ports moving, robot{k}_{camera},
            poses, covariance; or `none`: every robot is believed to stand where it was to go.
        planner: which robot moves where: `closest`, the paper's rule, or `astar`.
        obstacles: `known` from the start, all that stand in the world, or `sensed`: what the rings
            of ultrasonic range finders of all robots have heard, which takes one among the sensors.
        sonar: how what they hear is put together.
        step: how a robot behaves in a step; its side is the formation's.
        turns: how long things take.
        fail_robot: number of the robot that fails, from 1; none if left out.
        fail_at: when it does, s.
        fail_as: what it is from then on: a `beacon` still, which only cannot move, or a `wreck`,
            which neither sees nor is seen.
        faults: what goes wrong with signals and motors for a time, by the number of the robot.
        errors: what is wrong with the robots all the time: `none`, `base` or `harsh`, or standard
            deviations of your own. Estimator and controller are told of them where they are not
            told otherwise.
    """

    random_world: ClassVar[RandomWorld] = CLUTTER

    world: WorldParameters
    robot: Hardware
    robots: int = LEAST
    start: list[list[float]] | None = None
    heading_deg: float = 0.0
    destination: list[float]
    formation: FormationParameters = field(default_factory=FormationParameters)
    controller: Annotated[Choice, CONTROLLERS]
    estimator: Annotated[Choice | None, ESTIMATORS] = None
    planner: Literal["closest", "astar"] = "closest"
    obstacles: Literal["known", "sensed"] = "known"
    sonar: SonarGridParameters = field(default_factory=SonarGridParameters)
    step: FormationStepParameters = field(default_factory=FormationStepParameters)
    turns: FormationTurnsParameters = field(default_factory=FormationTurnsParameters)
    fail_robot: int | None = None
    fail_at: float = 0.0
    fail_as: FailAs = "beacon"
    faults: list[RobotFault] = field(default_factory=list)
    errors: Literal["none", "base", "harsh"] | FormationErrors = "none"

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.robots >= LEAST, "robots", self.robots, f"at least {LEAST}")
        if self.start is not None:
            require(
                len(self.start) == self.robots,
                "start",
                self.start,
                f"places of all {self.robots} robots",
            )
        for name in CAMERAS:
            require(
                name in self.robot.sensors,
                "robot.sensors",
                list(self.robot.sensors),
                f"with {name}",
            )
        ring = self.ring()
        require(ring is not None, "robot.body.ring", ring, "markers for the others to see")
        if self.obstacles == "sensed":
            ring_of(self.robot)
        check_faults(self)
        side = self.formation.side
        require_positive(side=side)
        if self.step.side == FormationStepParameters().side:  # left out
            self.step = replace(self.step, side=side)
        settling = self.controller.arguments.get("parameters")
        past = settling.beyond if isinstance(settling, SettlingParameters) else 0.0
        require(
            self.formation.beyond >= past,
            "formation.beyond",
            self.formation.beyond,
            f"at least {past:g} m, by which the controller drives past its vertex",
        )
        try:
            fit_lattice(self.places(), side)
        except ValueError as error:
            raise ValueError(str(error).replace("positions", "start", 1)) from error
        room = self.formation.robot_radius
        for k, place in enumerate(self.places()):
            check_free(self.world.arena, place.tolist(), room, f"start[{k}]")
        require(
            len(self.destination) == 2 and bool(np.isfinite(self.destination).all()),
            "destination",
            self.destination,
            "[x, y] in metres",
        )
        check_free(self.world.arena, self.destination, room, "destination")
        check_sight(self)
        check_sizes(self)
        self._tell()

    def _tell(self) -> None:
        """Tells estimator and controller how large the errors are.

        Now, so that the scenario that is saved says what they know.
        """
        errors = self.deviations()
        if self.estimator is not None:
            self.estimator = self.estimator.told(errors.for_estimator(self.formation.side))
        self.controller = self.controller.told(errors.for_controller(), "noise")

    def places(self) -> Array:
        """Returns where the robots stand at the start, (N, 2) m."""
        if self.start is None:
            return strip(self.robots, self.formation.side)
        return np.array(self.start, float)

    def start_poses(self) -> Array:
        """Returns the poses at the start, (N, 3)."""
        heading = math.radians(self.heading_deg)
        return np.column_stack([self.places(), np.full(self.robots, heading)])

    def ring(self) -> Any:
        """Returns the markers that each robot bears, a `plants.marker_ring.MarkerRing`."""
        return getattr(self.robot.body.build(), "ring", None)

    def cameras(self) -> tuple[str, ...]:
        """Returns the names of the cameras that the formation looks with."""
        return CAMERAS

    def names(self) -> list[str]:
        """Returns the names of the robots."""
        return [f"robot{k + 1}" for k in range(self.robots)]

    def deviations(self) -> FormationErrors:
        """Returns how large the errors of the robots are."""
        return PRESETS[self.errors] if isinstance(self.errors, str) else self.errors

    def station_robots(self) -> dict[str, RobotParameters]:
        """Returns the robots by name, with what is wrong with them."""
        errors, robots = self.deviations(), {}
        for k, (name, (x, y)) in enumerate(zip(self.names(), self.places(), strict=True), 1):
            start = Start(x=float(x), y=float(y), heading_deg=self.heading_deg)
            robot, start = misplaced(
                self.robot, start, self.cameras(), errors=errors, seed=self.seed, name=name
            )
            faults = [fault for fault in faults_of(self, k) if fault.signal != COMMAND]
            own = vars(robot) | {"faults": [*robot.faults, *faults]}
            robots[name] = RobotParameters(**own, start=start)
        return robots

    def build(self, *, meshcat: Meshcat | None = None, out: Path | None = None) -> Mission:
        """Wires station, controllers, estimator and planner.

        Args:
            meshcat: where it is shown, if anywhere.
            out: folder of the run; the recording goes there. None records nothing.

        Raises:
            ValueError: something of the scenario is refused; one line.
        """
        return FormationMission(self, meshcat=meshcat, out=out)
