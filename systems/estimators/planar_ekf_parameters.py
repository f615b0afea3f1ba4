"""The numbers of the filter in `planar_ekf`."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from systems.estimators.planar_model import ProcessNoise, chi_square_3
from systems.validation import require, require_non_negative, require_positive


@dataclass
class PlanarEkfParameters:
    """Noise and options of the filter.

    Noise is given as continuous densities, so it does not depend on the rate. What grows with the
    distance or the turn leaves a robot at rest where it is.

    Attributes:
        speed_noise: random walk of the distance by time, m/sqrt(s).
        slip_noise: random walk of the distance by the distance, m/sqrt(m).
        side_noise: random walk of the sideways position by turning, m/sqrt(rad): the point that a
            differential drive turns about wanders by millimetres.
        scale_std: standard deviation of the wheels' scale at the start.
        scale_walk: how fast the scale changes for good (battery, floor), 1/sqrt(s).
        scale_wander: standard deviation of the scale about its mean, as slip comes and goes.
        scale_wander_time: how long that lasts, s: the time in which its correlation fades to 1/e.
            Without markers in view dead reckoning goes on with the mean.
        speed_lag: time constant of the motors between command and motion, s; geared ones take some
            0.1 s.
        wheel_radius: for `wheel_speeds`, m.
        gyro_noise: noise density of the gyro, rad/s/sqrt(Hz). The gyro's numbers here are the
            MPU6050's (InvenSense, PS-MPU-6000A-00 rev. 3.4, section 6.1): 0.005 deg/s/sqrt(Hz).
        turn_noise: random walk of the heading by turning, rad/sqrt(rad): what happens between the
            gyro's samples.
        gyro_bias_std: standard deviation of the gyro's bias at the start, rad/s: up to 20 deg/s
            either way, evenly. Less if it has been calibrated at rest.
        gyro_bias_walk: how fast the bias changes, rad/s/sqrt(s). 40 deg/s over 125 K are 0.0056
            rad/s for each kelvin; a seventh of a kelvin in a minute makes this.
        gyro_scale_std: standard deviation of the gyro's scale at the start: up to 3 % either way,
            evenly; that is 2.7 degrees in a quarter turn.
        gyro_scale_walk: how fast that changes, 1/sqrt(s).
        gyro_range: a yaw rate beyond this is a bad sample, rad/s (the MPU6050's 2000 deg/s).
        gyro_delay: how old a yaw rate is when the filter looks at it, s, in whole ticks. It tells
            of the tick that ended then. A block that samples at the filter's rate is heard of one
            tick later.
        yaw_rate_change: how far the yaw rate may be from what the last sample and the commands
            foretell, rad/s, until the gyro has been heard: on wheels that slip sideways.
        lost_speed_noise: `speed_noise` while commands are not finite.
        lost_turn_noise: random walk of the heading while the gyro fails and the commanded turn rate
            stands in, rad/sqrt(s).
        measurement_floor: standard deviations [x (m), y (m), theta (rad)] of the map, added to the
            covariance of each marker pose; errors that last are none that a filter averages out.
        stamp_noise: standard deviation of the pictures' stamps, s: rows exposed one after the
            other, a clock of its own, a simulation that stands still within its steps.
        gate: which innovations are refused: a probability below 1 (chi-square with 3 degrees of
            freedom), or the largest squared Mahalanobis distance.
        ambiguous: what to do with a marker pose that has two solutions: take the one `nearest` to
            the prediction (within the gate), or `reject` it.
        horizon: how late a marker pose may come, s; older ones are dropped.
        recovery_time: the filter begins anew when refused poses by several markers have agreed
            among themselves for this long, s (see `relocation`).
        recovery_time_single: the same of poses by any number of markers, s; longer than the robot
            has but one marker in view. A marker that was moved takes the estimate away after this.
            Infinite is allowed.
    """

    speed_noise: float = 0.003
    slip_noise: float = 0.01
    side_noise: float = 0.002
    scale_std: float = 0.1
    scale_walk: float = 0.003
    scale_wander: float = 0.0
    scale_wander_time: float = 1.0
    speed_lag: float = 0.0
    wheel_radius: float = 0.0325
    gyro_noise: float = 8.7e-5
    turn_noise: float = 0.003
    gyro_bias_std: float = 0.2
    gyro_bias_walk: float = 1e-4
    gyro_scale_std: float = 0.017
    gyro_scale_walk: float = 1e-4
    gyro_range: float = 35.0
    gyro_delay: float = 0.01
    yaw_rate_change: float = 0.0
    lost_speed_noise: float = 0.1
    lost_turn_noise: float = 0.3
    measurement_floor: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    stamp_noise: float = 0.003
    gate: float = 0.999
    ambiguous: str = "nearest"
    horizon: float = 0.5
    recovery_time: float = 1.0
    recovery_time_single: float = 15.0

    def __post_init__(self) -> None:
        zero_allowed = (
            "speed_noise", "slip_noise", "side_noise", "scale_walk", "scale_wander", "speed_lag",
            "gyro_noise", "turn_noise", "gyro_bias_walk", "gyro_delay", "gyro_scale_std",
            "gyro_scale_walk", "yaw_rate_change", "lost_speed_noise", "lost_turn_noise",
            "stamp_noise",
        )  # fmt: skip
        require_non_negative(**{name: getattr(self, name) for name in zero_allowed})
        above_zero = (
            "scale_std", "scale_wander_time", "wheel_radius", "gyro_bias_std", "gyro_range", "gate",
            "horizon", "recovery_time",
        )  # fmt: skip
        require_positive(**{name: getattr(self, name) for name in above_zero})
        floor = self.measurement_floor
        require(
            len(floor) == 3 and bool(np.isfinite(floor).all()) and min(floor) >= 0,
            "measurement_floor",
            floor,
            "three numbers, 0 or greater",
        )
        require(
            self.ambiguous in ("nearest", "reject"),
            "ambiguous",
            self.ambiguous,
            "'nearest' or 'reject'",
        )
        require(
            self.gyro_delay < self.horizon,
            "gyro_delay",
            self.gyro_delay,
            f"less than the horizon of {self.horizon:g} s",
        )
        require(
            self.recovery_time_single > 0,
            "recovery_time_single",
            self.recovery_time_single,
            "greater than 0",
        )

    def process_noise(self) -> ProcessNoise:
        """Returns the squares that the model takes."""
        return ProcessNoise(
            speed=self.speed_noise**2,
            slip=self.slip_noise**2,
            side=self.side_noise**2,
            gyro=self.gyro_noise**2,
            turn=self.turn_noise**2,
            bias=self.gyro_bias_walk**2,
            scale=self.scale_walk**2,
            gyro_scale=self.gyro_scale_walk**2,
            wander=self.scale_wander**2,
            fading=1 / self.scale_wander_time,
        )

    def squared_gate(self) -> float:
        """Returns the largest squared Mahalanobis distance that is taken."""
        return chi_square_3(self.gate) if self.gate < 1 else self.gate
