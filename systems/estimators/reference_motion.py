"""How a shell turns, told by the robot that carries it: for the robots which stand on it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, InputPort, LeafSystem, OutputPort

Array = NDArray[np.float64]


class CarriedShellMotion(LeafSystem):
    """Tells how a carried shell turns, by its carrier's gyro.

    .. pydrake_system::

        name: CarriedShellMotion
        input_ports:
        - imu
        - calibration
        output_ports:
        - reference_velocity

    Args:
        R_BR: orientation of the shell's frame on its carrier; None where their axes are the same.

    Ports:
        imu (input, vector of 6): [gyro (rad/s), accel (m/s^2)] of the carrier, in its base_link.
        calibration (input, vector of 18): of the carrier's `ShellEkf`: the first three are its
            gyro's bias (rad/s). May be left unconnected: then the gyro has none.
        reference_velocity (output, vector of 6): of the shell's frame in the world, told in the
            shell's frame, rotation first (rad/s, m/s), for `ShellEkf`. The translation is not
            known to a gyro and not asked for: 0. What is not finite is passed on, for the filter
            to count.
    """

    def __init__(self, *, R_BR: RotationMatrix | None = None) -> None:
        super().__init__()
        self._R_RB = (R_BR or RotationMatrix()).matrix().T
        self._imu_input = self.DeclareVectorInputPort("imu", 6)
        self._calibration_input = self.DeclareVectorInputPort("calibration", 18)
        self._velocity_output = self.DeclareVectorOutputPort(
            "reference_velocity",
            6,
            self._calc_velocity,
            {self._imu_input.ticket(), self._calibration_input.ticket()},
        )

    def imu_input_port(self) -> InputPort:
        """Returns the port of the carrier's IMU samples."""
        return self._imu_input

    def calibration_input_port(self) -> InputPort:
        """Returns the port of what the carrier has learned of its sensors."""
        return self._calibration_input

    def reference_velocity_output_port(self) -> OutputPort:
        """Returns the port of the shell's velocity."""
        return self._velocity_output

    def _calc_velocity(self, context: Context, output: Any) -> None:
        w_B = self._imu_input.Eval(context)[:3]
        if self._calibration_input.HasValue(context):
            w_B = w_B - self._calibration_input.Eval(context)[:3]
        output.SetFromVector(np.concatenate([self._R_RB @ w_B, np.zeros(3)]))


class KnownShellMotion(LeafSystem):
    """Tells the velocity of a shell whose motion in the world is known, in its own frame.

    .. pydrake_system::

        name: KnownShellMotion
        input_ports:
        - pose
        - spatial_velocity
        output_ports:
        - reference_velocity

    Ports:
        pose (input, RigidTransform): `X_WR`, such as `ShellMotion` sends.
        spatial_velocity (input, vector of 6): of R in W, rotation first (rad/s, m/s).
        reference_velocity (output, vector of 6): the same in R, for `ShellEkf`.
    """

    def __init__(self) -> None:
        super().__init__()
        self._pose_input = self.DeclareAbstractInputPort(
            "pose", AbstractValue.Make(RigidTransform())
        )
        self._velocity_input = self.DeclareVectorInputPort("spatial_velocity", 6)
        self._velocity_output = self.DeclareVectorOutputPort(
            "reference_velocity",
            6,
            self._calc_velocity,
            {self._pose_input.ticket(), self._velocity_input.ticket()},
        )

    def pose_input_port(self) -> InputPort:
        """Returns the port of the shell's pose."""
        return self._pose_input

    def spatial_velocity_input_port(self) -> InputPort:
        """Returns the port of the shell's velocity in the world."""
        return self._velocity_input

    def reference_velocity_output_port(self) -> OutputPort:
        """Returns the port of the shell's velocity in its own frame."""
        return self._velocity_output

    def _calc_velocity(self, context: Context, output: Any) -> None:
        R_RW = self._pose_input.Eval(context).rotation().matrix().T
        both = self._velocity_input.Eval(context).reshape(2, 3)
        output.SetFromVector((both @ R_RW.T).ravel())
