from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.analysis import Simulator
from scipy.spatial.transform import Rotation

from plants.shell_rover import body_rate
from systems.controllers.shell_route import (
    ShellRouteParameters,
    follow,
    on_leg,
    routine,
)
from systems.estimators.shell_rule import (
    ShellRule,
    ShellRuleParameters,
    grown,
    rolled,
    turn_about_normal,
)
from systems.markers.localizer import MapLocalizer
from systems.messages import PoseEstimate
from systems.shell.angles import angle_differences, angles_of, rotation, rotation_error
from systems.shell.layout import misplaced
from systems.shell.marker_pose import shell_localizer
from tests.systems.shell.shell_world import (
    CAMERA,
    HEIGHT,
    MAP,
    RADIUS,
    X_BC,
    detections,
    pose,
)

DEG = math.radians(1.0)
DT = 1 / 60
STILL = [0.0, 0.0, 0.0, 0.0, 0.0, 9.81]
SMALL = np.diag([1e-4, 2e-4, 3e-4, 1e-8, 2e-8, 3e-8])
# The attitude filter's frame: level, its heading anything.
R_ER = RotationMatrix(RollPitchYaw(0.0, 0.0, 1.1)).matrix()


def quaternion(R: np.ndarray) -> np.ndarray:
    x, y, z, w = Rotation.from_matrix(R).as_quat()
    return np.array([w, x, y, z])


# --- The step ---


def test_rolling_forward_is_north_rolling_left_is_west_and_turning_is_roll() -> None:
    start = np.array([0.0, 0.2, 0.5])
    X = pose(start)
    R, p = X.rotation().matrix(), X.translation()
    for step, turn, change in (
        ([0.0075, 0.0], 0.0, [0.0, 0.1, 0.0]),
        ([0.0, 0.0075], 0.0, None),
        ([0.0, 0.0], 0.3, [0.3, 0.0, 0.0]),
    ):
        R_moved, p_moved = rolled(R, p, np.array(step), turn, RADIUS)
        found = angles_of(R_moved)
        if change is not None:
            np.testing.assert_allclose(found, start + change, atol=1e-12)
        else:  # a great circle: cos(0.1) cos(lat), and west by 0.1 / cos(lat) at first
            assert found[2] == pytest.approx(0.5 - math.atan(math.tan(0.1) / math.cos(0.2)))
        assert np.linalg.norm(p_moved) == pytest.approx(RADIUS + HEIGHT)
        np.testing.assert_allclose(p_moved / np.linalg.norm(p_moved), R_moved[:, 2], atol=1e-12)


def test_away_from_the_pole_the_step_is_the_sum_of_angles_of_the_paper() -> None:
    # dpitch = north / radius, dyaw = east / (radius cos pitch), by the heading.
    angles = np.array([0.7, 0.5, -2.0])
    X = pose(angles)
    forward, left = 3e-6, -2e-6
    R, _ = rolled(X.rotation().matrix(), X.translation(), np.array([forward, left]), 0.0, RADIUS)
    c, s = math.cos(0.7), math.sin(0.7)
    north, east = c * forward - s * left, -s * forward - c * left
    found = angle_differences(R, X.rotation().matrix())
    assert found[1] == pytest.approx(north / RADIUS, rel=1e-4)
    assert found[2] == pytest.approx(east / (RADIUS * math.cos(0.5)), rel=1e-4)


def test_the_covariance_is_that_of_poses_carried_along() -> None:
    # By sampling: poses with errors, moved by the same step and turned by noise about the centre.
    rng = np.random.default_rng(0)
    X = pose(np.array([0.3, 0.7, 1.0]))
    R, p = X.rotation().matrix(), X.translation()
    root = rng.normal(0, 1, (6, 6)) * np.array([1e-3] * 3 + [1e-4] * 3)[:, None]
    P = root @ root.T
    sigma = 2e-3
    step, turn = np.array([0.02, -0.01]), 0.5
    R_moved, p_moved = rolled(R, p, step, turn, RADIUS)
    samples = []
    for _ in range(20000):
        error = root @ rng.normal(0, 1, 6)
        R_k = Rotation.from_rotvec(error[:3]).as_matrix() @ R
        R_k, p_k = rolled(R_k, p + error[3:], step, turn, RADIUS)
        noise = Rotation.from_rotvec(rng.normal(0, sigma, 3)).as_matrix()
        phi = Rotation.from_matrix(noise @ R_k @ R_moved.T).as_rotvec()
        samples.append(np.concatenate([phi, noise @ p_k - p_moved]))
    found = grown(P, R_moved @ R.T, p, p_moved, sigma**2)
    expected = np.cov(np.array(samples).T)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=0.05)
    naive = P + np.diag([sigma**2] * 3 + [0.0] * 3)  # wrong: the position's part left out
    assert np.abs(naive / scale - expected / scale).max() > 0.2


def test_the_turn_is_about_the_bodys_normal_whatever_the_frame() -> None:
    rng = np.random.default_rng(1)
    for R in Rotation.random(20, random_state=2).as_matrix():
        w = rng.uniform(-0.1, 0.1, 3)
        after = R @ Rotation.from_rotvec(w).as_matrix()
        found = turn_about_normal(quaternion(R), quaternion(after))
        assert found == pytest.approx(w[2], abs=1e-12)
        assert turn_about_normal(quaternion(R), -quaternion(after)) == pytest.approx(
            w[2], abs=1e-12
        )


# --- The block ---


class Rig:
    def __init__(self, **parameters: object) -> None:
        self.rule = ShellRule(
            radius=RADIUS,
            height=HEIGHT,
            parameters=ShellRuleParameters(**parameters),  # type: ignore[arg-type]
        )
        self.simulator = Simulator(self.rule)
        self.context = self.simulator.get_mutable_context()
        self.steps = 0
        self.feed()

    def feed(
        self,
        *,
        marker: PoseEstimate | None = None,
        flow: object = (0.0, 0.0),
        orientation: object = (1.0, 0.0, 0.0, 0.0),
        imu: object = STILL,
    ) -> None:
        rule, context = self.rule, self.context
        rule.marker_pose_input_port().FixValue(context, marker or PoseEstimate())
        rule.flow_input_port().FixValue(context, np.asarray(flow, float))
        rule.orientation_input_port().FixValue(context, np.asarray(orientation, float))
        rule.imu_input_port().FixValue(context, np.asarray(imu, float))

    def step(self, **inputs: object) -> None:
        self.feed(**inputs)  # type: ignore[arg-type]
        self.simulator.AdvanceTo((self.steps + 0.5) * DT)
        self.steps += 1

    @property
    def pose(self) -> RigidTransform:
        return self.rule.pose_output_port().Eval(self.context)

    @property
    def angles(self) -> np.ndarray:
        return self.rule.angles_output_port().Eval(self.context)

    @property
    def P(self) -> np.ndarray:
        return self.rule.covariance_output_port().Eval(self.context).reshape(6, 6)

    @property
    def health(self) -> dict[str, int]:
        counts = self.rule.health_output_port().Eval(self.context).counts
        return {reason: number for reason, number in counts.items() if number}


def seen(angles: object, stamp: float = 0.0, P: np.ndarray = SMALL) -> PoseEstimate:
    return PoseEstimate(
        stamp=stamp,
        frame_id="shell",
        child_frame_id="base_link",
        pose=pose(np.asarray(angles, float)),
        covariance=P,
        markers=1,
    )


def test_a_marker_pose_is_taken_as_it_is() -> None:
    rig = Rig()
    marker = seen([0.5, 0.2, -1.0])
    rig.step(marker=marker, flow=(0.1, 0.1))
    np.testing.assert_allclose(rig.pose.GetAsMatrix34(), marker.pose.GetAsMatrix34(), atol=1e-15)
    np.testing.assert_allclose(rig.angles, [0.5, 0.2, -1.0], atol=1e-12)
    np.testing.assert_array_equal(rig.P, SMALL)
    far = seen([-2.0, 1.0, 2.0], stamp=0.1)  # it has no gate
    rig.step(marker=far)
    np.testing.assert_allclose(rig.angles, [-2.0, 1.0, 2.0], atol=1e-12)
    assert rig.health == {"accepted": 2}


def test_until_the_first_marker_it_stands_where_it_is_told_and_says_that_nothing_is_known() -> None:
    rig = Rig(initial_angles=[0.1, 0.2, 0.3], drift=0.0)
    rig.step()
    np.testing.assert_allclose(rig.angles, [0.1, 0.2, 0.3], atol=1e-12)
    np.testing.assert_allclose(np.sqrt(np.diag(rig.P)[:3]), np.pi / math.sqrt(3))
    known = Rig(initial_deviation=0.01, drift=0.0)
    # Position: nothing along the normal (x at yaw 0), the lever arm sideways.
    expected = np.square([0.01] * 3 + [0.0] + [0.01 * (RADIUS + HEIGHT)] * 2)
    np.testing.assert_allclose(np.diag(known.P), expected, atol=1e-18)


def test_a_picture_counts_once_even_when_it_freezes() -> None:
    rig = Rig()
    frozen = seen([0.0, 0.0, 0.0], stamp=1.0)
    for _ in range(61):
        rig.step(marker=frozen, flow=(0.0075, 0.0))
    np.testing.assert_allclose(rig.angles, [0.0, 0.1, 0.0], atol=1e-9)
    assert rig.health == {"accepted": 1}
    assert (np.diag(rig.P)[:3] > np.diag(SMALL)[:3]).all()


def test_between_markers_the_covariance_grows_by_the_stated_rate() -> None:
    rig = Rig(drift=0.02)
    rig.step(marker=seen([0.0, 0.0, 0.0]))
    for _ in range(120):
        rig.step()
    np.testing.assert_allclose(np.diag(rig.P)[:3], np.diag(SMALL)[:3] + 0.02**2 * 2.0, rtol=1e-9)
    rig.step(marker=seen([0.0, 0.0, 0.0], stamp=2.0))
    np.testing.assert_array_equal(rig.P, SMALL)


@pytest.mark.parametrize("roll", ["orientation", "gyro"])
def test_dead_reckoning_over_the_pole_and_round_is_exact(roll: str) -> None:
    rig = Rig(roll=roll)
    R = rotation(np.array([0.2, 1.2, 0.4]))
    marker = seen(angles_of(R))
    rate = body_rate(np.array([0.04, 0.5]), RADIUS)
    for k in range(600):
        rig.step(
            marker=marker if k == 0 else None,
            flow=(0.04, 0.0),
            orientation=quaternion(R_ER @ R),
            imu=[*rate, 0, 0, 0],
        )
        np.testing.assert_allclose(rig.pose.rotation().matrix(), R, atol=1e-9)
        R = R @ Rotation.from_rotvec(rate * DT).as_matrix()
    assert np.linalg.norm(rig.pose.translation()) == pytest.approx(RADIUS + HEIGHT)
    assert rig.health == {"accepted": 1}


def test_what_each_sensor_is_for() -> None:
    # A false gyro does not matter where the orientation is good, and the other way round.
    turn = Rotation.from_euler("z", 0.5 * DT)
    for roll, gyro, expected in (
        ("orientation", 0.0, 0.5),
        ("gyro", 0.3, 0.3),
    ):
        rig = Rig(roll=roll)
        orientation = Rotation.identity()
        rig.step(marker=seen([0.0, 0.0, 0.0]))
        for _ in range(60):
            orientation = orientation * turn
            x, y, z, w = orientation.as_quat()
            # The sideways rates of the gyro are not used: that is the flow's part.
            rig.step(orientation=(w, x, y, z), imu=[0.7, -0.7, gyro, 0, 0, 9.81])
        np.testing.assert_allclose(rig.angles, [expected, 0.0, 0.0], atol=1e-9)


def test_tilting_does_not_move_the_robot() -> None:
    rig = Rig()
    rig.step(marker=seen([0.0, 0.0, 0.0]))
    for k in range(60):
        rig.step(orientation=quaternion(Rotation.from_euler("y", 0.01 * k).as_matrix()))
    np.testing.assert_allclose(rig.angles, 0.0, atol=1e-9)


NAN = math.nan


@pytest.mark.parametrize(
    ("inputs", "reason"),
    [
        ({"flow": (NAN, 0.0)}, "bad_flow"),
        ({"orientation": (NAN, 0, 0, 0)}, "bad_orientation"),
        ({"orientation": (0, 0, 0, 0)}, "bad_orientation"),
        ({"orientation": (0, 0, 0, 1)}, "bad_orientation"),  # half a turn in 1/60 s
        ({"imu": [0, 0, NAN, 0, 0, 9.81]}, "bad_imu"),
        ({"marker": seen([0, 0, 0], stamp=9.0, P=np.full((6, 6), NAN))}, "bad_marker_pose"),
    ],
)
def test_bad_samples_are_dropped_and_counted(inputs: dict[str, object], reason: str) -> None:
    rig = Rig()
    rig.step(marker=seen([0.1, 0.2, 0.3]))
    rig.step(**inputs)
    np.testing.assert_allclose(rig.angles, [0.1, 0.2, 0.3], atol=1e-12)
    assert rig.health == {"accepted": 1, reason: 1}
    for _ in range(10):
        rig.step(flow=(0.01, 0.0))
    assert np.isfinite(rig.pose.GetAsMatrix34()).all()
    assert rig.angles[1] > 0.2
    assert np.linalg.eigvalsh(rig.P).min() > 0


def test_without_an_orientation_the_gyro_stands_in() -> None:
    rig = Rig()
    rig.step(marker=seen([0.0, 0.0, 0.0]))
    for _ in range(60):
        rig.step(orientation=(NAN,) * 4, imu=[0, 0, 0.25, 0, 0, 9.81])
    np.testing.assert_allclose(rig.angles, [0.25, 0.0, 0.0], atol=1e-9)
    assert rig.health == {"accepted": 1, "bad_orientation": 60}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"radius": 0.0}, "radius is 0.0"),
        ({"height": -1.0}, "height is -1.0"),
        ({"rate": math.nan}, "rate is nan"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ShellRule(**({"radius": RADIUS} | arguments))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"roll": "compass"}, "roll is 'compass': must be 'orientation' or 'gyro'"),
        ({"drift": -0.1}, "drift is -0.1"),
        ({"initial_deviation": 0.0}, "initial_deviation is 0.0"),
        ({"initial_angles": [0.0, 0.0]}, r"initial_angles is \[0.0, 0.0\]"),
    ],
)
def test_bad_parameters_are_refused(parameters: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ShellRuleParameters(**parameters)  # type: ignore[arg-type]


# --- The paper's routine, driven on the truth, with the base errors ---


@dataclass
class Errors:
    """Bounds, from within which each seed draws uniformly."""

    placement: float = 0.5 * DEG
    mounting: float = 1.0 * DEG
    scale: float = 0.02
    bias: float = 0.3 * DEG  # rad/s
    missed: float = 0.2  # passages over markers
    pixels: float = 0.3


def way(iterations: int) -> tuple[np.ndarray, np.ndarray]:
    """`R_RB` and [v, omega] at 60 Hz along the routine."""
    legs, p = routine(iterations), ShellRouteParameters()
    R, rotations, commands = rotation(np.zeros(3)), [], []
    for leg in legs[:-1]:
        driven, frame = 0.0, leg.frame()
        while (leg.arc - driven) * RADIUS > p.position_tolerance:
            where = on_leg(R, frame)
            driven += math.remainder(where.along - driven, 2 * np.pi)
            command = np.array(follow(where, leg.arc - driven, RADIUS, p))
            rotations.append(R)
            commands.append(command)
            R = R @ Rotation.from_rotvec(body_rate(command, RADIUS) * DT).as_matrix()
    return np.array(rotations), np.array(commands)


def run(seed: int, errors: Errors, iterations: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the rule (n, 3) from the second marker on, and their stated deviations (n, 3)."""
    rng = np.random.default_rng(seed)
    off = RotationMatrix(
        Rotation.from_rotvec(rng.uniform(-errors.mounting, errors.mounting, 3)).as_matrix()
    )
    mounting = X_BC @ RigidTransform(off)
    markers = misplaced(MAP, bound=errors.placement, seed=seed)
    scale = 1 + rng.uniform(-errors.scale, errors.scale)
    bias = rng.uniform(-errors.bias, errors.bias, 3)
    localizer: MapLocalizer = shell_localizer(marker_map=MAP, camera=CAMERA, X_BC=X_BC)
    rig = Rig(roll="gyro")
    passages, last = 0, -1
    met: set[int] = set()
    missing, phi, stated = False, [], []
    flow, gyro = np.zeros(2), np.zeros(3)
    for k, (R, command) in enumerate(zip(*way(iterations), strict=True)):
        X = RigidTransform(RotationMatrix(R), (RADIUS + HEIGHT) * R[:, 2])
        picture = detections(
            X, markers=markers, mounting=mounting, noise=errors.pixels, seed=k, stamp=k * DT
        )
        if len(picture) and picture.ids[0] != last:
            last = int(picture.ids[0])
            passages += 1
            missing = rng.random() < errors.missed and passages > 1
        marker = None
        if len(picture) and not missing:
            marker = localizer.locate(picture).pose
            met.add(last)
        rig.step(marker=marker, flow=flow, imu=[*gyro, 0, 0, 0])
        # What the sensors tell at the next step is the motion until then.
        flow = np.array([scale * command[0], 0.0])
        gyro = body_rate(command, RADIUS) + bias
        if len(met) > 1:
            phi.append(rotation_error(rig.pose.rotation().matrix(), R))
            stated.append(np.sqrt(np.diag(rig.P)[:3]))
    return np.array(phi), np.array(stated)


def test_without_errors_the_rule_is_exact_all_the_way() -> None:
    phi, _ = run(0, Errors(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), iterations=1)
    assert np.abs(phi).max() < 1e-5


def test_with_the_base_errors_the_rule_is_below_the_papers_errors() -> None:
    phi = np.degrees(np.concatenate([run(seed, Errors(), iterations=1)[0] for seed in range(3)]))
    rmse = np.sqrt(np.mean(phi**2, axis=0))
    assert (rmse < [3.2965, 3.1783, 3.7709]).all()  # [SNAIL] Table I
    assert np.abs(phi).max() < 15.0
    # Yet it is no wonder: a mounting that is not calibrated shows in full.
    assert (rmse > 0.1).all()


def test_a_mounting_that_is_off_shows_as_it_is() -> None:
    # The rule cannot know it: 1 degree of mounting stays 1 degree of error.
    phi, _ = run(1, Errors(0.0, 1.0 * DEG, 0.0, 0.0, 0.0, 0.0), iterations=1)
    off = np.random.default_rng(1).uniform(-1, 1, 3)
    assert np.degrees(np.linalg.norm(phi, axis=1)).max() == pytest.approx(
        np.linalg.norm(off), abs=0.05
    )
