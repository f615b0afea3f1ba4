from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from systems.angles import wrap
from systems.estimators.gyro_yaw import AT_REST, GyroYaw, offsets
from systems.sensors.imu import Imu
from systems.sensors.imu_parameters import GRAVITY, Mpu6050Parameters

RATE = 50.0


class Samples(LeafSystem):
    """Sends row k from k / RATE on; before, at 0, zeros, as a sensor does."""

    def __init__(self, rows: np.ndarray) -> None:
        super().__init__()
        state = self.DeclareDiscreteState(6)
        self.DeclarePeriodicDiscreteUpdateEvent(
            1 / RATE,
            0.0,
            lambda context, values: values.set_value(
                state, rows[min(round(context.get_time() * RATE), len(rows) - 1)]
            ),
        )
        self.DeclareStateOutputPort("sample", state)


class Rig:
    def __init__(self, rows: np.ndarray, num_samples: int) -> None:
        builder = DiagramBuilder()
        source = builder.AddSystem(Samples(rows))
        self.block = builder.AddSystem(GyroYaw(rate=RATE, num_samples=num_samples))
        builder.Connect(source.get_output_port(), self.block.imu_input_port())
        self.simulator = Simulator(builder.Build())
        self.context = self.block.GetMyContextFromRoot(self.simulator.get_context())

    def after(self, number: int) -> tuple[float, np.ndarray]:
        """Yaw and corrected sample when sample `number` has been looked at, and one more sent."""
        self.simulator.AdvanceTo((number + 1.5) / RATE)
        yaw = self.block.yaw_output_port().Eval(self.context)[0]
        return yaw, self.block.sample_output_port().Eval(self.context).copy()

    @property
    def bad(self) -> int:
        return self.block.health_output_port().Eval(self.context).counts["bad_imu"]


def resting(number: int, offset: np.ndarray) -> np.ndarray:
    return np.tile(AT_REST + offset, (number, 1))


def test_a_constant_offset_is_taken_off() -> None:
    offset = np.array([0.1, -0.2, 0.3, 0.5, -0.5, 0.4])
    rows = resting(60, offset)
    rows[20:, 2] += 1.5  # after the rest it turns at 1.5 rad/s
    rig = Rig(rows, num_samples=20)
    yaw, sample = rig.after(9)
    assert yaw == 0
    np.testing.assert_array_equal(sample, AT_REST)
    yaw, sample = rig.after(59)
    np.testing.assert_allclose(sample, [0, 0, 1.5, 0, 0, GRAVITY], atol=1e-12)
    assert yaw == pytest.approx(40 * 1.5 / RATE)  # samples 20 to 59


def test_it_does_what_a_plain_loop_does() -> None:
    rows = np.random.default_rng(3).normal(0, 2.0, (400, 6))
    rig = Rig(rows, num_samples=50)
    yaw, _ = rig.after(398)
    offset = sum(row[2] for row in rows[:50]) / 50
    angle = 0.0
    for row in rows[50:399]:
        angle += (row[2] - offset) / RATE
    assert yaw == pytest.approx(wrap(angle))
    np.testing.assert_allclose(offsets(rows.sum(axis=0), 400), rows.mean(axis=0) - AT_REST)


def test_the_yaw_goes_round() -> None:
    rows = resting(200, np.array([0, 0, 2.0, 0, 0, 0]))
    rig = Rig(rows, num_samples=0)
    yaw, sample = rig.after(99)
    assert yaw == pytest.approx(4.0 - 2 * math.pi)
    np.testing.assert_array_equal(sample, rows[0])  # no offset is known


def test_what_it_moves_during_the_calibration_is_in_its_yaw_for_good() -> None:
    rows = resting(200, np.zeros(6))
    rows[:20, 2] = 0.5  # turned while it should have stood
    yaw, _ = Rig(rows, num_samples=20).after(198)
    assert yaw == pytest.approx(-0.5 * 179 / RATE)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_sample_that_is_not_finite_is_neither_averaged_nor_integrated(value: float) -> None:
    rows = resting(100, np.array([0, 0, 0.3, 0, 0, 0]))
    rows[30:, 2] += 1.0
    rows[[5, 40], 2] = value
    rows[50, 5] = value
    rig = Rig(rows, num_samples=20)
    yaw, _ = rig.after(90)
    assert rig.bad == 3
    assert yaw == pytest.approx((91 - 30 - 2) / RATE)


def test_a_calibrated_gyro_drifts_by_its_noise_and_drift_only() -> None:
    # 20 deg/s of tolerance are gone; what is left in 20 s is a fraction of a degree.
    yaws = []
    for seed in range(4):
        builder = DiagramBuilder()
        imu = builder.AddSystem(Imu(parameters=Mpu6050Parameters(), rate=100.0, seed=seed))
        block = builder.AddSystem(GyroYaw(rate=100.0, num_samples=100))
        builder.Connect(imu.sample_output_port(), block.imu_input_port())
        builder.ExportInput(imu.pose_input_port(), "pose")
        diagram = builder.Build()
        simulator = Simulator(diagram)
        context = simulator.get_mutable_context()
        diagram.GetInputPort("pose").FixValue(context, RigidTransform())
        own = imu.GetMyMutableContextFromRoot(context)
        imu.spatial_velocity_input_port().FixValue(own, np.zeros(6))
        imu.spatial_acceleration_input_port().FixValue(own, np.zeros(6))
        simulator.AdvanceTo(20.0)
        yaw = block.yaw_output_port().Eval(block.GetMyContextFromRoot(context))[0]
        yaws.append(math.degrees(yaw))
    assert 1e-3 < np.abs(yaws).max() < 1.5


def test_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match=r"rate is 0\.0: must be greater than 0"):
        GyroYaw(rate=0.0)
    with pytest.raises(ValueError, match=r"num_samples is -1: must be 0 or greater"):
        GyroYaw(num_samples=-1)
