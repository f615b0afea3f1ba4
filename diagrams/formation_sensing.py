"""What a formation knows of the obstacles around it: the arena's plan, or what its robots hear."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context
from pydrake.systems.primitives import ConstantValueSource

from diagrams.mission import Mission, Wiring
from diagrams.station import Hardware
from plants.formation_arena import known_obstacles
from systems.planners.formation_obstacles import Obstacles
from systems.planners.sonar_obstacles import SonarObstacles, SonarTrustParameters
from systems.validation import require

if TYPE_CHECKING:
    from diagrams.formation import FormationScenario

_SENSED = "obstacles.obstacles"


def ring_of(robot: Hardware) -> str:
    """Returns the name of a robot's ring of range finders.

    Raises:
        ValueError: it has none.
    """
    rings = [name for name, sensor in robot.sensors.items() if hasattr(sensor.target, "ring")]
    require(
        len(rings) > 0,
        "robot.sensors",
        list(robot.sensors),
        "with a ring of range finders (type: ultrasonic), or obstacles: known",
    )
    return rings[0]


def add_obstacles(wiring: Wiring, scenario: FormationScenario) -> str:
    """Adds the block that tells the planner of obstacles, and returns its output's name.

    Connects all of its inputs; the blocks `turns` and, if there is one, `estimator` are there.

    Args:
        wiring: of the mission.
        scenario: says whether the obstacles are known or sensed.
    """
    if scenario.obstacles == "known":
        known = known_obstacles(scenario.world.arena)
        wiring.add(ConstantValueSource(AbstractValue.Make(known)), "obstacles")
        return "obstacles.y0"
    device = ring_of(scenario.robot)
    ring = scenario.robot.sensors[device].build().ring()
    trust = SonarTrustParameters(robot_radius=scenario.formation.robot_radius)
    wiring.add(
        SonarObstacles(
            robots=scenario.robots,
            ring_pose=ring.pose.tolist(),
            offset=ring.offset,
            half_angle=ring.half_angle,
            parameters=scenario.sonar,
            trust=trust,
        ),
        "obstacles",
    )
    for k, name in enumerate(scenario.names()):
        wiring.connect(f"{name}.{device}.scan", f"obstacles.scan_{k}")
    wiring.connect("turns.believed", "obstacles.poses")
    wiring.connect("turns.moving", "obstacles.moving")
    if wiring.has_block("estimator"):
        wiring.connect("estimator.covariance", "obstacles.covariance")
    return _SENSED


def sensed_obstacles(wiring: Wiring, context: Context) -> Obstacles | None:
    """Returns what the robots have heard so far; None if they need not listen."""
    if not wiring.has_output(_SENSED):
        return None
    heard: Obstacles = wiring.value(_SENSED, context)
    return heard


def touched(wiring: Wiring, robots: list[str], context: Context) -> bool:
    """Whether one of the robots has touched an obstacle, as far as anybody knows."""
    names = (f"truth.{name}.contacts" for name in robots)
    return any(wiring.value(name, context)[0] > 0 for name in names if wiring.has_output(name))


def obstacle_metrics(mission: Mission, robots: list[str], context: Context) -> dict[str, Any]:
    """Returns `contacts` and `min_clearance_m`, of all robots with obstacles.

    None when nobody knows the truth; without obstacles the clearance is infinite.
    """
    names = [f"truth.{name}.{kind}" for kind in ("contacts", "clearance") for name in robots]
    if not all(name in mission.logs for name in names):
        return {"contacts": None, "min_clearance_m": None}
    values = [mission.log(name, context)[1][:, 0] for name in names]
    contacts, clearance = values[: len(robots)], values[len(robots) :]
    return {
        "contacts": int(sum(touches[-1] for touches in contacts)),
        "min_clearance_m": float(np.min(clearance)),
    }
