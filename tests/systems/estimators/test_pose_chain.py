from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource
from scipy.spatial.transform import Rotation

from systems.estimators.pose_chain import PoseChain, compose
from systems.shell.angles import rotation_error
from tests.shell_log import DEG, Result, ShellLog, drive, ekf, listen

X_AB = RigidTransform(RollPitchYaw(0.4, -0.7, 2.0), [0.3, -0.1, 0.2])
X_BC = RigidTransform(RollPitchYaw(-1.1, 0.2, 0.5), [-0.2, 0.25, 0.4])
X_CD = RigidTransform(RollPitchYaw(2.5, 0.9, -0.3), [0.1, 0.0, -0.3])


def some_covariance(seed: int, degrees: float = 0.5, metres: float = 1e-3) -> np.ndarray:
    """Full, rotation and position correlated."""
    A = np.random.default_rng(seed).normal(size=(6, 6)) * np.repeat(
        [math.radians(degrees), metres], 3
    )
    return A.T @ A / 6


def moved(X: RigidTransform, error: np.ndarray) -> RigidTransform:
    """exp([phi]x) R and p + d; by SciPy, as our own exponential is behind `compose`."""
    R = Rotation.from_rotvec(error[:3]).as_matrix() @ X.rotation().matrix()
    return RigidTransform(RotationMatrix(R), X.translation() + error[3:])


def apart(X: RigidTransform, Y: RigidTransform) -> np.ndarray:
    R = X.rotation().matrix() @ Y.rotation().matrix().T
    return np.concatenate([Rotation.from_matrix(R).as_rotvec(), X.translation() - Y.translation()])


# --- Composition ---


def test_a_turn_below_moves_what_is_above() -> None:
    # By hand: B stands upside down at the top of A, C 2 m above B's origin in B, so below it. A
    # small turn a of B about A's x carries C by a times 2 m along y; one of C moves nothing.
    X_AB = RigidTransform(RollPitchYaw(math.pi, 0, 0), [0.0, 0.0, 1.0])
    X_BC = RigidTransform([0.0, 0.0, 2.0])
    P_AB = np.diag([0.01**2, 0, 0, 0, 0, 0])
    P_BC = np.diag([0, 0.02**2, 0, 0, 0, 0.003**2])
    X_AC, P_AC = compose(X_AB, P_AB, X_BC, P_BC)
    np.testing.assert_allclose(X_AC.translation(), [0, 0, -1.0], atol=1e-12)
    deviations = np.sqrt(np.diag(P_AC))
    np.testing.assert_allclose(deviations, [0.01, 0.02, 0, 0, 0.02, 0.003], atol=1e-9)
    # The turn by +a about x carries a point 2 m below along +y: they go together.
    assert P_AC[0, 4] == pytest.approx(0.01 * 0.02)


def test_derivatives_against_differences() -> None:
    # The covariance's derivatives one by one, from moved poses: no formula of ours.
    h = 1e-6
    nominal = X_AB @ X_BC
    J_1 = np.column_stack([apart(moved(X_AB, h * e) @ X_BC, nominal) / h for e in np.eye(6)])
    J_2 = np.column_stack([apart(X_AB @ moved(X_BC, h * e), nominal) / h for e in np.eye(6)])
    P_1, P_2 = some_covariance(1), some_covariance(2)
    _, P = compose(X_AB, P_1, X_BC, P_2)
    expected = J_1 @ P_1 @ J_1.T + J_2 @ P_2 @ J_2.T
    np.testing.assert_allclose(P, expected, rtol=1e-4, atol=1e-5 * expected.max())


@pytest.mark.parametrize(("degrees", "tolerance"), [(0.5, 0.03), (5.0, 0.06)])
def test_spread_of_many_draws(degrees: float, tolerance: float) -> None:
    # At 5 degrees what is left out, of second order, begins to show.
    draws = 20_000
    P_1, P_2 = some_covariance(1, degrees), some_covariance(2, degrees)
    rng = np.random.default_rng(3)
    first = rng.multivariate_normal(np.zeros(6), P_1, draws)
    second = rng.multivariate_normal(np.zeros(6), P_2, draws)
    estimate, P = compose(X_AB, P_1, X_BC, P_2)
    R_1 = Rotation.from_rotvec(first[:, :3]).as_matrix() @ X_AB.rotation().matrix()
    R_2 = Rotation.from_rotvec(second[:, :3]).as_matrix() @ X_BC.rotation().matrix()
    p_2 = X_BC.translation() + second[:, 3:]
    phi = Rotation.from_matrix(R_1 @ R_2 @ estimate.rotation().matrix().T).as_rotvec()
    p = X_AB.translation() + first[:, 3:] + (R_1 @ p_2[:, :, None])[:, :, 0]
    errors = np.hstack([phi, p - estimate.translation()])
    spread = errors.T @ errors / draws
    scale = np.sqrt(np.outer(np.diag(P), np.diag(P)))
    assert np.abs((spread - P) / scale).max() < tolerance


def test_three_links_compose_in_any_order() -> None:
    P = [some_covariance(k) for k in range(3)]
    X_left, P_left = compose(*compose(X_AB, P[0], X_BC, P[1]), X_CD, P[2])
    X_right, P_right = compose(X_AB, P[0], *compose(X_BC, P[1], X_CD, P[2]))
    assert X_left.IsNearlyEqualTo(X_right, 1e-12)
    np.testing.assert_allclose(P_left, P_right, rtol=1e-9, atol=1e-15)
    assert np.linalg.eigvalsh(P_left).min() > 0


def test_it_knows_no_axes() -> None:
    # Told in other axes of A, the covariance is turned; in other axes of B, nothing changes.
    P_1, P_2 = some_covariance(1), some_covariance(2)
    _, P = compose(X_AB, P_1, X_BC, P_2)
    Q = RotationMatrix(RollPitchYaw(0.3, 1.0, -2.0))
    turn = np.kron(np.eye(2), Q.matrix())
    X_Q = RigidTransform(Q, np.zeros(3))
    _, P_A = compose(X_Q @ X_AB, turn @ P_1 @ turn.T, X_BC, P_2)
    np.testing.assert_allclose(P_A, turn @ P @ turn.T, rtol=1e-9, atol=1e-15)
    _, P_B = compose(X_AB @ X_Q.inverse(), P_1, X_Q @ X_BC, turn @ P_2 @ turn.T)
    np.testing.assert_allclose(P_B, P, rtol=1e-9, atol=1e-15)


# --- Block ---


def test_a_third_robot_on_the_shell_of_the_second() -> None:
    mount = RigidTransform([0.0, 0.0, 0.12])
    P_1, P_2 = some_covariance(1), some_covariance(2)
    block = PoseChain(mounts=[mount], child_frame_id="three/base_link")
    builder = DiagramBuilder()
    builder.AddSystem(block)
    for k, (X, P) in enumerate([(X_AB, P_1), (X_CD, P_2)], start=1):
        pose = builder.AddSystem(ConstantValueSource(AbstractValue.Make(X)))
        covariance = builder.AddSystem(ConstantVectorSource(P.ravel()))
        builder.Connect(pose.get_output_port(), block.pose_input_port(k))
        builder.Connect(covariance.get_output_port(), block.covariance_input_port(k))
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.1)
    context = block.GetMyContextFromRoot(simulator.get_context())
    expected, P = compose(X_AB, P_1, mount @ X_CD, _in_carrier(mount, P_2))
    estimate = block.estimate_output_port().Eval(context)
    for pose in (block.pose_output_port().Eval(context), estimate.pose):
        assert pose.IsNearlyEqualTo(expected, 1e-12)
    covariance = block.covariance_output_port().Eval(context).reshape(6, 6)
    np.testing.assert_allclose(covariance, P, rtol=1e-9, atol=1e-15)
    np.testing.assert_array_equal(estimate.covariance, covariance)
    assert (estimate.stamp, estimate.frame_id) == (0.1, "shell")
    assert estimate.child_frame_id == "three/base_link"


def _in_carrier(X_BR: RigidTransform, P: np.ndarray) -> np.ndarray:
    turned = np.kron(np.eye(2), X_BR.rotation().matrix())
    return turned @ P @ turned.T


def test_one_robot_is_passed_on() -> None:
    block = PoseChain(mounts=[])
    context = block.CreateDefaultContext()
    P = some_covariance(4)
    block.pose_input_port(1).FixValue(context, X_AB)
    block.covariance_input_port(1).FixValue(context, P.ravel())
    assert block.pose_output_port().Eval(context).IsExactlyEqualTo(X_AB)
    np.testing.assert_array_equal(block.covariance_output_port().Eval(context), P.ravel())
    assert block.num_input_ports() == 2


def test_an_estimate_that_was_sent_stays_as_it_was() -> None:
    block = PoseChain(mounts=[])
    context = block.CreateDefaultContext()
    block.covariance_input_port(1).FixValue(context, np.eye(6).ravel())
    pose = block.pose_input_port(1).FixValue(context, X_AB)
    sent = block.estimate_output_port().Eval(context)
    pose.GetMutableData().set_value(X_BC)
    assert sent.pose.IsExactlyEqualTo(X_AB)
    assert block.estimate_output_port().Eval(context).pose.IsExactlyEqualTo(X_BC)


def test_what_is_not_finite_shows() -> None:
    block = PoseChain(mounts=[RigidTransform()])
    context = block.CreateDefaultContext()
    for k in (1, 2):
        block.pose_input_port(k).FixValue(context, X_AB)
        block.covariance_input_port(k).FixValue(context, some_covariance(k).ravel())
    block.covariance_input_port(2).FixValue(context, np.full(36, np.nan))
    assert not np.isfinite(block.covariance_output_port().Eval(context)).any()
    assert np.isfinite(block.pose_output_port().Eval(context).GetAsMatrix34()).all()


def test_a_shell_on_a_chassis_whose_upper_body_rocks() -> None:
    # What is estimated is the upper body; drawn tilts of it, about its own origin, spread the pose.
    sigma, mount = math.radians(0.5), RigidTransform(RollPitchYaw(0, 0, 0.8), [0.02, 0.0, 0.1])
    block = PoseChain(mounts=[mount], rock=sigma)
    context = block.CreateDefaultContext()
    for k, X in ((1, X_AB), (2, X_CD)):
        block.pose_input_port(k).FixValue(context, X)
        block.covariance_input_port(k).FixValue(context, np.zeros(36))
    P = block.covariance_output_port().Eval(context).reshape(6, 6)
    nominal = block.pose_output_port().Eval(context)
    tilts = np.random.default_rng(5).normal(size=(4000, 2)) * sigma
    errors = []
    for tilt in tilts:  # of the upper body against the chassis: X_AChassis = X_AB tilted back
        R = Rotation.from_rotvec([*-tilt, 0.0]).as_matrix()
        chassis = X_AB @ RigidTransform(RotationMatrix(R), np.zeros(3))
        errors.append(apart(chassis @ mount @ X_CD, nominal))
    spread = np.cov(np.array(errors).T)
    assert np.abs(spread - P).max() < 0.06 * np.diag(P).max()
    assert np.linalg.matrix_rank(P, tol=1e-9 * P.max()) == 2


def test_a_negative_rock_is_refused() -> None:
    with pytest.raises(ValueError, match=r"rock is -0.1: must be 0 or greater"):
        PoseChain(mounts=[], rock=-0.1)


def test_a_mount_that_is_no_pose_is_refused() -> None:
    with pytest.raises(ValueError, match=r"mounts is .*nan.*: must be finite"):
        PoseChain(mounts=[RigidTransform([0.0, math.nan, 0.0])])


# --- With the filters ---


def links(log: ShellLog, result: Result) -> list[tuple[RigidTransform, RigidTransform, np.ndarray]]:
    """Of each moment the true pose, the filter's, and its covariance."""
    found = []
    for k, error, p_error, P in zip(
        result.samples, result.errors, result.p_errors, result.P, strict=True
    ):
        half = Rotation.from_matrix(log.R[k].T @ log.R[k + 1]).as_rotvec() / 2
        R = log.R[k] @ Rotation.from_rotvec(half).as_matrix()
        true = RigidTransform(RotationMatrix(R), (log.p[k] + log.p[k + 1]) / 2)
        found.append((true, moved(true, np.concatenate([error, p_error])), P))
    return found


def test_a_chain_of_two_filters_knows_its_error() -> None:
    # Two robots drive the routine with errors of their own, the second on the shell of the first.
    mount = RigidTransform([0.0, 0.0, 0.105])
    logs = [drive(seed) for seed in (0, 1)]
    start = max(log.second for log in logs)
    both = [links(log, listen(log, ekf(), 15).after(start)) for log in logs]
    rotations, positions, blind = [], [], []
    for (X_1, E_1, P_1), (X_2, E_2, P_2) in zip(*both, strict=False):
        estimate, P = compose(E_1, P_1, mount @ E_2, P_2)
        true = X_1 @ mount @ X_2
        phi = rotation_error(true.rotation().matrix(), estimate.rotation().matrix())
        d = true.translation() - estimate.translation()
        rotations.append(phi @ np.linalg.solve(P[:3, :3], phi) / 3)
        positions.append(d @ np.linalg.solve(P[3:, 3:], d) / 3)
        R = E_1.rotation().matrix()
        without = P_1[3:, 3:] + R @ P_2[3:, 3:] @ R.T  # as if a turn below moved nothing
        blind.append(d @ np.linalg.solve(without, d) / 3)
        assert np.linalg.norm(phi) < 2 * DEG
        assert np.linalg.norm(d) < 0.01
    assert 0.2 < np.mean(rotations) < 2.0
    assert 0.2 < np.mean(positions) < 2.0
    assert np.mean(blind) > 2 * np.mean(positions)
