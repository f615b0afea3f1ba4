from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator
from scipy.spatial.transform import Rotation

from plants.shell_rover import body_rate
from systems.estimators.shell_ekf import ShellEkf
from systems.estimators.shell_ekf_parameters import ShellEkfParameters
from systems.messages import PoseEstimate, RotationIncrement
from systems.shell.angles import angles_of, nearest_rotation, rotation, rotation_error
from tests.shell_log import HARSH, RATE, VIEW, Result, ShellLog, drive, ekf, listen
from tests.systems.shell.shell_world import HEIGHT, MAP, RADIUS

DEG = math.radians(1.0)
COVARIANCE = np.diag([(0.1 * DEG) ** 2] * 3 + [2e-5**2] * 3)


class Rig:
    """A robot on the shell whose sensors are perfect unless a test says otherwise."""

    def __init__(self, angles: tuple[float, float, float] = (0.0, 0.0, 0.0), **parameters: object):
        self.ekf = ekf(**parameters)
        self.simulator = Simulator(self.ekf)
        self.context = self.simulator.get_mutable_context()
        self.R = rotation(np.array(angles))
        self.R_pictures = [self.R]
        self.k = 0
        ports = self.ekf
        ports.marker_pose_input_port().FixValue(self.context, PoseEstimate())
        ports.increment_input_port().FixValue(self.context, RotationIncrement())
        ports.imu_input_port().FixValue(self.context, np.zeros(6))

    def go(
        self,
        seconds: float,
        *,
        command: tuple[float, float] = (0.0, 0.0),
        flow: bool = True,
        marker: bool = False,
        imu: np.ndarray | None = None,
        frozen: bool = False,
        wrong: np.ndarray | None = None,
        lift: float = 0.0,
        reference: np.ndarray | None = None,
    ) -> None:
        """Drives on; pictures at 60 Hz, told at once.

        Args:
            seconds: for how long.
            command: speed (m/s) and turning rate (rad/s).
            flow: whether increments come. marker: whether marker poses do.
            imu: what it tells in place of the truth. frozen: it tells the same all the time.
            wrong: (3, 3) by which marker poses are turned.
            lift: by which they are too high, m.
            reference: (6,) velocity of the shell.
        """
        rate = body_rate(np.array(command), RADIUS)
        if reference is not None:
            self.ekf.reference_velocity_input_port().FixValue(self.context, reference)
        for _ in range(round(seconds * RATE)):
            t = self.k / RATE
            gyro = rate + (0 if reference is None else self.R.T @ reference[:3])
            sample = np.r_[gyro, 0, 0, 9.81]
            if not frozen:
                sample[5] += 1e-6 * self.k  # never twice the same
                self.ekf.imu_input_port().FixValue(self.context, sample if imu is None else imu)
            if self.k % 5 == 0:
                step = Rotation.from_matrix(self.R_pictures[-1].T @ self.R).as_rotvec()
                self.R_pictures.append(self.R)
                if flow and self.k:
                    self.ekf.increment_input_port().FixValue(
                        self.context,
                        RotationIncrement(t, t - 5 / RATE, "base_link", step, 1e-12 * np.eye(3)),
                    )
                if marker:
                    told = np.eye(3) if wrong is None else wrong
                    X = RigidTransform(RotationMatrix(told), np.zeros(3)) @ self.pose
                    X.set_translation(X.translation() * (1 + lift / (RADIUS + HEIGHT)))
                    self.ekf.marker_pose_input_port().FixValue(
                        self.context,
                        PoseEstimate(t, "shell", "base_link", X, COVARIANCE, markers=1),
                    )
            self.k += 1
            self.R = self.R @ Rotation.from_rotvec(rate / RATE).as_matrix()
            self.simulator.AdvanceTo((self.k - 0.5) / RATE)

    @property
    def pose(self) -> RigidTransform:
        R = nearest_rotation(self.R)
        return RigidTransform(RotationMatrix(R), (RADIUS + HEIGHT) * R[:, 2])

    @property
    def estimate(self) -> RigidTransform:
        return self.ekf.pose_output_port().Eval(self.context)

    @property
    def error(self) -> float:
        """Angle of the estimate's error, rad; the truth is half a sample ahead."""
        return float(np.linalg.norm(rotation_error(self.estimate.rotation().matrix(), self.R)))

    @property
    def P(self) -> np.ndarray:
        return self.ekf.covariance_output_port().Eval(self.context).reshape(6, 6)

    @property
    def deviation(self) -> float:
        return float(np.sqrt(np.diag(self.P)[:3].max()))

    @property
    def health(self) -> dict[str, int]:
        counts = self.ekf.health_output_port().Eval(self.context).counts
        return {reason: number for reason, number in counts.items() if number}


# --- Known answers ---


def test_with_perfect_sensors_it_follows_over_the_pole() -> None:
    rig = Rig((0.2, 1.2, 0.4))
    rig.go(0.5, marker=True)
    assert rig.error < 0.05 * DEG
    rig.go(3.0, command=(0.04, 0.3))
    assert rig.error < 0.15 * DEG  # half a sample at 31 deg/s is 0.05 degrees
    X = rig.estimate
    np.testing.assert_allclose(
        np.linalg.norm(X.translation()), RADIUS + HEIGHT, rtol=1e-12
    )  # it is held on the shell
    np.testing.assert_allclose(
        rig.ekf.angles_output_port().Eval(rig.context), angles_of(X.rotation().matrix())
    )
    normal = X.translation() / np.linalg.norm(X.translation())
    assert np.abs(normal @ rig.P[3:, 3:] @ normal) < 1e-12
    assert rig.health == {"accepted": 29, "unconfirmed": 1, "flow_accepted": 209}


def test_until_the_first_marker_nothing_is_known() -> None:
    rig = Rig(initial_angles=[0.1, 0.2, 0.3])
    rig.go(0.2)
    np.testing.assert_allclose(
        rig.ekf.angles_output_port().Eval(rig.context), [0.1, 0.2, 0.3], atol=1e-6
    )
    assert rig.deviation == pytest.approx(math.pi / math.sqrt(3), rel=1e-3)
    known = Rig(initial_deviation=0.01)
    known.go(0.2)
    assert known.deviation < 0.0105


@pytest.mark.parametrize("sensors", [["marker", "flow"], ["marker", "imu"], ["flow", "imu"]])
def test_each_sensor_can_be_left_out(sensors: list[str]) -> None:
    rig = Rig(sensors=sensors, initial_deviation=0.02, gyro_bias_std=1e-3)
    # What is left out may tell anything.
    bad = np.full(6, 3.0) if "imu" not in sensors else None
    wrong = Rotation.from_rotvec([0.5, 0, 0]).as_matrix() if "marker" not in sensors else None
    for _ in range(4):
        rig.go(0.3, command=(0.03, 0.1), marker=True, imu=bad, wrong=wrong)
        rig.go(0.3, command=(0.03, 0.1), imu=bad)
    assert rig.error < 0.5 * DEG
    used = set(rig.health)
    assert ("accepted" in used) == ("marker" in sensors)
    assert ("flow_accepted" in used) == ("flow" in sensors)
    assert "bad_imu" not in used


def test_the_reference_may_turn() -> None:
    turning = np.array([0.2, -0.3, 0.4, 0.0, 0.0, 0.0])
    rig = Rig((0.3, 0.4, 0.5))
    rig.go(0.5, marker=True, reference=turning)
    rig.go(2.0, command=(0.03, 0.0), flow=False, reference=turning)
    assert rig.error < 0.3 * DEG
    # Wrong on purpose: its motion unknown, and no flow to tell.
    other = Rig((0.3, 0.4, 0.5))
    other.go(0.5, marker=True, reference=turning)
    gyro = other.R.T @ turning[:3]
    port = other.ekf.reference_velocity_input_port()
    port.FixValue(other.context, np.zeros(6))
    other.go(2.0, flow=False, imu=np.r_[gyro, 0, 0, 9.8])
    assert other.error > 10 * DEG
    port.FixValue(other.context, np.full(6, math.nan))
    other.go(0.1)
    assert other.health["bad_reference"] == 30


# --- Bad samples ---


def started(**parameters: object) -> Rig:
    rig = Rig((0.3, 0.4, 0.5), **parameters)
    rig.go(0.5, marker=True)
    return rig


def test_a_bad_imu_is_dropped_counted_and_bridged_by_the_flow() -> None:
    rig = started()
    for bad in (np.full(6, math.nan), np.full(6, 1e3)):
        rig.go(1.0, command=(0.03, 0.2), imu=bad)
        assert rig.error < 0.3 * DEG
    assert rig.health["bad_imu"] == 600


def test_a_silent_imu_is_noticed_and_the_covariance_grows() -> None:
    rig = started()
    rig.go(2.0, command=(0.03, 0.2), frozen=True)  # it tells the rate of standing still
    assert rig.health["bad_imu"] >= 580
    # For 0.05 s, at 26 deg/s, it is believed; from then on the flow tells.
    assert rig.error < 1.3 * DEG
    blind = started()
    before = blind.deviation
    blind.go(2.0, command=(0.03, 0.2), frozen=True, flow=False)
    assert np.isfinite(blind.P).all()
    assert blind.deviation > 10 * before
    assert blind.error < 3 * blind.deviation


def test_a_frozen_camera_leaves_the_gyro_and_the_covariance_grows() -> None:
    rig = started()
    before = rig.deviation
    rig.go(6.0, command=(0.03, 0.2), flow=False)
    assert rig.error < 4 * rig.deviation
    assert rig.deviation > 1.2 * before
    rig.go(0.5, command=(0.03, 0.2))
    assert rig.health["flow_accepted"] >= 29 + 25  # it goes on with the flow when that is back


def test_wrong_ids_and_flips_are_refused_and_one_picture_later_all_is_well() -> None:
    for wrong in (
        Rotation.from_rotvec([0.0, 0.0, math.pi / 6]).as_matrix(),  # the neighbour's id
        Rotation.from_rotvec([0.2, 0.1, 0.0]).as_matrix(),
    ):
        rig = started()
        before = rig.health["accepted"]
        rig.go(0.5, marker=True, wrong=wrong)
        assert rig.health["gated"] == 30
        assert rig.health["accepted"] == before
        assert rig.error < 0.2 * DEG
        rig.go(0.1, marker=True)
        assert rig.health["accepted"] == before + 6


def test_a_wrong_start_is_found_out_by_two_markers_that_agree() -> None:
    rig = Rig((0.0, 0.0, 0.0))
    rig.go(0.2, marker=True, wrong=Rotation.from_rotvec([0.0, 0.0, math.pi / 6]).as_matrix())
    assert rig.error > 25 * DEG
    rig.go(0.2, marker=True)
    assert rig.error > 25 * DEG  # one marker alone may be the wrong one itself
    rig.go(1.4, command=(0.03, 0.0))  # 32 degrees on
    rig.go(0.2, marker=True)
    assert rig.health["restarted"] == 1
    assert rig.error < 0.5 * DEG


def test_it_does_not_start_from_a_single_wrong_pose() -> None:
    outlier = Rotation.from_rotvec([0.1, 0.08, 0.05]).as_matrix()  # 8 degrees
    rig = Rig((0.3, 0.4, 0.5))
    rig.go(1 / 60, marker=True, wrong=outlier)
    assert rig.health == {"unconfirmed": 1}
    assert rig.deviation > 1.0  # nothing is known yet
    rig.go(1 / 60, marker=True)
    assert rig.health["unconfirmed"] == 2
    rig.go(0.1, marker=True)
    assert rig.health["accepted"] == 6
    assert rig.error < 0.1 * DEG
    # The two that agree may be of different pictures of a robot that drives.
    later = Rig((0.3, 0.4, 0.5))
    later.go(1 / 60, marker=True)
    later.go(0.5, command=(0.04, 0.3))
    later.go(1 / 60, marker=True)
    assert later.health["accepted"] == 1
    assert later.error < 1.0 * DEG


def test_a_camera_that_hangs_higher_or_lower_costs_nothing_but_height() -> None:
    for lift in (-0.4e-3, 0.4e-3):  # 4 % of 10 mm
        rig = Rig((0.3, 0.4, 0.5))
        rig.go(0.5, marker=True, lift=lift)
        assert rig.health["accepted"] == 29
        assert rig.error < 0.05 * DEG
        # Wrong on purpose: the height is believed.
        strict = Rig((0.3, 0.4, 0.5), height_noise=0.0)
        strict.go(0.5, marker=True, lift=lift)
        assert "accepted" not in strict.health
    # Across the normal as much is 0.3 degrees on the shell, far beyond the poses' deviation.
    rig = started()
    rig.go(0.1, marker=True, wrong=Rotation.from_rotvec([0.005, 0.0, 0.0]).as_matrix())
    assert rig.health["gated"] == 6


def marker(rig: Rig, **changes: object) -> PoseEstimate:
    t = rig.k / RATE
    return replace(
        PoseEstimate(t, "shell", "base_link", rig.pose, COVARIANCE, markers=1),
        **changes,  # type: ignore[arg-type]
    )


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"covariance": np.full((6, 6), math.nan)}, "bad_marker_pose"),
        ({"covariance": np.zeros((6, 6))}, "bad_marker_pose"),
        ({"covariance": -np.eye(6)}, "bad_marker_pose"),
        ({"pose": RigidTransform([math.nan, 0, 0])}, "bad_marker_pose"),
        ({"stamp": 99.0}, "future"),
        ({"stamp": 0.01}, "stale"),
        ({"ambiguous": True}, "ambiguous"),
    ],
)
def test_bad_marker_poses_are_counted(changes: dict[str, object], reason: str) -> None:
    rig = started()
    before = rig.estimate.GetAsMatrix34()
    rig.ekf.marker_pose_input_port().FixValue(rig.context, marker(rig, **changes))
    rig.go(0.1)
    assert rig.health[reason] == 1
    np.testing.assert_allclose(rig.estimate.GetAsMatrix34(), before, atol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ((0.5, 0.48, "", np.full(3, math.nan), np.eye(3)), "bad_flow"),
        ((0.5, 0.52, "", np.zeros(3), np.eye(3)), "bad_flow"),
        ((0.5, 0.48, "", np.zeros(3), np.zeros((3, 3))), "bad_flow"),
        ((0.4, 0.38, "", np.zeros(3), 1e-10 * np.eye(3)), "stale_flow"),
        ((0.5, 295 / 600, "", np.full(3, 0.5), 1e-10 * np.eye(3)), "flow_gated"),
    ],
)
def test_bad_increments_are_counted(arguments: tuple[object, ...], reason: str) -> None:
    rig = started()
    rig.go(0.05, flow=False)
    before = rig.estimate.GetAsMatrix34()
    told = RotationIncrement(*arguments)  # type: ignore[arg-type]
    rig.ekf.increment_input_port().FixValue(rig.context, told)
    rig.go(0.02, flow=False)
    assert rig.health[reason] == 1
    np.testing.assert_allclose(rig.estimate.GetAsMatrix34(), before, atol=1e-5)


# --- Bad arguments ---


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"height": -1.0}, "height is -1.0"),
        ({"rate": 0.0}, "rate is 0.0"),
        ({"marker_map": replace(MAP, markers={})}, "marker_map"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ShellEkf(**({"view": VIEW, "marker_map": MAP} | arguments))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"sensors": ["marker", "radar"]}, "sensors is"),
        ({"sensors": []}, "sensors is"),
        ({"sensors": ["imu", "imu"]}, "sensors is"),
        ({"initial_angles": [0.0]}, "initial_angles is"),
        ({"rock_time": 0.0}, "rock_time is 0.0"),
        ({"mounting_std": -1.0}, "mounting_std is -1.0"),
        ({"height_noise": -1.0}, "height_noise is -1.0"),
        ({"imu_age": 1.0}, "imu_age is 1.0: must be less than the horizon"),
        ({"imu_age": -0.001}, "imu_age is -0.001: must be less than the horizon"),
        ({"imu_age": math.nan}, "imu_age is nan: must be less than the horizon"),
    ],
)
def test_bad_parameters_are_refused(parameters: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ShellEkfParameters(**parameters)  # type: ignore[arg-type]


def test_a_sample_is_one_tick_old_unless_it_is_said_how_old() -> None:
    told = []
    for parameters in ({}, {"imu_age": None}, {"imu_age": 1 / RATE}, {"imu_age": 0.0}):
        rig = Rig(**parameters)
        rig.go(0.3, flow=True, marker=True)
        rig.go(0.2, command=(0.03, 0.5))
        told.append(rig.estimate.GetAsMatrix34())
    np.testing.assert_array_equal(told[0], told[1])
    np.testing.assert_array_equal(told[0], told[2])
    assert np.abs(told[0] - told[3]).max() > 1e-5


# --- The paper's routine with the base errors ---


def degrees(result: Result, log: ShellLog) -> np.ndarray:
    return np.degrees(result.after(log.second).errors)


def test_the_routine_with_base_errors_is_exact_consistent_and_calibrated() -> None:
    errors, nees = [], []
    for seed in (0, 1):
        log = drive(seed)
        result = listen(log, ekf(), 15)
        errors.append(degrees(result, log))
        nees.append(result.after(log.second).nees().mean())
        found = result.block.calibration_output_port().Eval(  # type: ignore[union-attr]
            result.simulator.get_context()
        )
        # A height does not change by how much a picture turns.
        true = np.r_[log.bias, log.mounting, log.scale, 0.0, 0.0]
        off = (found[:9] - true) / found[9:]
        assert np.abs(off).max() < 4.5
        assert found[12:14].max() < 0.05 * DEG  # of a degree at the start
        assert found[15] < 0.001
    rmse = np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0))
    assert (rmse < 0.5).all()
    assert np.abs(np.concatenate(errors)).max() < 2.0
    assert 0.2 < np.mean(nees) < 2.0


def test_harsh_errors_and_outliers_right_at_the_start() -> None:
    """Two of this seed's first three poses are outliers, and the pictures are 30 ms late."""
    told = {
        f"{name}_std": getattr(HARSH, name) / math.sqrt(3)
        for name in ("placement", "mounting", "scale", "rock")
    }
    log = drive(4, HARSH)
    result = listen(log, ekf(**told), 15)
    errors = degrees(result, log)
    assert (np.sqrt(np.mean(errors**2, axis=0)) < 1.2).all()
    assert np.abs(errors).max() < 3.0
    assert result.health["unconfirmed"] >= 2
    assert result.health["gated"] <= 4
    found = result.block.calibration_output_port().Eval(  # type: ignore[union-attr]
        result.simulator.get_context()
    )
    assert abs(found[8] - log.delay) < 3 * found[17] < 0.01
    # Wrong on purpose: the gyro's vibration passes for knowledge of the delay.
    sure = listen(log, ekf(**told, delay_slack=0.3), 15)
    assert np.abs(degrees(sure, log)).max() > 1.5 * np.abs(errors).max()
    assert sure.health["gated"] > 2 * result.health["gated"]


def test_wrong_answers_are_found_out_by_the_consistency() -> None:
    log = drive(0)
    right = listen(log, ekf(), 15).after(log.second).nees().mean()
    for wrong in (
        {"gyro_bias_std": 0.0, "gyro_bias_walk": 0.0, "gyro_scale_std": 0.0},
        {"mounting_std": 0.0},
    ):
        found = listen(log, ekf(**wrong), 15).after(log.second).nees().mean()
        assert found > 3.0 * max(right, 1.0), wrong
