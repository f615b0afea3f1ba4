"""What the filter of a robot on a shell has learned of its sensors, beside the truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context

from systems.estimators.shell_ekf import ShellEkf
from systems.shell.angles import rotation_vector

if TYPE_CHECKING:
    from diagrams.shell_robot import ShellRobot
    from diagrams.station import Station

Array = NDArray[np.float64]

# Name, what of the port `calibration`, and the factor to the unit in the name.
_LEARNED = (
    ("gyro_bias_deg_s", slice(0, 3), 180 / np.pi),
    ("mounting_deg", slice(3, 6), 180 / np.pi),
    ("flow_scale", slice(6, 7), 1.0),
    ("turn_scale", slice(7, 8), 1.0),
    ("delay_ms", slice(8, 9), 1e3),
)
_NUMBERS = 9


@dataclass
class Calibration:
    """What was learned.

    Attributes:
        values: by name, the numbers, one or three.
        deviations: their standard deviations, as the filter has them.
        truth: what they should be, of a simulated robot as far as that is known.
        placement: by marker, how it is turned about the shell's centre from its place by the map:
            a rotation vector in the shell's frame (deg), and the deviation of its components.
    """

    values: dict[str, list[float]] = field(default_factory=dict)
    deviations: dict[str, list[float]] = field(default_factory=dict)
    truth: dict[str, list[float]] = field(default_factory=dict)
    placement: dict[int, tuple[list[float], list[float]]] = field(default_factory=dict)

    def metrics(self) -> dict[str, float]:
        """Returns how far off what was learned is: the norm of each error, `{name}` by its unit."""
        names = {
            "mounting_deg": "mounting_error_deg",
            "flow_scale": "flow_scale_error",
            "delay_ms": "delay_error_ms",
        }
        return {
            said: float(np.linalg.norm(np.subtract(self.values[name], self.truth[name])))
            for name, said in names.items()
            if name in self.values and name in self.truth
        }

    def to_plain(self) -> dict[str, Any]:
        """Returns plain data."""
        return {
            name: {
                "learned": self.values[name],
                "deviation": self.deviations[name],
                "truth": self.truth.get(name),
            }
            for name in self.values
        } | {
            "markers_deg": {
                str(k): {"learned": value, "deviation": deviation}
                for k, (value, deviation) in self.placement.items()
            }
        }


def calibration(robot: ShellRobot, station: Station, context: Context) -> Calibration:
    """Returns what a robot's filter has learned; nothing for an estimator that learns nothing."""
    block = robot.estimator
    if not block.HasOutputPort("calibration"):
        return Calibration()
    numbers = robot.value("estimator.calibration", context)
    found = Calibration()
    for name, where, factor in _LEARNED:
        found.values[name] = (factor * numbers[where]).tolist()
        found.deviations[name] = (factor * numbers[_NUMBERS:][where]).tolist()
    if isinstance(block, ShellEkf):
        placement = block.placement(block.GetMyContextFromRoot(context))
        found.placement = {
            k: (np.degrees(value).tolist(), np.degrees(deviation).tolist())
            for k, (value, deviation) in placement.items()
        }
    if robot.has_truth and station.simulated:
        camera = robot.camera
        planned = camera.planned_mounting(robot.body)
        true = camera.true_mounting(robot.body, station.seed)
        turn = true.rotation().matrix() @ planned.rotation().matrix().T
        found.truth["mounting_deg"] = np.degrees(rotation_vector(turn)).tolist()
        higher = true.translation()[2] - planned.translation()[2]
        found.truth["flow_scale"] = [float(camera.height / (camera.height + higher) - 1)]
        found.truth["delay_ms"] = [1e3 * camera.clock_error]
    return found
