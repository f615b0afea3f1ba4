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

from systems.flow.shell import ShellView, back_project
from systems.markers.pnp import cross_matrix
from systems.shell.angles import nearest_rotation, one_rotation, rotation_vector

Array = NDArray[np.float64]

THETA, BIAS, MOUNTING = slice(0, 3), slice(3, 6), slice(6, 9)
SCALE, DELAY, ROCK = slice(9, 11), 11, slice(12, 14)
GYRO, STEP = slice(14, 23), slice(23, 26)
SIZE = 26  # without markers

_GRID = (16, 12)  # pixels by which the camera's tilt is weighed
_SMALL = 1e-5  # rad, step of a difference quotient
_IDENTITY = np.eye(3)
_IN_PLANE = _IDENTITY[:, :2]
_Z = np.array([0.0, 0.0, 1.0])
_BY_ROCK = cross_matrix(_Z)[:, :2]  # of the normal, in B
_ROWS = np.arange(3)[:, None]
_BY_SCALE = np.arange(SIZE)[GYRO].reshape(3, 3)  # the columns of each row's scales


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
        self._T, by_turn = tilt_sensitivity(view)
        # Rocking about the body's origin carries the camera over the shell, by this part of the
        # angle, and turns it by the rest.
        carried = self.arm / (self.reach + self.arm)
        self._rock_tilt = (1 - carried) * _IN_PLANE
        self._rock_step = (1 - carried) * (by_turn - np.eye(3)) @ _IN_PLANE
        self._T_of_way = np.ascontiguousarray(self._T.transpose(0, 2, 1))
        # What stays the same of the derivatives by noise.
        self._G = np.zeros((SIZE, 8))
        self._G[STEP, :3] = np.eye(3)
        self._G[STEP, 3:5] = self._rock_step
        self._G[ROCK, 3:5] = np.eye(2)
        self._G[BIAS, 5:] = np.eye(3)

    def turned(self, state: State, turn: Turn) -> Array:
        """Returns the body's rotation over the shell during an interval, (3,) rad, in B."""
        measured, relative, factor = self._parts(state, turn)
        u: Array = measured + state.x[GYRO].reshape(3, 3) @ factor - relative
        return u

    def _parts(self, state: State, turn: Turn) -> tuple[Array, Array, Array]:
        """Returns what the gyro tells, what of it is the reference's, and what scales multiply."""
        measured = turn.gyro - turn.dt * state.x[BIAS]
        relative = np.zeros(3)
        if turn.reference.any():
            # Of the middle of the interval: seen from the body, the reference's axis turns
            # meanwhile.
            in_B = state.R.T @ turn.reference
            relative = one_rotation((measured - in_B) / 2).T @ in_B
        return measured, relative, measured if turn.way is None else turn.way + relative

    def step(self, state: State, turn: Turn) -> tuple[Array, Array]:
        """Returns the body's rotation over the shell during an interval, and its derivative.

        Returns:
            (3,) rad, in B, and (3, SIZE) by the state.
        """
        measured, relative, factor = self._parts(state, turn)
        D = state.x[GYRO].reshape(3, 3)
        J = np.zeros((3, SIZE))
        if turn.reference.any():
            by_theta = state.R.T @ cross_matrix(turn.reference)
            J[:, THETA] = -by_theta if turn.way is None else D @ by_theta - by_theta
        J[:, BIAS] = -turn.dt * (_IDENTITY + D if turn.way is None else _IDENTITY)
        J[_ROWS, _BY_SCALE] = factor
        J[:, DELAY] = turn.rate_before - turn.rate_after
        return measured + D @ factor - relative, J

    def transition(self, state: State, turn: Turn) -> tuple[Array, Array, Array]:
        """Returns the derivatives of one step.

        Returns:
            F: (SIZE, SIZE) by the state. G: (SIZE, 8) by noise of the step (3), of the rock (2) and
            of the bias (3). The step: (3,) rad.
        """
        u, J = self.step(state, turn)
        middle = state.R @ one_rotation(u / 2)
        fades = math.exp(-turn.dt / self.noise.rock_time)
        F = np.eye(SIZE)
        F[THETA] += middle @ J
        F[ROCK, ROCK] *= fades
        F[STEP] = J
        F[STEP, ROCK] += (fades - 1) * self._rock_step
        G = self._G.copy()
        G[THETA, :3] = middle
        return F, G, u

    def carried(self, state: State, turn: Turn, u: Array) -> tuple[State, Array]:
        """Returns the state after a step u (3,) rad, and by what the rock has faded (2,) rad.

        Its covariance is left as it was.
        """
        change = math.expm1(-turn.dt / self.noise.rock_time) * state.x[ROCK]
        x = state.x.copy()
        x[ROCK] += change
        return State(nearest_rotation(state.R @ one_rotation(u)), x, state.P), change

    def predict(self, state: State, turn: Turn) -> tuple[State, Array, Array]:
        """Carries the state to the end of an interval by the gyro.

        Returns:
            The state, the step (3,) that the body has made, and what the flow is to see of it but
            for its own errors (3,), rad: less the change of the rock.
        """
        noise, n = self.noise, SIZE
        F, G, u = self.transition(state, turn)
        step = noise.gyro * turn.dt + noise.lost * turn.lost
        rock = -noise.rock * math.expm1(-2 * turn.dt / noise.rock_time)
        bias = noise.bias * turn.dt
        Q = np.array([step, step, step, rock, rock, bias, bias, bias])
        # The markers stay where they are, however uncertain.
        above = F @ state.P[:n]
        own = above[:, :n] @ F.T + G * Q @ G.T
        P = state.P.copy()
        P[:n, :n] = (own + own.T) / 2
        P[:n, n:] = above[:, n:]
        P[n:, :n] = above[:, n:].T
        after, change = self.carried(state, turn, u)
        return after._replace(P=P), u, u + self._rock_step @ change

    def flow(self, state: State, way: Array, seen: Array) -> tuple[Array, Array]:
        """Returns the increment that the flow is to tell, and its derivative.

        Args:
            state: at the end of the interval.
            way: (3,) rad, what multiplies the flow's errors: the increment itself (see `Turn`).
            seen: (3,) by `predict`.

        Returns:
            (3,) rad, in B, and (3, SIZE) by the state.
        """
        x = state.x
        along, about = x[SCALE].tolist()
        scale = np.array([along, along, about])
        turned = self._T_of_way @ way  # (3, 3): what a tilt does
        tilt = self._rock_tilt @ x[ROCK]
        by_tilt = turned - cross_matrix(way)
        H = np.zeros((3, SIZE))
        H[:, STEP] = (
            np.eye(3) + np.diag(scale) + self._T @ (x[MOUNTING] + tilt) + cross_matrix(tilt)
        )
        H[:, MOUNTING] = turned
        H[:, ROCK] = by_tilt @ self._rock_tilt
        H[:2, 9], H[2, 10] = way[:2], way[2]
        return seen + scale * way + turned @ x[MOUNTING] + by_tilt @ tilt, H

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
        normal = _Z + _BY_ROCK @ state.x[ROCK]
        p: Array = self.reach / math.sqrt(normal @ normal) * (state.R @ normal)
        return p

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
    PH = state.P[:, : H.shape[1]] @ H.T
    S = H @ PH[: H.shape[1]] + noise
    S = (S + S.T) / 2
    solved = np.linalg.solve(S, np.concatenate([y[:, None], PH.T], axis=1))
    distance = float(y @ solved[:, 0])
    nis = distance / len(y)
    if not 0 <= distance <= gate:
        return Update(state, nis, False)
    K = solved[:, 1:].T
    # (I - K H) P (I - K H)' + K noise K', multiplied out: only rank m is changed.
    P = state.P - K @ PH.T
    x = state.x + K @ y
    R = nearest_rotation(one_rotation(x[THETA]) @ state.R)
    x[THETA] = x[STEP] = 0.0
    return Update(State(R, x, (P + P.T) / 2), nis, True)
