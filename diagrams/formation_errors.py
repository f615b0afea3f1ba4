"""What is wrong with the robots of a formation, though nobody wants it: drawn by the seed."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

from diagrams.station import Hardware, Start
from systems.formation.axes import SIDES
from systems.noise import generator, stream_key
from systems.validation import require_non_negative


@dataclass(frozen=True)
class FormationErrors:
    """Standard deviations of normal errors; 0 for none.

    Attributes:
        start_position: of where each robot has been put, x and y, m.
        start_heading_deg: of how it has been turned.
        camera_yaw_deg: of where each camera looks.
        marker_position: of each marker on its robot, outward and to its left, m.
        marker_size: of each marker's size, relatively.
    """

    start_position: float = 0.0
    start_heading_deg: float = 0.0
    camera_yaw_deg: float = 0.0
    marker_position: float = 0.0
    marker_size: float = 0.0

    def __post_init__(self) -> None:
        require_non_negative(**vars(self))

    def for_estimator(self, side: float) -> dict[str, float]:
        """Returns the estimator's deviations that allow for these errors, by name.

        Args:
            side: of the triangles, m: from so far a marker is seen that is not in its place.
        """
        misplaced = self.marker_position / side
        return {
            "start_position_noise": self.start_position,
            "start_heading_noise": math.radians(self.start_heading_deg),
            "yaw_error": math.radians(self.camera_yaw_deg),
            "bearing_floor": misplaced,
            "range_floor": math.hypot(self.marker_size, misplaced),
        }

    def for_controller(self) -> dict[str, float]:
        """Returns the same of a controller's noise."""
        return {"yaw_std": math.radians(self.camera_yaw_deg)}


PRESETS = {
    "none": FormationErrors(),
    # What the estimator allows for when it is told nothing.
    "base": FormationErrors(
        start_position=0.003,
        start_heading_deg=0.57,
        camera_yaw_deg=0.34,
        marker_position=0.0005,
        marker_size=0.003,
    ),
    "harsh": FormationErrors(
        start_position=0.01,
        start_heading_deg=2.0,
        camera_yaw_deg=1.0,
        marker_position=0.002,
        marker_size=0.01,
    ),
}


def misplaced(
    robot: Hardware,
    start: Start,
    cameras: Iterable[str],
    *,
    errors: FormationErrors,
    seed: int,
    name: str,
) -> tuple[Hardware, Start]:
    """Returns a robot as it truly is and stands.

    Args:
        robot: as it is believed to be; its body has a ring of markers.
        start: where it is believed to stand.
        cameras: of its sensors, those that look aside.
        errors: how large they are; errors of 0 leave everything as it is.
        seed: with the robot's name it draws them, so that more robots change nothing of the others.
        name: of the robot.
    """
    if errors == FormationErrors():
        return robot, start
    standing, looking, bearing = (
        generator(stream_key(seed, f"{name} {what}"), 0).standard_normal
        for what in ("start", "cameras", "markers")
    )
    x, y, turn = standing(3) * [*[errors.start_position] * 2, errors.start_heading_deg]
    start = Start(x=start.x + x, y=start.y + y, heading_deg=start.heading_deg + turn)
    sensors = dict(robot.sensors)
    for camera in cameras:
        aside = sensors[camera].arguments.get("yaw_error_deg", 0.0)
        aside += errors.camera_yaw_deg * float(looking())
        sensors[camera] = sensors[camera].changed(yaw_error_deg=aside)
    ring = robot.body.build().ring
    off = bearing((SIDES, 3)) * [*[errors.marker_position] * 2, errors.marker_size]
    ring = replace(ring, misplaced=(ring.misplaced + off).tolist())
    return replace(robot, body=robot.body.changed(ring=ring), sensors=sensors), start
