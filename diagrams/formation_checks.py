"""Whether the robots of a formation can see what they must: checks of a scenario, a line each."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from systems.validation import require

if TYPE_CHECKING:
    from diagrams.formation import FormationScenario

_ANCHOR = math.sqrt(3)  # sides from a vertex to the beacon behind, the farthest that must be read
_TURNED = math.radians(45.0)  # of four faces the best one is turned by no more
_ASIDE = math.radians(30.0)  # at a vertex, the beacons beside the anchor
_RIM = 1.25  # a marker with its white rim, by its black square


def check_sizes(scenario: FormationScenario) -> None:
    """Raises `ValueError` where the same length is given twice, and differs.

    What a robot believes of the formation's side and markers is what it steers by.
    """
    ring, step = scenario.ring(), scenario.step
    side = scenario.formation.side
    _require_same("step.side", step.side, "formation.side", side)
    _require_same("step.marker_size", step.marker_size, "robot.body.ring.size", ring.size)
    distance = "robot.body.ring.distance"
    _require_same("step.marker_distance", step.marker_distance, distance, ring.distance)
    if scenario.estimator is None:
        return
    believed = scenario.estimator.arguments.get("parameters")
    for name, key, value in (
        ("marker_size", "robot.body.ring.size", ring.size),
        ("marker_offset", distance, ring.distance),
    ):
        if hasattr(believed, name):
            _require_same(f"estimator.{name}", getattr(believed, name), key, value)


def check_sight(scenario: FormationScenario) -> None:
    """Raises `ValueError` for markers too small, or pictures too narrow, for the side length."""
    side, size = scenario.formation.side, scenario.ring().size
    for name in scenario.cameras():
        driver = scenario.robot.sensors[name].build()
        camera = driver.model()
        focal_length, centre = float(camera.K[0, 0]), float(camera.K[0, 2])
        far, needed = _ANCHOR * side, driver.projector.min_side_px
        least = needed * far / (focal_length * math.cos(_TURNED))
        require(
            size >= least,
            "robot.body.ring.size",
            size,
            f"at least {_up(least)} m: the anchor is {far:.3g} m away, sqrt(3) sides of {side:g} m,"
            f" and turned by up to 45 degrees its marker must be {needed:g} px wide in {name} "
            f"(focal length {focal_length:g} px), not {size / least * needed:.1f}",
        )
        aside = focal_length * math.tan(_ASIDE)
        why = f"a beacon 30 degrees aside falls {aside:.0f} px from it"
        dt = getattr(scenario.controller.arguments.get("parameters"), "dt", 0.0)
        if dt > aside:
            aside, why = dt, f"controller.dt is {dt:g} px"
        need = aside + _RIM / 2 * focal_length * size / side
        room = min(centre + 0.5, camera.width - 0.5 - centre)
        require(
            room >= need,
            f"robot.sensors.{name}.calibration",
            driver.calibration,
            f"a camera whose picture holds {math.ceil(need)} px on either side of its axis: {why}, "
            f"and half a marker more; this one holds {room:g}",
        )


def _require_same(name: str, value: Any, other: str, expected: float) -> None:
    require(math.isclose(value, expected), name, value, f"{expected:g}, as {other} is")


def _up(length: float) -> str:
    """Returns a length rounded up to a millimetre, so that it is enough."""
    return f"{math.ceil(length * 1000 - 1e-9) / 1000:g}"
