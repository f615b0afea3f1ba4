from __future__ import annotations

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource

from plants.shell import ShellMotion, ShellMotionParameters
from systems.estimators.reference_motion import CarriedShellMotion, KnownShellMotion
from systems.messages import PoseEstimate, RotationIncrement
from systems.shell.angles import rotation, rotation_error
from tests.shell_log import ekf

R_BR = RotationMatrix(RollPitchYaw(0.4, -0.7, 2.0))


def told(block: CarriedShellMotion, gyro: list[float], bias: list[float] | None) -> np.ndarray:
    context = block.CreateDefaultContext()
    block.imu_input_port().FixValue(context, [*gyro, 1.0, 2.0, 9.0])
    if bias is not None:
        block.calibration_input_port().FixValue(context, [*bias, *range(15)])
    return np.asarray(block.reference_velocity_output_port().Eval(context))


def test_the_gyro_less_its_bias_in_the_axes_of_the_shell() -> None:
    # The shell is turned by a quarter about z: its x is the carrier's y.
    block = CarriedShellMotion(R_BR=RotationMatrix.MakeZRotation(np.pi / 2))
    found = told(block, [0.1, 0.2, 0.3], [0.01, 0.02, -0.03])
    np.testing.assert_allclose(found, [0.18, -0.09, 0.33, 0, 0, 0], atol=1e-12)


def test_without_calibration_or_turn_it_is_the_gyro() -> None:
    found = told(CarriedShellMotion(), [0.1, 0.2, 0.3], None)
    np.testing.assert_array_equal(found, [0.1, 0.2, 0.3, 0, 0, 0])


def test_a_silent_gyro_is_not_made_into_a_rate() -> None:
    assert np.isnan(told(CarriedShellMotion(), [np.nan, 0.0, 0.0], [0.0] * 3)[:3]).any()


@pytest.fixture
def motion() -> tuple[ShellMotion, KnownShellMotion, DiagramBuilder]:
    parameters = ShellMotionParameters(
        translation=[0.1, -0.05, 0.03], translation_period=4.0,
        rotation=[1.5, 0.4, -0.6], rotation_period=6.0,
    )  # fmt: skip
    builder = DiagramBuilder()
    driver = builder.AddSystem(
        ShellMotion(parameters=parameters, X_WS=RigidTransform(R_BR, [0.5, 0.0, 1.0]))
    )
    block = builder.AddSystem(KnownShellMotion())
    builder.Connect(driver.pose_output_port(), block.pose_input_port())
    builder.Connect(driver.spatial_velocity_output_port(), block.spatial_velocity_input_port())
    return driver, block, builder


def test_the_known_motion_is_what_a_gyro_in_the_shell_would_feel(
    motion: tuple[ShellMotion, KnownShellMotion, DiagramBuilder],
) -> None:
    driver, block, builder = motion
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()

    def pose(t: float) -> RigidTransform:
        context.SetTime(t)
        # A copy: what Eval gives is the cache's own.
        return RigidTransform(driver.pose_output_port().Eval(driver.GetMyContextFromRoot(context)))

    h = 1e-5
    for t in (0.7, 2.2, 5.1):
        before, after = pose(t - h), pose(t + h)
        # Body-frame increments: R_before' R_after = exp([w]x 2 h), and the same for the place.
        R = before.rotation().matrix()
        w = rotation_error(R.T @ after.rotation().matrix(), np.eye(3)) / (2 * h)
        v = (after.translation() - before.translation()) / (2 * h)
        now = pose(t)
        found = block.reference_velocity_output_port().Eval(block.GetMyContextFromRoot(context))
        assert np.linalg.norm(w) > 0.1
        np.testing.assert_allclose(found[:3], w, atol=1e-4)
        np.testing.assert_allclose(found[3:], now.rotation().matrix().T @ v, atol=1e-6)


@pytest.mark.parametrize("told", [True, False])
def test_a_filter_on_a_carried_shell_stays_where_its_robot_does(told: bool) -> None:
    # The carrier turns at 6 deg/s; on its shell the other robot stands, and its gyro turns along.
    # It knows where it is at the start, and sees nothing.
    w_B1, bias = np.array([0.03, -0.08, 0.06]), np.array([0.004, -0.002, 0.005])
    angles = [0.5, 0.9, -1.2]
    R_RB = rotation(np.array(angles))
    w_R = R_BR.matrix().T @ w_B1
    own = R_RB.T @ w_R
    builder = DiagramBuilder()
    block = builder.AddSystem(CarriedShellMotion(R_BR=R_BR))
    estimator = builder.AddSystem(
        ekf(initial_angles=angles, initial_deviation=1e-3, imu_silence=100.0)
    )
    for port, value in (
        (block.imu_input_port(), [*(w_B1 + bias), 0.0, 0.0, 9.81]),
        (block.calibration_input_port(), [*bias, *np.zeros(15)]),
        (estimator.imu_input_port(), [*own, 0.0, 0.0, 9.81]),
    ):
        source = builder.AddSystem(ConstantVectorSource(np.array(value)))
        builder.Connect(source.get_output_port(), port)
    for port, message in (
        (estimator.marker_pose_input_port(), PoseEstimate()),
        (estimator.increment_input_port(), RotationIncrement()),
    ):
        constant = builder.AddSystem(ConstantValueSource(AbstractValue.Make(message)))
        builder.Connect(constant.get_output_port(), port)
    if told:
        builder.Connect(
            block.reference_velocity_output_port(), estimator.reference_velocity_input_port()
        )
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(3.0)
    X = estimator.pose_output_port().Eval(estimator.GetMyContextFromRoot(simulator.get_context()))
    moved = rotation_error(X.rotation().matrix(), R_RB)
    if told:
        assert np.linalg.norm(moved) < 2e-4
    else:
        np.testing.assert_allclose(moved, 3.0 * w_R, atol=5e-3)
