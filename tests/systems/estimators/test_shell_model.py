from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from systems.estimators.shell_correction import correct
from systems.estimators.shell_ekf_parameters import ShellEkfParameters
from systems.estimators.shell_model import (
    BIAS,
    DELAY,
    GYRO,
    MOUNTING,
    ROCK,
    SCALE,
    SIZE,
    STEP,
    THETA,
    ShellModel,
    State,
    Turn,
    marker_slice,
)
from systems.flow.projector import FlowProjectorParameters, project_flow
from systems.flow.sphere_flow import SphereFlowEstimator, SphereFlowParameters
from systems.messages import PointMatches
from systems.shell.angles import rotation, rotation_vector
from systems.shell.layout import misplaced
from systems.shell.marker_pose import shell_localizer
from tests.shell_log import VIEW
from tests.systems.shell.shell_world import CAMERA, HEIGHT, MAP, RADIUS, X_BC, detections

DEG = math.radians(1.0)
SMALL = 1e-6
MODEL = ShellModel(view=VIEW, height=HEIGHT, noise=ShellEkfParameters().process_noise())


def exp(w: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(w).as_matrix()


def some_state(seed: int = 0, markers: int = 2) -> State:
    rng = np.random.default_rng(seed)
    x = np.zeros(SIZE + 3 * markers)
    x[BIAS] = rng.normal(0, 0.01, 3)
    x[MOUNTING] = rng.normal(0, 0.01, 3)
    x[SCALE], x[DELAY], x[ROCK] = rng.normal(0, 0.02, 2), 0.01, rng.normal(0, 0.003, 2)
    x[GYRO] = rng.normal(0, 0.01, 9)
    x[SIZE:] = rng.normal(0, 0.01, 3 * markers)
    return State(Rotation.random(random_state=seed).as_matrix(), x, np.eye(len(x)))


def nowhere(state: State) -> State:
    """What a corrected state is written to."""
    return State(*(np.full_like(part, np.nan) for part in state))


def moved(state: State, i: int, by: float) -> State:
    """The state with a small error added."""
    x = state.x.copy()
    x[i] += by
    R = exp(x[THETA]) @ state.R
    x[THETA] = 0.0
    return State(R, x, state.P)


def some_turn(way: bool) -> Turn:
    rng = np.random.default_rng(7)
    gyro, reference = rng.normal(0, 0.01, 3), rng.normal(0, 0.01, 3)
    before, after = rng.normal(0, 0.5, 3), rng.normal(0, 0.5, 3)
    told = rng.normal(0, 0.01, 3) if way else None
    return Turn(gyro, reference, 1 / 60, before, after, 0.0, told)


# --- Jacobians ---


@pytest.mark.parametrize("way", [False, True])
def test_the_transition_is_the_derivative_of_the_prediction(way: bool) -> None:
    state, turn = some_state(1), some_turn(way)
    F, _, _ = MODEL.transition(state, turn)
    ahead, _, seen = MODEL.predict(state, turn)
    for i in [*range(BIAS.start), *range(BIAS.start, STEP.start)]:
        if i == DELAY:  # the interval's ends move
            shifted = turn._replace(gyro=turn.gyro + SMALL * (turn.rate_before - turn.rate_after))
            other, _, other_seen = MODEL.predict(state, shifted)
        else:
            other, _, other_seen = MODEL.predict(moved(state, i, SMALL), turn)
        theta = rotation_vector(other.R @ ahead.R.T) / SMALL
        rest = (other.x - ahead.x)[:SIZE] / SMALL
        tolerance = 3e-4 if i != DELAY else 2e-2  # the delay's own scale errors are left out
        np.testing.assert_allclose(theta, F[THETA, i], atol=tolerance)
        np.testing.assert_allclose(rest[ROCK], F[ROCK, i], atol=1e-7 + (i == DELAY))
        np.testing.assert_allclose((other_seen - seen) / SMALL, F[STEP, i], atol=tolerance)


def test_the_flows_derivative() -> None:
    state = some_state(2)
    way, seen = np.array([0.002, 0.007, -0.003]), np.array([0.0021, 0.0069, -0.0032])
    told, H = MODEL.flow(state, way, seen)
    for i in range(BIAS.start, STEP.start):
        other, _ = MODEL.flow(moved(state, i, SMALL), way, seen)
        np.testing.assert_allclose((other - told) / SMALL, H[:, i], atol=1e-8)
    # What the body does beyond what was thought, it does with all the flow's errors.
    other, _ = MODEL.flow(state, way + SMALL * np.eye(3)[0], seen + SMALL * np.eye(3)[0])
    np.testing.assert_allclose((other - told) / SMALL, H[:, STEP.start], atol=1e-6)


@pytest.mark.parametrize("marker", [0, 1])
def test_the_marker_poses_derivative(marker: int) -> None:
    state = some_state(3)
    R, p, H = MODEL.marker_pose(state, marker)
    for i in range(len(state.x)):
        other_R, other_p, _ = MODEL.marker_pose(moved(state, i, SMALL), marker)
        # First order in the errors themselves, of which the largest is 0.02 rad.
        np.testing.assert_allclose(
            rotation_vector(other_R @ R.T) / SMALL, H[:3, i], atol=0.02, err_msg=str(i)
        )
        np.testing.assert_allclose((other_p - p) / SMALL, H[3:, i], atol=0.02 * RADIUS)


# --- The model against the world ---


def pictures(
    m: np.ndarray, rocks: list[np.ndarray], u: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What the flow tells of a step, and the true step of the body."""
    mounting = RigidTransform(RotationMatrix(exp(m) @ X_BC.rotation().matrix()), X_BC.translation())
    R_RN = [rotation(np.array([0.3, 0.4, 0.5]))]
    R_RN.append(R_RN[0] @ exp(u))
    X_RB = [
        RigidTransform(RotationMatrix(R @ exp(np.r_[r, 0])), (RADIUS + HEIGHT) * R[:, 2])
        for R, r in zip(R_RN, rocks, strict=True)
    ]
    matches = project_flow(
        camera=CAMERA, radius=RADIUS, X_RC_before=X_RB[0] @ mounting, X_RC=X_RB[1] @ mounting,
        parameters=FlowProjectorParameters(points=2000, pixel_noise=0.0, point_dropout=0.0),
        random=np.random.default_rng(0),
    )  # fmt: skip
    flow = SphereFlowEstimator(view=VIEW, parameters=SphereFlowParameters())
    told = flow.fit(PointMatches(1.0, 0.98, "", *matches)).increment.rotation
    R = [X.rotation().matrix() for X in X_RB]
    return told, rotation_vector(R[0].T @ R[1])


@pytest.mark.parametrize(
    ("m", "before", "after", "u"),
    [
        ([0.5, 0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.4, 0.0]),
        ([0.0, 0.0, 0.5], [0.0, 0.0], [0.0, 0.0], [0.0, 0.4, 0.0]),
        ([0.0, 0.0, 0.0], [0.3, 0.0], [0.3, 0.0], [0.0, 0.4, 0.0]),
        ([0.0, 0.0, 0.0], [0.3, -0.1], [0.25, -0.06], [0.0, 0.0, 0.0]),
        ([0.5, -0.4, 0.3], [0.2, -0.1], [0.21, -0.12], [0.0, 0.4, 0.1]),
    ],
)
def test_turned_and_rocking_cameras_tell_what_the_model_says(
    m: list[float], before: list[float], after: list[float], u: list[float]
) -> None:
    rocks = [np.array(before) * DEG, np.array(after) * DEG]
    told, step = pictures(np.array(m) * DEG, rocks, np.array(u) * DEG)
    state = some_state()
    x = np.zeros_like(state.x)
    x[MOUNTING], x[ROCK] = np.array(m) * DEG, (rocks[0] + rocks[1]) / 2
    seen = step + MODEL.rock_step @ (rocks[1] - rocks[0])
    expected, _ = MODEL.flow(state._replace(x=x), told, seen)
    np.testing.assert_allclose(told, expected, atol=0.0015 * DEG)
    assert np.abs(told - step).max() > 0.002 * DEG  # the step alone would not do
    if np.any(m):
        wrong, _ = MODEL.flow(state._replace(x=np.where(x == x, -x, x)), told, seen)
        assert np.abs(told - wrong).max() > 2 * np.abs(told - expected).max()


def test_a_turned_camera_and_a_misplaced_marker_show_as_the_model_says() -> None:
    m, r = np.array([0.012, -0.009, 0.015]), np.array([0.004, -0.003])
    mounting = RigidTransform(RotationMatrix(exp(m) @ X_BC.rotation().matrix()), X_BC.translation())
    for index, marker in enumerate(MAP):
        if marker.id not in (1, 4, 9, 20):
            continue
        normal = marker.X_WM.rotation().matrix()[:, 0]
        R_RN = rotation(
            np.array([0.4, math.asin(min(normal[2], 1.0)), math.atan2(normal[1], normal[0])])
        )
        X_RB = RigidTransform(
            RotationMatrix(R_RN @ exp(np.r_[r, 0])), (RADIUS + HEIGHT) * R_RN[:, 2]
        )
        placed = misplaced(MAP, bound=0.01, seed=3)
        picture = detections(X_RB, markers=placed, mounting=mounting)
        localizer = shell_localizer(marker_map=MAP, camera=CAMERA, X_BC=X_BC)
        told = localizer.locate(picture.select(picture.ids == marker.id)).pose
        R_new, R_old = (
            X.rotation().matrix() for X in (placed.markers[marker.id].X_WM, marker.X_WM)
        )
        x = np.zeros(SIZE + 3 * len(list(MAP)))
        x[MOUNTING], x[ROCK] = m, r
        x[marker_slice(index)] = rotation_vector(R_new @ R_old.T)
        R, p, _ = MODEL.marker_pose(State(X_RB.rotation().matrix(), x, np.eye(len(x))), index)
        np.testing.assert_allclose(
            rotation_vector(told.pose.rotation().matrix() @ R.T), 0.0, atol=1e-5
        )
        np.testing.assert_allclose(told.pose.translation(), p, atol=2e-6)


# --- Prediction and correction ---


def test_the_gyros_covariance_is_that_of_sampled_noise() -> None:
    rng = np.random.default_rng(3)
    state, turn = some_state(4), some_turn(way=False)
    P = np.zeros_like(state.P)
    ahead, _, _ = MODEL.predict(state._replace(P=P), turn)
    sigma = math.sqrt(MODEL.noise.gyro * turn.dt)
    errors = []
    for _ in range(4000):
        noisy = turn._replace(gyro=turn.gyro + rng.normal(0, sigma, 3))
        errors.append(rotation_vector(MODEL.predict(state, noisy)[0].R @ ahead.R.T))
    np.testing.assert_allclose(
        np.cov(np.array(errors).T) / sigma**2, ahead.P[:3, :3] / sigma**2, atol=0.1
    )


def test_a_correction_is_that_of_the_joseph_form() -> None:
    rng = np.random.default_rng(5)
    state = some_state(5)
    root = rng.normal(0, 0.01, (len(state.x), len(state.x)))
    state = state._replace(P=root @ root.T)
    H, y, noise = rng.normal(0, 1, (3, SIZE)), rng.normal(0, 0.01, 3), np.diag([1e-4, 2e-4, 3e-4])
    R, x, P = after = nowhere(state)
    distance = correct(*state, H, y, noise, math.inf, *after)
    full = np.hstack([H, np.zeros((3, len(state.x) - SIZE))])
    S = full @ state.P @ full.T + noise
    K = state.P @ full.T @ np.linalg.inv(S)
    A = np.eye(len(state.x)) - K @ full
    np.testing.assert_allclose(P, A @ state.P @ A.T + K @ noise @ K.T, atol=1e-12)
    np.testing.assert_allclose(R, exp((K @ y)[THETA]) @ state.R, atol=1e-9)
    np.testing.assert_allclose(x[BIAS], (state.x + K @ y)[BIAS], atol=1e-12)
    assert distance == pytest.approx(y @ np.linalg.solve(S, y))
    refused = nowhere(state)
    assert correct(*state, H, y, noise, 0.5 * distance, *refused) == distance
    assert all(np.isnan(part).all() for part in refused)


def test_an_innovation_whose_covariance_is_not_positive_is_refused() -> None:
    state = some_state(6)
    state = state._replace(P=1e-6 * np.eye(len(state.x)))
    H, y, noise = np.eye(3, SIZE), np.full(3, 1e-3), np.diag([1e-4, -1e-3, 1e-4])
    refused = nowhere(state)
    assert math.isnan(correct(*state, H, y, noise, math.inf, *refused))
    assert all(np.isnan(part).all() for part in refused)


def test_an_increment_that_is_not_believed_changes_nothing() -> None:
    state = some_state(6)
    state = state._replace(P=1e-6 * np.eye(len(state.x)))
    told = np.full(3, 1e-3)
    refused = MODEL.update_flow(state, np.zeros(3), told, 1e-6 * np.eye(3), 1e-6)
    assert refused.nis > 0
    assert not refused.accepted
    assert refused.state is state
    refused = MODEL.update_flow(state, np.zeros(3), told, -1e-3 * np.eye(3), math.inf)
    assert not refused.accepted
    assert refused.state is state


# --- The trail ---
