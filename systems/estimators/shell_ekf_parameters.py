"""The numbers of the filter in `shell_ekf`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from systems.estimators.shell_model import (
    BIAS,
    DELAY,
    GYRO,
    MOUNTING,
    ROCK,
    SCALE,
    SIZE,
    THETA,
    Array,
    ProcessNoise,
)
from systems.validation import require, require_non_negative, require_positive

SENSORS = ("marker", "flow", "imu")
_EVENLY = 1 / math.sqrt(3)  # standard deviation of what lies evenly within +-1


@dataclass
class ShellEkfParameters:
    """Noise and options of the filter.

    Deviations at the start are those of what lies evenly within a bound, which is said. Noise is
    given as continuous densities, so it does not depend on the rate.

    Attributes:
        sensors: which of `marker`, `flow` and `imu` are used. Without `marker` the pose is that of
            the start, carried on; without `imu` the body goes on as it went until the flow tells.
        initial_angles: [roll, pitch, yaw] until the first marker, rad.
        initial_deviation: standard deviation of each component of their rotation, rad. The default
            says that nothing is known: it is that of a uniform angle.
        start_beyond: with a larger deviation the next marker pose is taken as a start, rad.
        gyro_noise: noise density of the gyro, rad/s/sqrt(Hz); the BMI088's (BST-BMI088-DS001,
            chapter 1).
        gyro_bias_std: of the gyro's bias at the start, rad/s: 1 deg/s, the BMI088's bound.
        gyro_bias_walk: how fast it changes, rad/s/sqrt(s).
        gyro_scale_std: of the gyro's scales at the start: 1 %, the BMI088's bound.
        gyro_cross_std: of what each axis shows of each other. The gyro's axes are those that the
            camera's mounting is told in; with both unknown only their difference shows, and after
            minutes the filter claims to know more than that.
        gyro_range: a rate beyond is a bad sample, rad/s.
        imu_age: how old a sample is when the filter looks at it, s; left out, one tick of the
            filter: so old is what a block tells that samples at its rate.
        imu_silence: a sample that does not change by a single bit for so long is no news, s.
        lost_turn_noise: random walk of the rotation while the gyro tells nothing, rad/sqrt(s).
        mounting_std: of the camera's mounting at the start, each axis, rad: 1 degree.
        scale_std: of the flow's scale: 2 %.
        flow_noise: deviation of an increment by its own length, beside the covariance it comes
            with: what the model of a tilted camera leaves.
        flow_floor: deviation of an increment, each axis, beside that, rad.
        delay_std: of the camera's delay on the IMU's clock at the start, s.
        delay_slack: how many times what the deviation of the delay changes of an increment counts
            as noise. The delay is found where the gyro's rate changes, but vibration and rocking
            change it too, and the flow sees nothing of the one and little of the other: an error in
            a factor is none in the product, and passes for knowledge.
        rock_std: of the body's tilt against the normal, each axis, rad: 0.3 degrees.
        rock_time: its correlation time, s.
        placement_std: of a marker's place and turn on the sphere, each axis, rad: 0.5 degrees.
        marker_rotation_noise: deviation of a marker pose's rotation beside its covariance, rad.
        marker_position_noise: of its position, m: the shell is not as round as it should be.
        height_noise: the same along the normal, m: the camera is not as high as planned, by so much
            a marker pose is wrong all the time, and it tells only where the robot is in direction.
        marker_gate: largest squared Mahalanobis distance of a marker pose that is taken; of 6
            degrees of freedom, one in 10,000 good ones is beyond 27.9.
        flow_gate: of an increment; of 3 degrees of freedom, one in 10,000 is beyond 21.1. Wider
            than that, as the flow's errors have longer tails.
        horizon: how late a picture may come, s.
        recovery_angle: refused poses of two different markers that agree so well, the way between
            them counted, are believed: the filter begins anew, rad.
    """

    sensors: list[str] = field(default_factory=lambda: list(SENSORS))
    initial_angles: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    initial_deviation: float = math.pi * _EVENLY
    start_beyond: float = 0.35
    gyro_noise: float = math.radians(0.014)
    gyro_bias_std: float = math.radians(1.0) * _EVENLY
    gyro_bias_walk: float = math.radians(0.0002)
    gyro_scale_std: float = 0.01 * _EVENLY
    gyro_cross_std: float = 0.0
    gyro_range: float = 35.0
    imu_age: float | None = None
    imu_silence: float = 0.05
    lost_turn_noise: float = 0.5
    mounting_std: float = math.radians(1.0) * _EVENLY
    scale_std: float = 0.02 * _EVENLY
    flow_noise: float = 0.003
    flow_floor: float = 1e-5
    delay_std: float = 0.02
    delay_slack: float = 5.0
    rock_std: float = math.radians(0.3) * _EVENLY
    rock_time: float = 0.2
    placement_std: float = math.radians(0.5) * _EVENLY
    marker_rotation_noise: float = math.radians(0.02)
    marker_position_noise: float = 1e-5
    height_noise: float = 0.5e-3
    marker_gate: float = 28.0
    flow_gate: float = 50.0
    horizon: float = 0.25
    recovery_angle: float = math.radians(3.0)

    def __post_init__(self) -> None:
        known = bool(self.sensors) and set(self.sensors) <= set(SENSORS)
        require(
            known and len(set(self.sensors)) == len(self.sensors),
            "sensors",
            self.sensors,
            f"one or more of {', '.join(SENSORS)}, each once",
        )
        require(
            len(self.initial_angles) == 3 and bool(np.isfinite(self.initial_angles).all()),
            "initial_angles",
            self.initial_angles,
            "three finite numbers [roll, pitch, yaw] (rad)",
        )
        above_zero = (
            "initial_deviation", "start_beyond", "gyro_noise", "gyro_range", "imu_silence",
            "lost_turn_noise", "flow_floor", "rock_time", "marker_rotation_noise",
            "marker_position_noise", "marker_gate", "flow_gate", "horizon", "recovery_angle",
        )  # fmt: skip
        require_positive(**{name: getattr(self, name) for name in above_zero})
        others = set(vars(self)) - set(above_zero) - {"sensors", "initial_angles", "imu_age"}
        require_non_negative(**{name: getattr(self, name) for name in sorted(others)})
        age = self.imu_age
        require(
            age is None or 0 <= age < self.horizon,
            "imu_age",
            age,
            f"less than the horizon, {self.horizon:g} s, and not negative",
        )

    def process_noise(self) -> ProcessNoise:
        """Returns the squares that the model takes."""
        return ProcessNoise(
            gyro=self.gyro_noise**2,
            lost=self.lost_turn_noise**2,
            bias=self.gyro_bias_walk**2,
            rock=self.rock_std**2,
            rock_time=self.rock_time,
        )

    def initial_covariance(self, markers: int) -> Array:
        """Returns the covariance (n, n) of the state of a filter with so many markers."""
        deviation = np.zeros(SIZE + 3 * markers)
        deviation[THETA] = self.initial_deviation
        deviation[BIAS] = self.gyro_bias_std
        deviation[MOUNTING] = self.mounting_std
        deviation[SCALE] = self.scale_std
        deviation[DELAY] = self.delay_std
        deviation[ROCK] = self.rock_std
        deviation[GYRO] = np.where(np.eye(3) == 1, self.gyro_scale_std, self.gyro_cross_std).ravel()
        deviation[SIZE:] = self.placement_std
        return np.diag(deviation**2)
