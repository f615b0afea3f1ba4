"""SnailBots: robots that climb a peer's shell and know their pose relative to it.

The robot of Zhang, Lam, "Relative Localization System Design for SnailBot: A Modular
Self-reconfigurable Robot", and teams of them, one on the back of the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydrake.geometry import Meshcat

from diagrams.drivers.shell_body import ShellStart
from diagrams.mission import Mission
from diagrams.scenario import Scenario
from diagrams.shell_errors import PRESETS, ShellErrors
from diagrams.shell_mission import ShellMission
from diagrams.shell_world import REFERENCE, ShellWorldParameters
from diagrams.station import Hardware, RobotParameters
from diagrams.tables import Choice, Table
from systems.controllers.shell_route import Leg, ShellRouteParameters, routine
from systems.estimators.madgwick import MadgwickParameters
from systems.estimators.shell_ekf_parameters import ShellEkfParameters
from systems.flow.sphere_flow import SphereFlowParameters
from systems.markers.localizer import LocalizerParameters
from systems.markers.pnp import rotation_from_vector
from systems.periods import aligned
from systems.validation import require

ESTIMATORS = Table(
    "estimator",
    {
        "ekf": "systems.estimators.shell_ekf:ShellEkf",
        "rule": "systems.estimators.shell_rule:ShellRule",
    },
    resources=frozenset({"view", "marker_map", "radius", "height", "rate"}),
)

ROBOT = "robot"
_SAME_PLACE = 0.02  # rad


@dataclass
class LegParameters:
    """A piece of a great circle, driven forward.

    Attributes:
        roll_deg: heading at its start.
        pitch_deg: of its start.
        yaw_deg: of its start.
        arc_deg: its length as an angle; 0 is a turn to that heading on the spot.
    """

    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    arc_deg: float

    def __post_init__(self) -> None:
        self.leg()

    def leg(self) -> Leg:
        """Returns the leg."""
        return Leg(*(math.radians(v) for v in vars(self).values()))


@dataclass
class Member:
    """A robot of the team.

    Attributes:
        start: where it stands; the first on the reference robot's shell, each other on the shell of
            the one before it.
        route: `routine` (the paper's), `stand`, or the legs, one after the other.
        speed: along a leg, m/s; left out, the steering's.
    """

    start: ShellStart = field(default_factory=ShellStart)
    route: Literal["routine", "stand"] | list[LegParameters] = "routine"
    speed: float | None = None

    def __post_init__(self) -> None:
        require(self.speed is None or 0 < self.speed < math.inf, "speed", self.speed, "positive")

    def legs(self, iterations: int) -> list[Leg]:
        """Returns what it drives; nothing when it stands.

        Args:
            iterations: how often.
        """
        if self.route == "routine":
            return routine(iterations)
        return [] if self.route == "stand" else [leg.leg() for leg in self.route] * iterations


@dataclass(kw_only=True)
class SnailBotScenario(Scenario):
    """A team of robots on shells.

    Attributes:
        world: the reference robot.
        robot: what all robots of the team are like; needs a `shell_camera` and an IMU among its
            sensors.
        team: the robots; the first is called `robot`, the others `robot_2`, `robot_3`, ... Those
            that carry another have no springs: they do not rock.
        iterations: how often each drives its route. The run's `duration` is for one.
        errors: what is wrong with the robots: `none`, `base` or `harsh`, or bounds of your own. It
            replaces the tolerances of world, body, camera and IMU, and the filter is told the
            bounds where its own are narrower. Left out, those of the devices hold. False poses and,
            where pictures were recorded, missed passages are not in what is played back.
        magnet_force: of each wheel, N; left out, the body's.
        drive_on: the pose that the robots drive on: their own `estimate`, or the `truth`.
        camera: which of the sensors looks down.
        imu: which of the sensors turns with the body.
        localizer: what is trusted of a picture's markers.
        marker_rotation: false is the paper's algorithm 1 as printed, which drops the marker's own
            rotation in the shell's frame.
        sphere_flow: how matches become a rotation.
        attitude: Madgwick's filter, for an estimator that has the port `orientation`.
        estimator: a block with the ports marker_pose, pose, covariance, and any of increment, flow,
            imu, orientation, reference_velocity.
        steering: speeds and gains on the way.
    """

    world: ShellWorldParameters = field(default_factory=ShellWorldParameters)
    robot: Hardware
    team: list[Member] = field(default_factory=lambda: [Member()])
    iterations: int = 1
    errors: Literal["none", "base", "harsh"] | ShellErrors | None = None
    magnet_force: float | None = None
    drive_on: Literal["estimate", "truth"] = "estimate"
    camera: str = "camera"
    imu: str = "imu"
    localizer: LocalizerParameters = field(default_factory=LocalizerParameters)
    marker_rotation: bool = True
    sphere_flow: SphereFlowParameters = field(default_factory=SphereFlowParameters)
    attitude: MadgwickParameters = field(default_factory=MadgwickParameters)
    estimator: Annotated[Choice, ESTIMATORS]
    steering: ShellRouteParameters = field(default_factory=ShellRouteParameters)

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.dynamics == "multibody", "dynamics", self.dynamics, "multibody")
        require(self.iterations >= 1, "iterations", self.iterations, "1 or greater")
        require(len(self.team) > 0, "team", self.team, "at least one robot")
        force = self.magnet_force
        require(
            force is None or 0 <= force < math.inf, "magnet_force", force, "0 or greater, finite"
        )
        body = self.robot.body
        require(body.has("carries_shell"), "robot.body", body.type, "one that climbs")
        for key, method in (("camera", "planned_view"), ("imu", "position")):
            name = getattr(self, key)
            fit = [n for n, s in self.robot.sensors.items() if s.has(method)]
            have = ", ".join(fit) or "none"
            require(name in fit, key, name, f"one of the robot's sensors that fit: {have}")
        imu, camera = (self.robot.sensors[name].build() for name in (self.imu, self.camera))
        require(
            imu.rate >= camera.rate,
            f"robot.sensors.{self.imu}.rate",
            imu.rate,
            f"at least the camera's, {camera.rate:g} Hz",
        )
        require(
            camera.sight in (None, self.sight) or "rendered" not in (camera.sight, self.sight),
            f"robot.sensors.{self.camera}.sight",
            camera.sight,
            f"left out, where sight is {self.sight}: shells look one way to all cameras",
        )
        for k, member in enumerate(self.team):
            legs = member.legs(1)
            require(
                self.iterations == 1 or not legs or closes(legs),
                f"team[{k}].route",
                member.route,
                f"one that ends where it begins, to be driven {self.iterations} times",
            )
        self.robots()
        # The resolved scenario says what the filter was told: it is saved, and loaded as given.
        self.estimator = self.told_estimator()

    @property
    def time_limit(self) -> float:
        """When the run ends at the latest, s."""
        return self.duration * self.iterations

    def bounds(self) -> ShellErrors | None:
        """Returns the bounds of what is wrong."""
        return PRESETS[self.errors] if isinstance(self.errors, str) else self.errors

    def faulty_world(self) -> ShellWorldParameters:
        """Returns the world with what is wrong with it."""
        errors = self.bounds()
        if errors is None:
            return self.world
        return replace(self.world, placement_tolerance_deg=errors.placement_deg)

    def robots(self) -> dict[str, RobotParameters]:
        """Returns the robots by name, with what is wrong with them."""
        robots: dict[str, RobotParameters] = {}
        names = [ROBOT, *(f"{ROBOT}_{k + 1}" for k in range(1, len(self.team)))]
        for k, (name, member) in enumerate(zip(names, self.team, strict=True)):
            host = names[k - 1] if k else REFERENCE
            on = member.start.on
            require(on in ("", host), f"team[{k}].start.on", on, f"left out, or {host}")
            start = replace(member.start, on=host)
            hardware = self._hardware(carries_shell=k + 1 < len(self.team))
            robots[name] = RobotParameters(**vars(hardware), start=start)  # type: ignore[arg-type]
        return robots

    def _hardware(self, *, carries_shell: bool) -> Hardware:
        """Returns what a robot is made of, with errors and magnets as the scenario wants them."""
        errors, body = self.bounds(), self.robot.body
        changes: dict[str, Any] = {}
        built = body.build()
        if self.magnet_force is not None:
            changes["magnets"] = replace(built.magnets, force=self.magnet_force)
        if errors is not None:
            changes["rocking"] = replace(built.rocking, bound=math.radians(errors.rock_deg))
        if carries_shell:
            changes["carries_shell"] = True
            changes["rocking"] = replace(built.rocking, bound=0.0)
        robot = replace(self.robot, body=body.changed(**changes))
        camera, imu = (robot.sensors[name] for name in (self.camera, self.imu))
        camera = camera.changed(imu=self.imu)
        if errors is None:
            return replace(robot, sensors=robot.sensors | {self.camera: camera})
        latency = camera.build().latency
        bias = math.radians(errors.gyro_bias_deg_s)
        sensors = robot.sensors | {
            self.camera: camera.changed(
                mounting_tolerance_deg=errors.mounting_deg,
                height_tolerance=errors.flow_scale,
                clock_error=errors.delay,
                latency=max(latency, errors.delay),
                missed_passages=errors.missed_passages,
            ),
            self.imu: imu.changed(
                parameters=replace(
                    imu.build().parameters,
                    gyro_bias=[0.0] * 3,
                    gyro_bias_tolerance=[bias] * 3,
                ),
            ),
        }
        return replace(robot, sensors=sensors)

    def told_estimator(self) -> Choice:
        """Returns the estimator, told of the errors' bounds where it is not told otherwise."""
        errors, choice = self.bounds(), self.estimator
        parameters = choice.arguments.get("parameters")
        if errors is None or not isinstance(parameters, ShellEkfParameters):
            return choice
        return choice.told(errors.priors())

    def build(self, *, meshcat: Meshcat | None = None, out: Path | None = None) -> Mission:
        """Wires station, estimators and steering.

        Args:
            meshcat: where it is shown, if anywhere.
            out: folder of the run; the recording goes there. None records nothing.

        Raises:
            ValueError: something of the scenario is refused; one line.
        """
        with aligned():
            return ShellMission(self, meshcat=meshcat, out=out)


def closes(legs: list[Leg]) -> bool:
    """Whether a route ends at the place where it begins."""
    end = legs[-1].frame() @ rotation_from_vector(np.array([0.0, legs[-1].arc, 0.0]))
    return bool(np.linalg.norm(end[:, 2] - legs[0].frame()[:, 2]) < _SAME_PLACE)
