"""What is wrong with inertial sensors, and what data sheets say of two of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from systems.validation import require, require_non_negative, require_positive

GRAVITY = 9.81  # m/s^2, as Drake's UniformGravityFieldElement


@dataclass
class ImuParameters:
    """Errors of an inertial sensor. Three numbers are [x, y, z] in the sensor's frame.

    A tolerance is what the maker grants from one piece to the next: the seed draws an error of this
    piece, uniformly from within, which then stays. The drift is a Gauss-Markov process: it wanders
    about 0 with the standard deviation `drift` and forgets in `drift_time`.

    The vibration is what motors and wheels shake the sensor with, as true motion: noise in a band,
    each axis by itself. The sensor has no filter before it samples, so what lies above half its
    rate shows folded down.

    Attributes:
        gyro_noise_density: rad/s/sqrt(Hz).
        gyro_bias: constant, rad/s.
        gyro_bias_tolerance: rad/s, each axis.
        gyro_drift: rad/s.
        gyro_drift_time: s.
        gyro_scale_tolerance: relative, each axis.
        gyro_range: the largest rate that is told, rad/s; left out: any.
        accel_noise_density: m/s^2/sqrt(Hz).
        accel_bias: constant, m/s^2.
        accel_bias_tolerance: m/s^2, each axis.
        accel_drift: m/s^2.
        accel_drift_time: s.
        accel_scale_tolerance: relative, each axis.
        accel_range: m/s^2; left out: any.
        cross_axis_tolerance: share of each other axis that shows on an axis, of both sensors.
        bits: of a number that the sensor tells, which has 2^bits steps from -range to +range; 0 for
            no steps. Needs the ranges.
        vibration_frequency: middle of the band, Hz.
        vibration_bandwidth: from half power to half power, Hz; 0 is a pure tone.
        gyro_vibration: root mean square, rad/s.
        accel_vibration: root mean square, m/s^2.
    """

    gyro_noise_density: float = 0.0
    gyro_bias: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    gyro_bias_tolerance: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    gyro_drift: float = 0.0
    gyro_drift_time: float = 100.0
    gyro_scale_tolerance: float = 0.0
    gyro_range: float | None = None
    accel_noise_density: float = 0.0
    accel_bias: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    accel_bias_tolerance: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    accel_drift: float = 0.0
    accel_drift_time: float = 100.0
    accel_scale_tolerance: float = 0.0
    accel_range: float | None = None
    cross_axis_tolerance: float = 0.0
    bits: int = 0
    vibration_frequency: float = 100.0
    vibration_bandwidth: float = 10.0
    gyro_vibration: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    accel_vibration: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])

    def __post_init__(self) -> None:
        for kind in ("gyro", "accel"):
            for name in ("noise_density", "drift", "scale_tolerance"):
                require_non_negative(**{f"{kind}_{name}": getattr(self, f"{kind}_{name}")})
            require_positive(**{f"{kind}_drift_time": getattr(self, f"{kind}_drift_time")})
            for name in (f"{kind}_bias", f"{kind}_bias_tolerance", f"{kind}_vibration"):
                value = getattr(self, name)
                least = -np.inf if name.endswith("bias") else 0.0
                require(
                    len(value) == 3 and bool(np.isfinite(value).all()) and min(value) >= least,
                    name,
                    value,
                    "three finite numbers" + (", 0 or greater" if least == 0.0 else ""),
                )
            limit = getattr(self, f"{kind}_range")
            if limit is not None:
                require_positive(**{f"{kind}_range": limit})
        require_non_negative(
            cross_axis_tolerance=self.cross_axis_tolerance,
            vibration_frequency=self.vibration_frequency,
            vibration_bandwidth=self.vibration_bandwidth,
        )
        require(0 <= self.bits <= 32, "bits", self.bits, "0 to 32")
        unlimited = self.gyro_range is None or self.accel_range is None
        require(not (self.bits and unlimited), "bits", self.bits, "0 unless both ranges are given")


@dataclass
class Mpu6050Parameters(ImuParameters):
    """The InvenSense MPU-6050 in its finest ranges; every figure can be overridden.

    Source: MPU-6000/MPU-6050 Product Specification, revision 3.4, tables 6.1 and 6.2: gyro +-250
    deg/s at 131 LSB/(deg/s), rate noise 0.005 deg/s/sqrt(Hz), zero-rate output within +-20 deg/s,
    sensitivity within 3 %; accelerometer +-2 g at 16384 LSB/g, 400 ug/sqrt(Hz), zero-g output
    within 50 mg (x, y) and 80 mg (z), calibration within 3 %; cross-axis within 2 %; 16 bits. The
    sheet gives no drift at rest. Ours stands for the warmth: it grants 20 deg/s from 25 to 85
    degrees C, so a twentieth of a kelvin is worth 0.017 deg/s, and 60 mg from 0 to 70 degrees C.
    """

    gyro_noise_density: float = math.radians(0.005)
    gyro_bias_tolerance: list[float] = field(default_factory=lambda: [math.radians(20.0)] * 3)
    gyro_drift: float = math.radians(0.017)
    gyro_scale_tolerance: float = 0.03
    gyro_range: float | None = math.radians(250.0)
    accel_noise_density: float = 400e-6 * GRAVITY
    accel_bias_tolerance: list[float] = field(
        default_factory=lambda: [0.05 * GRAVITY, 0.05 * GRAVITY, 0.08 * GRAVITY]
    )
    accel_drift: float = 50e-6 * GRAVITY
    accel_scale_tolerance: float = 0.03
    accel_range: float | None = 2.0 * GRAVITY
    cross_axis_tolerance: float = 0.02
    bits: int = 16


@dataclass
class Bmi088Parameters(ImuParameters):
    """The Bosch BMI088 as [SNAIL] sets it, on a robot with small motors.

    Source: BMI088 Data Sheet, BST-BMI088-DS001, chapter 1: gyro +-125 deg/s at 262.144
    LSB/(deg/s), 0.014 deg/s/sqrt(Hz), zero-rate offset +-1 deg/s, sensitivity within 1 %,
    cross-axis 1 %; accelerometer 160 (x, y) and 190 (z) ug/sqrt(Hz), of which we take the larger,
    zero-g offset +-20 mg; 16 bits. No tolerance is given for the accelerometer's sensitivity. Drift
    as of the MPU-6050: a twentieth of a kelvin, at 0.015 deg/s and 0.2 mg per kelvin.

    +-2 g is what [SNAIL] says; the chip's own smallest range is +-3 g (the +-2 g are the BMI085's).

    No sheet gives the vibration. Ours is an assumption: the robot shakes by half a micrometre (rms)
    at 100 Hz, a rotor's 6000 turns a minute, which is 0.2 m/s^2, and rocks by as much over 20 mm,
    half its base, which is 0.9 deg/s.
    """

    gyro_noise_density: float = math.radians(0.014)
    gyro_bias_tolerance: list[float] = field(default_factory=lambda: [math.radians(1.0)] * 3)
    gyro_drift: float = math.radians(0.015 / 20)
    gyro_scale_tolerance: float = 0.01
    gyro_range: float | None = math.radians(125.0)
    accel_noise_density: float = 190e-6 * GRAVITY
    accel_bias_tolerance: list[float] = field(default_factory=lambda: [0.02 * GRAVITY] * 3)
    accel_drift: float = 0.2e-3 / 20 * GRAVITY
    accel_range: float | None = 2.0 * GRAVITY
    cross_axis_tolerance: float = 0.01
    bits: int = 16
    gyro_vibration: list[float] = field(default_factory=lambda: [math.radians(0.9)] * 3)
    accel_vibration: list[float] = field(default_factory=lambda: [0.2] * 3)
