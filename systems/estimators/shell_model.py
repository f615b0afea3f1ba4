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

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from systems.compiled import packed
from systems.estimators import shell_arithmetic, shell_correction
from systems.flow.shell import ShellView, back_project
from systems.markers.pnp import cross_matrix
from systems.shell.angles import nearest_rotation, one_rotation

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
        self.variances = np.array(noise)  # the same for compiled code
        T, by_turn = tilt_sensitivity(view)
        self._T = packed(T)
        # Rocking about the body's origin carries the camera over the shell, by this part of the
        # angle, and turns it by the rest.
        carried = self.arm / (self.reach + self.arm)
        self._rock_tilt = packed((1 - carried) * _IN_PLANE)
        self.rock_step = packed((1 - carried) * (by_turn - np.eye(3)) @ _IN_PLANE)

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
            self.rock_step, self.noise.rock_time, u, F, G,
        )  # fmt: skip
        return F, G, u

    def predict(self, state: State, turn: Turn) -> tuple[State, Array, Array]:
        """Carries the state to the end of an interval by the gyro.

        Returns:
            The state, the step (3,) that the body has made, and what the flow is to see of it but
            for its own errors (3,), rad: less the change of the rock.
        """
        after = _like(state)
        u, seen = np.empty(3), np.empty(3)
        shell_arithmetic.predict(
            *_parts(state), packed(turn.gyro), packed(turn.reference), turn.dt,
            packed(turn.rate_before), packed(turn.rate_after), turn.lost,
            _NO_WAY if turn.way is None else packed(turn.way),
            self.variances, self.rock_step, *after, u, seen,
        )  # fmt: skip
        return after, u, seen

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
        shell_correction.expect_flow(
            packed(state.x), packed(way), packed(seen), self._T, self._rock_tilt, expected, H
        )
        return expected, H

    def marker_pose(self, state: State, marker: int) -> tuple[Array, Array, Array]:
        """Returns the pose that a picture of a marker is to tell, and its derivative.

        Args:
            state: at the time of the picture.
            marker: its index in the map.

        Returns:
            (3, 3) and (3,): the pose, in R. (6, n) by the state: a small rotation vector in R, then
            the position.
        """
        R, p, H = np.empty((3, 3)), np.empty(3), np.empty((6, len(state.x)))
        shell_correction.expect_marker(
            packed(state.R), packed(state.x), marker_slice(marker).start, self.arm, self.reach,
            R, p, H,
        )  # fmt: skip
        return R, p, H

    def start(self, state: State, R_told: Array, marker: int, variance: float) -> State:
        """Returns a state whose rotation is that of a marker pose, known only roughly."""
        away = one_rotation(-state.x[marker_slice(marker)])
        R = away.T @ R_told @ one_rotation(state.x[MOUNTING]).T
        P = state.P.copy()
        P[THETA] = P[:, THETA] = P[STEP] = P[:, STEP] = 0.0
        P[THETA, THETA] = variance * np.eye(3)
        return State(nearest_rotation(R), state.x, P)

    def marker_pose_now(
        self, state: State, turn: Turn, R: Array, p: Array, noise: tuple[Array, Array, float]
    ) -> tuple[Array, Array, Array]:
        """Carries a marker pose R (3, 3), p (3,) m by what the body turns in an interval.

        Args:
            state: tells what is wrong with the gyro.
            turn: from the picture of the marker to the state's time.
            R: (3, 3).
            p: (3,) m.
            noise: its covariance (6, 6), what is added to it, and variance along the normal, m^2.

        Returns:
            Rotation, place and covariance at the end of it.
        """
        R_now, p_now, noise_now = np.empty((3, 3)), np.empty(3), np.empty((6, 6))
        covariance, floor, height = noise
        shell_correction.carry_marker_pose(
            packed(state.R), packed(state.x), packed(turn.gyro), packed(turn.reference), turn.dt,
            packed(R), packed(p), packed(covariance), floor, height, R_now, p_now, noise_now,
        )  # fmt: skip
        return R_now, p_now, noise_now

    def update_flow(
        self, state: State, seen: Array, told: Array, noise: Array, gate: float
    ) -> Update:
        """Weighs an increment (3,) rad with covariance (3, 3)."""
        after = _like(state)
        distance = shell_correction.weigh_flow(
            *_parts(state), packed(seen), packed(told), packed(noise), gate,
            self._T, self._rock_tilt, *after,
        )  # fmt: skip
        return _update(state, after, distance, gate, 3)

    def update_marker(
        self, state: State, marker: int, R_told: Array, p_told: Array, noise: Array, gate: float
    ) -> Update:
        """Weighs a marker pose with covariance (6, 6)."""
        after = _like(state)
        distance = shell_correction.weigh_marker(
            *_parts(state), marker_slice(marker).start, self.arm, self.reach,
            packed(R_told), packed(p_told), packed(noise), gate, *after,
        )  # fmt: skip
        return _update(state, after, distance, gate, 6)


def _parts(state: State) -> tuple[Array, Array, Array]:
    return packed(state.R), packed(state.x), packed(state.P)


def _like(state: State) -> State:
    """Returns a state of that size to be written."""
    return State(np.empty((3, 3)), np.empty_like(state.x), np.empty_like(state.P, order="C"))


def _update(before: State, after: State, distance: float, gate: float, unknowns: int) -> Update:
    accepted = 0 <= distance <= gate
    return Update(after if accepted else before, distance / unknowns, accepted)
