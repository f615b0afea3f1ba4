"""An inertial sensor: angular rate and specific force, with white noise and a constant bias."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, InputPort, LeafSystem, OutputPort

from systems.markers.pnp import cross_matrix
from systems.noise import NoiseStream, sample_index
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

GRAVITY = 9.81  # m/s^2, as Drake's UniformGravityFieldElement


@dataclass
class ImuParameters:
    """Noise of an inertial sensor.

    Attributes:
        gyro_noise_density: rad/s/sqrt(Hz).
        gyro_bias: constant, [x, y, z] in the sensor's frame, rad/s.
        accel_noise_density: m/s^2/sqrt(Hz).
        accel_bias: constant, [x, y, z] in the sensor's frame, m/s^2.
    """

    gyro_noise_density: float = 0.0
    gyro_bias: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    accel_noise_density: float = 0.0
    accel_bias: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])

    def __post_init__(self) -> None:
        require_non_negative(
            gyro_noise_density=self.gyro_noise_density,
            accel_noise_density=self.accel_noise_density,
        )
        for name in ("gyro_bias", "accel_bias"):
            value = getattr(self, name)
            require(
                len(value) == 3 and bool(np.isfinite(value).all()),
                name,
                value,
                "three finite numbers",
            )


def ideal_sample(X_WB: RigidTransform, V_WB: Array, A_WB: Array, p_BS: Array) -> Array:
    """Returns what a perfect sensor at S, fixed to the body B with B's axes, measures.

    Args:
        X_WB: pose of the body.
        V_WB: (6,) spatial velocity of B in W: angular (rad/s), then of B's origin (m/s).
        A_WB: (6,) spatial acceleration of B in W: angular (rad/s^2), then of B's origin (m/s^2).
        p_BS: (3,) position of the sensor in the body, m.

    Returns:
        (6,) angular velocity (rad/s) and specific force (m/s^2), in B; at rest the force is +g
        upward.
    """
    R_WB = X_WB.rotation().matrix()
    W = cross_matrix(V_WB[:3])
    arm = R_WB @ p_BS
    acceleration = A_WB[3:] + (cross_matrix(A_WB[:3]) + W @ W) @ arm
    acceleration[2] += GRAVITY
    return (np.stack([V_WB[:3], acceleration]) @ R_WB).ravel()


class Imu(LeafSystem):
    """Samples a body's angular rate and specific force.

    .. pydrake_system::

        name: Imu
        input_ports:
        - pose
        - spatial_velocity
        - spatial_acceleration
        output_ports:
        - sample

    Args:
        parameters: noise.
        rate: samples a second, Hz.
        p_BS: position of the sensor in the body, m.
        seed: of the noise, a parameter of the Context.
        name: of the noise stream.

    Ports:
        pose (input, RigidTransform): `X_WB`.
        spatial_velocity (input, vector of 6): of the body in W, rotation first (rad/s, m/s).
        spatial_acceleration (input, vector of 6): likewise (rad/s^2, m/s^2).
        sample (output, vector of 6): [gyro (rad/s), accel (m/s^2)] in the body's axes, held between
            samples; zeros before the first.

    White noise of density d sampled at `rate` has the standard deviation d sqrt(rate).

    Raises:
        ValueError: rate, seed or position out of range.
    """

    def __init__(
        self,
        *,
        parameters: ImuParameters | None = None,
        rate: float = 100.0,
        p_BS: Array | None = None,
        seed: int = 0,
        name: str = "imu",
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        p = parameters or ImuParameters()
        self._rate = rate
        self._bias = np.array([*p.gyro_bias, *p.accel_bias])
        self._deviation = np.repeat([p.gyro_noise_density, p.accel_noise_density], 3)
        self._deviation *= np.sqrt(rate)
        self._p_BS = np.zeros(3) if p_BS is None else np.array(p_BS, float)
        sound = self._p_BS.shape == (3,) and bool(np.isfinite(self._p_BS).all())
        require(sound, "p_BS", self._p_BS.tolist(), "three finite numbers (m)")
        self._noise = NoiseStream(self, seed=seed, name=name)
        self._pose_input = self.DeclareAbstractInputPort(
            "pose", AbstractValue.Make(RigidTransform())
        )
        self._velocity_input = self.DeclareVectorInputPort("spatial_velocity", 6)
        self._acceleration_input = self.DeclareVectorInputPort("spatial_acceleration", 6)
        self._sample = self.DeclareDiscreteState(6)
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / rate, 0.0, self._measure)
        self._sample_output = self.DeclareStateOutputPort("sample", self._sample)

    def pose_input_port(self) -> InputPort:
        """Returns the port of the body's pose."""
        return self._pose_input

    def spatial_velocity_input_port(self) -> InputPort:
        """Returns the port of the body's velocity."""
        return self._velocity_input

    def spatial_acceleration_input_port(self) -> InputPort:
        """Returns the port of the body's acceleration."""
        return self._acceleration_input

    def sample_output_port(self) -> OutputPort:
        """Returns the port of the samples."""
        return self._sample_output

    def _measure(self, context: Context, discrete_state: DiscreteValues) -> None:
        ideal = ideal_sample(
            self._pose_input.Eval(context),
            self._velocity_input.Eval(context),
            self._acceleration_input.Eval(context),
            self._p_BS,
        )
        index = sample_index(context.get_time(), self._rate)
        noise = self._noise.normals(context, index, 6)
        discrete_state.set_value(self._sample, ideal + self._bias + self._deviation * noise)
