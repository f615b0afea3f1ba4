"""A body that rocks on its springs, carried by a chassis that does not.

B0 is the chassis' frame, B that of the body on the springs: their origins are one, and
`R_B0B = exp([r]x)` with r = (x, y, 0), a tilt against the chassis' z.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import FrameId, FramePoseVector, GeometryFrame, SceneGraph
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    InputPort,
    LeafSystem,
    OutputPort,
    ValueProducer,
)

from systems.compiled import compiled, packed
from systems.noise import NoiseStream
from systems.small_matrices import multiply, rotation_of_quaternion
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

_SINES = 12  # for each axis
_FADE = 0.5  # s
_SMALL = 1e-2  # rad^2; below, series are more exact than what they are the series of


@dataclass
class RockingParameters:
    """How a body rocks: a random motion whose spectrum is even from one frequency to another.

    Attributes:
        bound: of the tilt about each axis, rad. The standard deviation is bound / sqrt(3), that of
            what lies evenly within the bound; the tilt, nearly normally distributed, is beyond it
            for a twelfth of the time.
        lowest: frequency, Hz.
        highest: frequency, Hz.
    """

    bound: float = math.radians(0.3)
    lowest: float = 0.2
    highest: float = 3.0

    def __post_init__(self) -> None:
        require_non_negative(bound=self.bound)
        require_positive(lowest=self.lowest, highest=self.highest)
        above = self.highest > self.lowest
        require(above, "highest", self.highest, f"greater than lowest, {self.lowest:g} Hz")


class Waves(NamedTuple):
    """Sines that make up a tilt: it is the imaginary part of the sum of weights exp(i rates t).

    Attributes:
        rates: (2, n) for x and y, rad/s.
        weights: (3, 2, n) complex: of the tilt, of its first and of its second derivative by time.
    """

    rates: Array
    weights: NDArray[np.complex128]


def draw_waves(parameters: RockingParameters, random: np.random.Generator) -> Waves:
    """Draws the sines: one from each of as many equal parts of the band, so that none is empty."""
    p, shape = parameters, (2, _SINES)
    place = (np.arange(_SINES) + random.random(shape)) / _SINES
    rates = 2 * math.pi * (p.lowest + (p.highest - p.lowest) * place)
    amplitude = p.bound * math.sqrt(2 / (3 * _SINES))
    wave = amplitude * np.exp(1j * random.uniform(0, 2 * math.pi, shape))
    return Waves(rates, np.array([wave, 1j * rates * wave, -(rates**2) * wave]))


def tilt(waves: Waves, t: float) -> tuple[Array, Array, Array]:
    """Returns the tilt (2,) rad at t (s), and its first and second derivative by time.

    It fades in during the first half second, from rest at zero.
    """
    q = np.empty((3, 2))
    _tilt(waves.rates, waves.weights, float(t), q)
    return q[0], q[1], q[2]


@compiled("void(f8[:,::1], c16[:,:,::1], f8, f8[:,::1])")
def _tilt(rates: Array, weights: NDArray[np.complex128], t: float, q: Array) -> None:
    """Writes the sums of the waves and of their two derivatives, (3, 2), at t (s)."""
    q[:] = 0.0
    for axis in range(2):
        for k in range(rates.shape[1]):
            c, s = math.cos(t * rates[axis, k]), math.sin(t * rates[axis, k])
            for n in range(3):
                q[n, axis] += weights[n, axis, k].real * s + weights[n, axis, k].imag * c
    s = t / _FADE
    if s >= 1:
        return
    # s^3 (10 - 15 s + 6 s^2): its first and second derivative are zero at both ends.
    f = s**3 * (10 - 15 * s + 6 * s * s)
    f_dot = 30 * (s * (1 - s)) ** 2 / _FADE
    f_ddot = 60 * s * (1 - s) * (1 - 2 * s) / _FADE**2
    for axis in range(2):
        q[2, axis] = f_ddot * q[0, axis] + 2 * f_dot * q[1, axis] + f * q[2, axis]
        q[1, axis] = f_dot * q[0, axis] + f * q[1, axis]
        q[0, axis] *= f


@compiled()
def _coefficients(s: float) -> tuple[float, float, float, float, float]:
    """Returns sin(a) / a, b = (1 - cos(a)) / s, c = (a - sin(a)) / (a s), db/ds, dc/ds; s = a^2."""
    if s < _SMALL:
        return (
            1 - s * (1 / 6 - s * (1 / 120 - s / 5040)),
            1 / 2 - s * (1 / 24 - s * (1 / 720 - s / 40320)),
            1 / 6 - s * (1 / 120 - s * (1 / 5040 - s / 362880)),
            -1 / 24 + s * (1 / 360 - s / 13440),
            -1 / 120 + s * (1 / 2520 - s / 120960),
        )
    angle = math.sqrt(s)
    a, b = math.sin(angle) / angle, (1 - math.cos(angle)) / s
    c = (1 - a) / s
    return a, b, c, (a - 2 * b) / (2 * s), (b - 3 * c) / (2 * s)


def tilted(r: Array, r_dot: Array, r_ddot: Array) -> tuple[Array, Array, Array]:
    """Returns how a body that is tilted is turned, and turns.

    With r = (x, y, 0) and k = x dy/dt - y dx/dt the angular velocity J(r) dr/dt, J the left
    Jacobian of SO(3), is (dx/dt + c k y, dy/dt - c k x, b k).

    Args:
        r: (2,) tilt about x and y, rad.
        r_dot: (2,) rad/s.
        r_ddot: (2,) rad/s^2.

    Returns:
        `R_B0B` (3, 3), the angular velocity (3,) of B in B0 and the angular acceleration (3,), told
        in B0.
    """
    R, turning = np.empty((3, 3)), np.empty((2, 3))
    _tilted(np.array([r, r_dot, r_ddot]), R, turning)
    return R, turning[0], turning[1]


@compiled("void(f8[:,::1], f8[:,::1], f8[:,::1])")
def _tilted(q: Array, R: Array, turning: Array) -> None:
    """Writes the same of a tilt and its derivatives (3, 2): velocity, then acceleration, (2, 3)."""
    (x, u, du), (y, v, dv) = (q[0, 0], q[1, 0], q[2, 0]), (q[0, 1], q[1, 1], q[2, 1])
    s = x * x + y * y
    a, b, c, b_s, c_s = _coefficients(s)
    k, dk, ds = x * v - y * u, x * dv - y * du, 2 * (x * u + y * v)
    ck, d_ck = c * k, c_s * ds * k + c * dk
    R[0, 0], R[0, 1], R[0, 2] = 1 - b * y * y, b * x * y, a * y
    R[1, 0], R[1, 1], R[1, 2] = b * x * y, 1 - b * x * x, -a * x
    R[2, 0], R[2, 1], R[2, 2] = -a * y, a * x, 1 - b * s
    turning[0, 0], turning[0, 1], turning[0, 2] = u + ck * y, v - ck * x, b * k
    turning[1, 0] = du + d_ck * y + ck * v
    turning[1, 1] = dv - d_ck * x - ck * u
    turning[1, 2] = b_s * ds * k + b * dk


# Of the body in W: rotation, row by row; place; velocity; what it adds to B0's acceleration.
_ROTATION, _PLACE, _VELOCITY, _ADDED = slice(9), slice(9, 12), slice(12, 18), slice(18, 21)


@compiled("void(f8[:,::1], c16[:,:,::1], f8, f8[::1], i8, f8[::1])")
def _ride(
    rates: Array,
    weights: NDArray[np.complex128],
    t: float,
    state: Array,
    num_positions: int,
    motion: Array,
) -> None:
    """Writes the motion (21,) in W of a body that rocks over a chassis.

    Args:
        rates: see `Waves`, as `weights`.
        weights: likewise.
        t: s.
        state: of the chassis: positions, of which its quaternion and place are the first seven,
            then velocities, of which its own are the first six.
        num_positions: in `state`.
        motion: written: `R_WB` (9), `p_WB` (3), `V_WB` (6, rotation first), and by what its angular
            acceleration exceeds that of the chassis (3).
    """
    q, R_B0B, turning = np.empty((3, 2)), np.empty((3, 3)), np.empty((2, 3))
    _tilt(rates, weights, t, q)
    _tilted(q, R_B0B, turning)
    R_WB0 = np.empty((3, 3))
    rotation_of_quaternion(state[:4], R_WB0)
    multiply(R_WB0, R_B0B, motion[_ROTATION].reshape(3, 3))
    motion[_PLACE] = state[4:7]
    motion[_VELOCITY] = state[num_positions : num_positions + 6]
    w0, w = motion[_VELOCITY][:3].copy(), np.empty(3)
    for i in range(3):
        w[i] = (
            R_WB0[i, 0] * turning[0, 0] + R_WB0[i, 1] * turning[0, 1] + R_WB0[i, 2] * turning[0, 2]
        )
        motion[_VELOCITY][i] += w[i]
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        motion[_ADDED][i] = w0[a] * w[b] - w0[b] * w[a]  # it turns with the chassis: Coriolis
        for j in range(3):
            motion[_ADDED][i] += R_WB0[i, j] * turning[1, j]


class RockingBody(LeafSystem):
    """Rocks on its springs over a chassis, at random within a band of frequencies.

    .. pydrake_system::

        name: RockingBody
        input_ports:
        - state
        - generalized_acceleration
        output_ports:
        - pose
        - spatial_velocity
        - spatial_acceleration
        - frame_pose

    Args:
        num_positions: of the chassis' model instance; the floating body's quaternion and place come
            first.
        num_velocities: likewise; the floating body's come first.
        parameters: how far and how fast.
        frame_id: of a geometry frame that rocks with the body, its parent the world's; None for
            none.
        seed: of the motion, a parameter of the Context.
        name: of the noise stream.

    Ports:
        state (input, vector of positions and velocities): the plant's `{model}_state`.
        generalized_acceleration (input, vector of velocities): the plant's
            `{model}_generalized_acceleration`.
        pose (output, RigidTransform): `X_WB`; its origin is B0's.
        spatial_velocity (output, vector of 6): of B in W, rotation first (rad/s, m/s).
        spatial_acceleration (output, vector of 6): likewise (rad/s^2, m/s^2).
        frame_pose (output, FramePoseVector): `X_WB` for SceneGraph; empty without a frame.

    It stands where a `BodyState` does for a body without springs. The motion is a sum of sines
    drawn from the seed and depends on nothing but the time: nothing that happens to the chassis
    shakes the body, and the body's inertia does not act back. It fades in during the first half
    second.

    Raises:
        ValueError: num_positions or seed out of range.
    """

    def __init__(
        self,
        *,
        num_positions: int = 7,
        num_velocities: int = 6,
        parameters: RockingParameters | None = None,
        frame_id: FrameId | None = None,
        seed: int = 0,
        name: str = "rocking",
    ) -> None:
        super().__init__()
        require(num_positions >= 7, "num_positions", num_positions, "at least 7")
        self._num_positions = num_positions
        self._parameters = parameters or RockingParameters()
        self._frame_id = frame_id
        self._noise = NoiseStream(self, seed=seed, name=name)
        self._state_input = self.DeclareVectorInputPort("state", num_positions + num_velocities)
        self._acceleration_input = self.DeclareVectorInputPort(
            "generalized_acceleration", num_velocities
        )
        self._waves = self.DeclareCacheEntry(
            "sines of this seed",
            ValueProducer(allocate=lambda: AbstractValue.Make([]), calc=self._calc_waves),
            {self.all_parameters_ticket()},
        )
        self._motion = self.DeclareCacheEntry(
            "the body in the world",
            ValueProducer(allocate=lambda: AbstractValue.Make([]), calc=self._calc_motion),
            {self.time_ticket(), self._waves.ticket(), self._state_input.ticket()},
        )
        motion = {self._motion.ticket()}
        self._pose_output = self.DeclareAbstractOutputPort(
            "pose", lambda: AbstractValue.Make(RigidTransform()), self._calc_pose, motion
        )
        self._velocity_output = self.DeclareVectorOutputPort(
            "spatial_velocity", 6, self._calc_velocity, motion
        )
        self._acceleration_output = self.DeclareVectorOutputPort(
            "spatial_acceleration",
            6,
            self._calc_acceleration,
            motion | {self._acceleration_input.ticket()},
        )
        self._frame_pose_output = self.DeclareAbstractOutputPort(
            "frame_pose",
            lambda: AbstractValue.Make(FramePoseVector()),
            self._calc_frame_pose,
            motion,
        )

    @property
    def frame_id(self) -> FrameId | None:
        """The geometry frame that rocks with the body."""
        return self._frame_id

    def state_input_port(self) -> InputPort:
        """Returns the port of positions and velocities."""
        return self._state_input

    def generalized_acceleration_input_port(self) -> InputPort:
        """Returns the port of the accelerations."""
        return self._acceleration_input

    def pose_output_port(self) -> OutputPort:
        """Returns the port of the body's pose."""
        return self._pose_output

    def spatial_velocity_output_port(self) -> OutputPort:
        """Returns the port of the body's velocity."""
        return self._velocity_output

    def spatial_acceleration_output_port(self) -> OutputPort:
        """Returns the port of the body's acceleration."""
        return self._acceleration_output

    def frame_pose_output_port(self) -> OutputPort:
        """Returns the port of the geometry frame's pose."""
        return self._frame_pose_output

    def _calc_waves(self, context: Context, output: AbstractValue) -> None:
        output.set_value([draw_waves(self._parameters, self._noise.generator(context, 0))])

    def _calc_motion(self, context: Context, output: AbstractValue) -> None:
        (waves,) = self._waves.Eval(context)
        state = packed(self._state_input.Eval(context))
        motion = np.empty(21)
        _ride(waves.rates, waves.weights, context.get_time(), state, self._num_positions, motion)
        output.set_value([motion])

    def _calc_pose(self, context: Context, output: AbstractValue) -> None:
        (motion,) = self._motion.Eval(context)
        R_WB = RotationMatrix(motion[_ROTATION].reshape(3, 3))
        output.set_value(RigidTransform(R_WB, motion[_PLACE]))

    def _calc_velocity(self, context: Context, output: Any) -> None:
        (motion,) = self._motion.Eval(context)
        output.SetFromVector(motion[_VELOCITY])

    def _calc_acceleration(self, context: Context, output: Any) -> None:
        (motion,) = self._motion.Eval(context)
        acceleration = self._acceleration_input.Eval(context)[:6].copy()
        acceleration[:3] += motion[_ADDED]
        output.SetFromVector(acceleration)

    def _calc_frame_pose(self, context: Context, output: Any) -> None:
        if self._frame_id is not None:
            X_WB = self._pose_output.Eval(context)
            output.get_mutable_value().set_value(self._frame_id, X_WB)

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder,
        plant: MultibodyPlant,
        model: ModelInstanceIndex,
        scene_graph: SceneGraph,
        *,
        parameters: RockingParameters | None = None,
        seed: int = 0,
        name: str = "rocking",
    ) -> RockingBody:
        """Adds the block over a model whose base floats, with a geometry frame of its name.

        It is connected to plant and scene. A camera on the body has this frame (`frame_id`) as its
        parent.
        """
        source = scene_graph.RegisterSource(name)
        frame = scene_graph.RegisterFrame(source, GeometryFrame(name))
        block = builder.AddSystem(
            RockingBody(
                num_positions=plant.num_positions(model),
                num_velocities=plant.num_velocities(model),
                parameters=parameters,
                frame_id=frame,
                seed=seed,
                name=name,
            )
        )
        block.set_name(name)
        builder.Connect(plant.get_state_output_port(model), block.state_input_port())
        builder.Connect(
            plant.get_generalized_acceleration_output_port(model),
            block.generalized_acceleration_input_port(),
        )
        builder.Connect(block.frame_pose_output_port(), scene_graph.get_source_pose_port(source))
        return block
