"""What goes wrong with a formation on purpose: signals, motors, and a robot that fails for good."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Literal

from systems.formation.axes import SIDES
from systems.sensors.faults import Fault
from systems.validation import require

if TYPE_CHECKING:
    from diagrams.formation import FormationScenario

COMMAND = "drive.command"  # what a controller commands, on its way to the motors
FailAs = Literal["beacon", "wreck"]


@dataclass
class RobotFault(Fault):
    """What goes wrong with a signal of one robot, or of all.

    The signal may be `drive.command` too: motors that are `dead` stand still.

    Attributes:
        robot: its number, from 1; 0 for all of them.
    """

    robot: int = 0


def check_faults(scenario: FormationScenario) -> None:
    """Raises `ValueError` for a fault, or a failure, of a robot that there is not."""
    n = scenario.robots
    for k, fault in enumerate(scenario.faults):
        require(0 <= fault.robot <= n, f"faults[{k}].robot", fault.robot, f"0 (all) to {n}")
    fails = scenario.fail_robot
    require(fails is None or 1 <= fails <= n, "fail_robot", fails, f"one of 1 to {n}")
    at = scenario.fail_at
    require(math.isfinite(at) and at >= 0, "fail_at", at, "0 or greater")


def faults_of(scenario: FormationScenario, robot: int) -> list[Fault]:
    """Returns all that goes wrong with the signals of a robot.

    Args:
        scenario: with its faults, and the robot that fails. That one's motors are dead from then
            on. As a `wreck` it sends no pictures, and nobody finds its markers.
        robot: number, from 1.
    """
    faults = [
        Fault(**{f.name: getattr(fault, f.name) for f in fields(Fault)})
        for fault in scenario.faults
        if fault.robot in (0, robot)
    ]
    fails, at = scenario.fail_robot, scenario.fail_at
    cameras = [f"{camera}.detections" for camera in scenario.cameras()]
    if robot == fails:
        faults.append(Fault(COMMAND, "dead", at))
    if fails is not None and scenario.fail_as == "wreck":
        first = SIDES * (fails - 1)
        ids = list(range(first, first + SIDES))
        faults += [
            Fault(signal, "silent", at) if robot == fails else Fault(signal, "hidden", at, ids=ids)
            for signal in cameras
        ]
    return faults
