"""Yaw by integration of a gyro whose offset was measured at rest: what cheap robots steer by."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.angles import wrap
from systems.health import Counts
from systems.periods import period
from systems.sensors.imu_parameters import GRAVITY
from systems.validation import require, require_positive

Array = NDArray[np.float64]

AT_REST = np.array([0.0, 0.0, 0.0, 0.0, 0.0, GRAVITY])


def offsets(total: Array, number: float) -> Array:
    """Returns the mean error (6,) of samples of a level sensor at rest, by their sum (6,)."""
    return total / number - AT_REST if number else np.zeros(6)


class GyroYaw(LeafSystem):
    """Measures the offsets of an inertial sensor at the start, then integrates the yaw rate.

    .. pydrake_system::

        name: GyroYaw
        input_ports:
        - imu
        output_ports:
        - sample
        - yaw
        - health

    Args:
        rate: of the samples, Hz.
        num_samples: how many are averaged for the offsets, at rest; 0 leaves the offsets at zero.

    Ports:
        imu (input, vector of 6): [gyro (rad/s), accel (m/s^2)]. A sample that is not finite is
            neither averaged nor integrated, and counted.
        sample (output, vector of 6): the same less the offsets, at once; until they are known what
            a sensor at rest tells, [0, 0, 0, 0, 0, g].
        yaw (output, vector of 1): integral of the corrected yaw rate, rad, in (-pi, pi], at `rate`;
            each sample counts when the next one is taken.
        health (output, Health): samples that were not finite.

    The robot must stand level and still for `num_samples` / `rate`: its motion would become offset.

    Source: the Arduino library MPU6050_light, R. Fetick: `calcOffsets` averages 500 samples, with 1
    g taken off the vertical axis, and `update` does `angleZ += gyroZ * dt`. It has no filter for
    yaw: what the offset drifts after the start is in the yaw for good.

    Raises:
        ValueError: rate or number out of range.
    """

    def __init__(self, *, rate: float = 100.0, num_samples: int = 500) -> None:
        super().__init__()
        require_positive(rate=rate)
        require(num_samples >= 0, "num_samples", num_samples, "0 or greater")
        self._dt = period(rate)
        self._num_samples = num_samples
        self._imu_input = self.DeclareVectorInputPort("imu", 6)
        # Sum and number of the samples that were averaged.
        self._sum = self.DeclareDiscreteState(7)
        self._yaw = self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(self._dt, 0.0, self._step)
        self._sample_output = self.DeclareVectorOutputPort(
            "sample",
            6,
            self._calc_sample,
            {self._imu_input.ticket(), self.discrete_state_ticket(self._sum)},
        )
        self._yaw_output = self.DeclareStateOutputPort("yaw", self._yaw)
        self._counts = Counts(self, "bad_imu")

    def imu_input_port(self) -> InputPort:
        """Returns the port of the sensor's samples."""
        return self._imu_input

    def sample_output_port(self) -> OutputPort:
        """Returns the port of the corrected samples."""
        return self._sample_output

    def yaw_output_port(self) -> OutputPort:
        """Returns the port of the yaw."""
        return self._yaw_output

    def health_output_port(self) -> OutputPort:
        """Returns the port of the counts."""
        return self._counts.output_port

    def _corrected(self, context: Context) -> Array:
        total = context.get_discrete_state(self._sum).get_value()
        if total[6] < self._num_samples:
            return AT_REST
        sample: Array = self._imu_input.Eval(context) - offsets(total[:6], total[6])
        return sample

    def _step(self, context: Context, discrete_state: DiscreteValues) -> None:
        if context.get_time() < self._dt / 2:
            return  # the sensor takes its first sample in this very moment
        sample = self._imu_input.Eval(context).tolist()
        if not math.isfinite(sum(sample)):
            self._counts.add(context, discrete_state, bad_imu=1)
            return
        total = discrete_state.get_mutable_value(self._sum)
        number = float(total[6])
        if number < self._num_samples:
            total += [*sample, 1.0]
            return
        yaw = discrete_state.get_mutable_value(self._yaw)
        yaw[0] = wrap(float(yaw[0]) + (sample[2] - float(total[2]) / max(number, 1.0)) * self._dt)

    def _calc_sample(self, context: Context, output: Any) -> None:
        output.SetFromVector(self._corrected(context))
