"""Model of a robot on a shell for `shell_ekf`: what its gyro, its camera and the markers tell.

State: the rotation `R_RB` of the body at the time of the last picture, and a vector x of what is
wrong with the sensors; of x, THETA and STEP are always zero (they are errors only):

    THETA     error of R_RB: R_true = exp([theta]x) R, in the shell's frame R, rad
    BIAS      of the gyro, in B, rad/s
    MOUNTING  R_BC = exp([m]x) of the nominal one, about the camera's own centre, in B, rad
    SCALE     of the flow, relative: of what moves over the shell, and of turns about the normal
    DELAY     by how much pictures are older than their stamps, on the IMU's clock, s
    ROCK      tilt of the body against the normal, about x and y: R_RB = R_RN exp([r]x), rad
    GYRO      (3, 3) row by row: the true rate is (1 + D) of the measured one less its bias
    STEP      error of the body's last step from picture to picture, seen by the flow, in B, rad
    3 for each marker: it is exp([psi]x) of its pose by the map, about the shell's centre, rad

The body stands on the shell: its origin is at L z_N, L = radius + height and N upright on the
normal. So a marker pose tells mounting and rock by the difference of its rotation and its place,
and a misplaced marker, which turns both, is not mistaken for them. A marker's error lasts: it is a
state, else ten pictures of one marker, or five passages over it, would count as so many witnesses.

All functions are pure; times in seconds. Covariances are in the order of the state.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from systems.compiled import packed
from systems.estimators import shell_arithmetic
from systems.flow.shell import ShellView, back_project
from systems.markers.pnp import cross_matrix
from systems.shell.angles import nearest_rotation, one_rotation, rotation_vector

Array = NDArray[np.float64]

_AT = shell_arithmetic  # where each part begins
THETA, BIAS, MOUNTING, STEP = (
    slice(at, at + 3) for at in (_AT.THETA, _AT.BIAS, _AT.MOUNTING, _AT.STEP)
)
SCALE, ROCK = (slice(at, at + 2) for at in (_AT.SCALE, _AT.ROCK))
GYRO, DELAY = slice(_AT.GYRO, _AT.GYRO + 9), _AT.DELAY
SIZE = _AT.SIZE  # without markers

_GRID = (16, 12)  # pixels by which the camera's tilt is weighed
_SMALL = 1e-5  # rad, step of a difference quotient
_IDENTITY = np.eye(3)
_IN_PLANE = _IDENTITY[:, :2]
_Z = np.array([0.0, 0.0, 1.0])
_BY_ROCK = cross_matrix(_Z)[:, :2]  # of the normal, in B
_NO_WAY = np.zeros(0)


def marker_slice(k: int) -> slice:
    """Returns where the k-th marker of the map stands in the state."""
    return slice(SIZE + 3 * k, SIZE + 3 * k + 3)


class State(NamedTuple):
    """What the filter believes.

    Attributes:
        R: (3, 3) `R_RB`.
        x: (n,) see the module.
        P: (n, n) its covariance.
    """

    R: Array
    x: Array
    P: Array


class Turn(NamedTuple):
    """What the gyro and the reference robot say of an interval.

    Attributes:
        gyro: (3,) integral of the gyro, in B, rad.
        reference: (3,) integral of the reference's angular velocity, in R, rad.
        dt: length, s.
        rate_before: (3,) the gyro at its beginning, rad/s.
        rate_after: (3,) at its end.
        lost: how much of it the gyro told nothing, s.
        way: (3,) what the flow says of the body's turn over the shell, rad; None without. Scale
            errors are told by it, as the gyro's own sum holds the rocking, which is noise here: an
            error that shows in the factor and in the product passes for a scale.
    """

    gyro: Array
    reference: Array
    dt: float
    rate_before: Array
    rate_after: Array
    lost: float = 0.0
    way: Array | None = None


class ProcessNoise(NamedTuple):
    """What grows with time.

    Attributes:
        gyro: density squared of the gyro, rad^2/s.
        lost: the same while the gyro tells nothing, rad^2/s.
        bias: of the gyro's bias, (rad/s)^2/s.
        rock: variance of the rock, rad^2.
        rock_time: its correlation time, s.
    """

    gyro: float
    lost: float
    bias: float
    rock: float
    rock_time: float


class Update(NamedTuple):
    """What became of a measurement.

    Attributes:
        state: after it, or before it, if it was refused.
        nis: squared Mahalanobis distance by degrees of freedom.
        accepted: whether it was within the gate.
    """

    state: State
    nis: float
    accepted: bool


def tilt_sensitivity(view: ShellView) -> tuple[Array, Array]:
    """Returns what a turn of the camera does to the flow on the sphere, and what its change does.

    The flow takes the camera for mounted as planned. If it is turned by t about its own centre, a
    true rotation u of the body over the shell is told as u + T[:, :, k] t_k u (to first order):
    the turned axes, and the distance to the surface, wrongly believed to be even, which makes an
    apparent turn about the normal of several times t. If it turns by t between the pictures, that
    is told as K t.

    Returns:
        T: (3, 3, 3) 1/rad. K: (3, 3).
    """
    camera, radius = view.camera, view.radius
    across, down = (
        (np.arange(n) + 0.5) * size / n - 0.5
        for n, size in zip(_GRID, (camera.width, camera.height), strict=True)
    )
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    R, p = view.X_SC.rotation().matrix(), view.X_SC.translation()

    def jacobians(tilt: Array) -> tuple[Array, Array]:
        X_SC = RigidTransform(RotationMatrix(one_rotation(tilt) @ R), p)
        points = back_project(camera, X_SC, radius, pixels)
        R_SC = X_SC.rotation().matrix()
        _, by_point = camera.project_with_jacobian((points - p) @ R_SC)
        by_point = by_point @ R_SC.T
        return by_point @ cross_matrix(points), by_point @ cross_matrix(points - p)

    planned, by_turn = jacobians(np.zeros(3))
    turned = [[jacobians(sign * _SMALL * axis)[0] for sign in (1, -1)] for axis in np.eye(3)]
    everywhere = np.isfinite(planned + sum(a + b for a, b in turned)).all(axis=(1, 2))
    inverse = np.linalg.pinv(planned[everywhere].reshape(-1, 3))
    T = np.stack(
        [inverse @ (a - b)[everywhere].reshape(-1, 3) / (2 * _SMALL) for a, b in turned], axis=-1
    )
    return T, inverse @ by_turn[everywhere].reshape(-1, 3)


class ShellModel:
    """Prediction and measurements, with their Jacobians.

    Args:
        view: the camera and its place over the shell.
        height: of the body's origin over the shell, m.
        noise: what grows with time.
    """

    def __init__(self, *, view: ShellView, height: float, noise: ProcessNoise) -> None:
        self.reach = view.radius + height
        self.arm = view.parameters.camera_height - height  # of the camera over the body's origin
        self.noise = noise
        T, by_turn = tilt_sensitivity(view)
        self._T = packed(T)
        # Rocking about the body's origin carries the camera over the shell, by this part of the
        # angle, and turns it by the rest.
        carried = self.arm / (self.reach + self.arm)
        self._rock_tilt = (1 - carried) * _IN_PLANE
        self._rock_step = (1 - carried) * (by_turn - np.eye(3)) @ _IN_PLANE

    def turned(self, state: State, turn: Turn) -> Array:
        """Returns the body's rotation over the shell during an interval, (3,) rad, in B."""
        u, factor = np.empty((2, 3))
        way = _NO_WAY if turn.way is None else packed(turn.way)
        shell_arithmetic.turned(
            packed(state.R), packed(state.x), packed(turn.gyro), packed(turn.reference), turn.dt,
            way, u, factor,
        )  # fmt: skip
        return u

    def transition(self, state: State, turn: Turn) -> tuple[Array, Array, Array]:
        """Returns the derivatives of one step.

        Returns:
            F: (SIZE, SIZE) by the state. G: (SIZE, 8) by noise of the step (3), of the rock (2) and
            of the bias (3). The step: (3,) rad, the body's rotation over the shell, in B.
        """
        F, G, u = np.empty((SIZE, SIZE)), np.empty((SIZE, 8)), np.empty(3)
        shell_arithmetic.transition(
            packed(state.R), packed(state.x), packed(turn.gyro), packed(turn.reference), turn.dt,
            packed(turn.rate_before), packed(turn.rate_after),
            _NO_WAY if turn.way is None else packed(turn.way),
            self._rock_step, self.noise.rock_time, u, F, G,
        )  # fmt: skip
        return F, G, u

    def carried(self, state: State, turn: Turn, u: Array) -> tuple[State, Array]:
        """Returns the state after a step u (3,) rad, and by what the rock has faded (2,) rad.

        Its covariance is left as it was.
        """
        R, x, change = np.empty((3, 3)), np.empty_like(state.x), np.empty(2)
        fading = math.expm1(-turn.dt / self.noise.rock_time)
        shell_arithmetic.carry(packed(state.R), packed(state.x), u, fading, R, x, change)
        return State(R, x, state.P), change

    def predict(self, state: State, turn: Turn) -> tuple[State, Array, Array]:
        """Carries the state to the end of an interval by the gyro.

        Returns:
            The state, the step (3,) that the body has made, and what the flow is to see of it but
            for its own errors (3,), rad: less the change of the rock.
        """
        noise = self.noise
        F, G, u = self.transition(state, turn)
        step = noise.gyro * turn.dt + noise.lost * turn.lost
        rock = -noise.rock * math.expm1(-2 * turn.dt / noise.rock_time)
        bias = noise.bias * turn.dt
        Q = np.array([step, step, step, rock, rock, bias, bias, bias])
        P = np.array(state.P, order="C")
        shell_arithmetic.propagate(P, F, G, Q)  # the markers stay where they are
        after, change = self.carried(state, turn, u)
        return State(after.R, after.x, P), u, u + self._rock_step @ change

    def flow(self, state: State, way: Array, seen: Array) -> tuple[Array, Array]:
        """Returns the increment that the flow is to tell, and its derivative.

        Args:
            state: at the end of the interval.
            way: (3,) rad, what multiplies the flow's errors: the increment itself (see `Turn`).
            seen: (3,) by `predict`.

        Returns:
            (3,) rad, in B, and (3, SIZE) by the state.
        """
        expected, H = np.empty(3), np.empty((3, SIZE))
        shell_arithmetic.expect_flow(
            packed(state.x), packed(way), packed(seen), self._T, self._rock_tilt, expected, H
        )
        return expected, H

    def place(self, state: State) -> tuple[Array, Array]:
        """Returns where the body's origin is, and its derivative.

        Returns:
            (3,) m, in R, and (3, SIZE) by the state.
        """
        p = self.position(state)
        H = np.zeros((3, SIZE))
        H[:, THETA] = -cross_matrix(p)
        H[:, ROCK] = self.reach * state.R @ _BY_ROCK
        return p, H

    def position(self, state: State) -> Array:
        """Returns where the body's origin is, (3,) m, in R."""
        p = np.empty(3)
        shell_arithmetic.stand(packed(state.R), packed(state.x), self.reach, p)
        return p

    def pose_after(self, state: State, turn: Turn) -> tuple[Array, Array]:
        """Returns rotation (3, 3) and place (3,) m, in R, at the end of an interval."""
        R, p = np.empty((3, 3)), np.empty(3)
        shell_arithmetic.pose_after(
            packed(state.R), packed(state.x), packed(turn.gyro), packed(turn.reference), turn.dt,
            math.expm1(-turn.dt / self.noise.rock_time), self.reach, R, p,
        )  # fmt: skip
        return R, p

    def pose_covariance(self, state: State) -> Array:
        """Returns the covariance (6, 6) of rotation and place, in R, of a state without markers."""
        covariance = np.empty((6, 6))
        shell_arithmetic.pose_covariance(
            packed(state.R), packed(state.x), packed(state.P), self.reach, covariance
        )
        return covariance

    def marker_pose(self, state: State, marker: int) -> tuple[Array, Array, Array]:
        """Returns the pose that a picture of a marker is to tell, and its derivative.

        Args:
            state: at the time of the picture.
            marker: its index in the map.

        Returns:
            (3, 3) and (3,): the pose, in R. (6, n) by the state: a small rotation vector in R, then
            the position.
        """
        R, x = state.R, state.x
        p, by_base = self.place(state)
        away = one_rotation(-x[marker_slice(marker)])
        mounting = one_rotation(x[MOUNTING])
        arm = self.arm * _Z
        told = away @ (p + R @ (arm - mounting @ arm))
        H = np.zeros((6, len(x)))
        H[:3, THETA] = away
        H[:3, MOUNTING] = away @ R
        H[:3, marker_slice(marker)] = -np.eye(3)
        H[3:, :SIZE] = away @ by_base
        H[3:, MOUNTING] = self.arm * away @ R @ cross_matrix(_Z)
        H[3:, marker_slice(marker)] = cross_matrix(told)
        return away @ R @ mounting, told, H

    def start(self, state: State, R_told: Array, marker: int, variance: float) -> State:
        """Returns a state whose rotation is that of a marker pose, known only roughly."""
        away = one_rotation(-state.x[marker_slice(marker)])
        R = away.T @ R_told @ one_rotation(state.x[MOUNTING]).T
        P = state.P.copy()
        P[THETA] = P[:, THETA] = P[STEP] = P[:, STEP] = 0.0
        P[THETA, THETA] = variance * np.eye(3)
        return State(nearest_rotation(R), state.x, P)

    def update_flow(
        self, state: State, seen: Array, told: Array, noise: Array, gate: float
    ) -> Update:
        """Weighs an increment (3,) rad with covariance (3, 3)."""
        expected, H = self.flow(state, told, seen)
        return corrected(state, H, told - expected, noise, gate)

    def update_marker(
        self, state: State, marker: int, R_told: Array, p_told: Array, noise: Array, gate: float
    ) -> Update:
        """Weighs a marker pose with covariance (6, 6)."""
        R, p, H = self.marker_pose(state, marker)
        y = np.concatenate([rotation_vector(R_told @ R.T), p_told - p])
        return corrected(state, H, y, noise, gate)


def corrected(state: State, H: Array, y: Array, noise: Array, gate: float) -> Update:
    """Corrects a state by an innovation, unless it is beyond the gate.

    Args:
        state: before.
        H: (m, k) derivative of the measurement by the first k of the state.
        y: (m,) what was measured less what was expected.
        noise: (m, m).
        gate: largest squared Mahalanobis distance that is taken.
    """
    R, x, P = (np.empty_like(part, order="C") for part in state)
    distance = shell_arithmetic.correct(
        packed(state.R), packed(state.x), packed(state.P), H, y, packed(noise), float(gate), R, x, P
    )
    accepted = 0 <= distance <= gate
    return Update(State(R, x, P) if accepted else state, distance / len(y), accepted)
