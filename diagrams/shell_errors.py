"""Errors of a SnailBot that its builder did not want: drawn by the seed from within bounds."""

from __future__ import annotations

import math
from dataclasses import dataclass

from systems.validation import require, require_non_negative

# A deviation of what lies evenly within +-1.
_EVENLY = 1 / math.sqrt(3)
_LATEST = 0.2  # s; the filter remembers little more


@dataclass(frozen=True)
class ShellErrors:
    """Bounds of what is wrong; 0 for nothing.

    Attributes:
        placement_deg: of each marker on the shell, each axis.
        mounting_deg: of the camera about its own centre, each axis.
        flow_scale: of the flow: the camera is nearer to the shell than planned, or farther, by so
            large a part.
        gyro_bias_deg_s: of the gyro, each axis, deg/s.
        rock_deg: of the body on its springs against the shell's normal.
        missed_passages: part of the passages over a marker in which it is not found at all.
        delay: by how much pictures are stamped late on the IMU's clock, s; the same for every seed.
        outliers: part of the marker poses that are wrong.
        outlier_deg: by how much those are turned about the shell's centre.
    """

    placement_deg: float = 0.0
    mounting_deg: float = 0.0
    flow_scale: float = 0.0
    gyro_bias_deg_s: float = 0.0
    rock_deg: float = 0.0
    missed_passages: float = 0.0
    delay: float = 0.0
    outliers: float = 0.0
    outlier_deg: float = 8.0

    def __post_init__(self) -> None:
        require_non_negative(**vars(self))
        for name in ("missed_passages", "outliers"):
            require(getattr(self, name) <= 1, name, getattr(self, name), "0 to 1")
        require(self.delay <= _LATEST, "delay", self.delay, f"at most {_LATEST:g} s")
        require(self.flow_scale < 0.5, "flow_scale", self.flow_scale, "less than 0.5")

    @property
    def outlier_angle(self) -> float:
        """By how much wrong poses are turned, rad."""
        return math.radians(self.outlier_deg)

    def priors(self) -> dict[str, float]:
        """Returns the filter's deviations by name for errors of these bounds."""
        return {
            "placement_std": math.radians(self.placement_deg) * _EVENLY,
            "mounting_std": math.radians(self.mounting_deg) * _EVENLY,
            "scale_std": self.flow_scale * _EVENLY,
            "gyro_bias_std": math.radians(self.gyro_bias_deg_s) * _EVENLY,
            "rock_std": math.radians(self.rock_deg) * _EVENLY,
            "delay_std": self.delay,  # not drawn: it is the bound
        }


PRESETS = {
    "none": ShellErrors(),
    "base": ShellErrors(
        placement_deg=0.5,
        mounting_deg=1.0,
        flow_scale=0.02,
        gyro_bias_deg_s=0.3,
        rock_deg=0.3,
        missed_passages=0.2,
    ),
    "harsh": ShellErrors(
        placement_deg=1.0,
        mounting_deg=2.0,
        flow_scale=0.04,
        gyro_bias_deg_s=0.3,
        rock_deg=0.6,
        missed_passages=0.5,
        delay=0.03,
        outliers=0.03,
    ),
}
