"""Motors, inertial sensor and encoders in a station, as a scenario chooses them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from diagrams.run import simulate
from diagrams.scenario import load_scenario
from diagrams.schema import ScenarioError
from diagrams.station import Station
from plants.motors import MotorModel, MotorParameters
from systems.controllers.wheel_pwm import pulse_widths
from systems.io.bag import BagReader
from systems.sensors.imu_parameters import GRAVITY, Mpu6050Parameters

R, BASE = 0.0325, 0.16
ENCODERS = "robot.sensors.encoders={type: wheel_encoders, ticks_per_turn: 960}"
MPU6050 = "robot.sensors.imu=mpu6050"


class Rig:
    """The bundled station with other devices; the drive's command is held."""

    def __init__(self, *overrides: str, dynamics: str = "multibody") -> None:
        settings = ["sight=projected", f"dynamics={dynamics}", *overrides]
        self.station: Station = load_scenario("navigation_open", settings).build().station
        self.simulator = Simulator(self.station)
        self.context = self.simulator.get_mutable_context()
        self.command(0.0, 0.0)

    def command(self, v: float, omega: float) -> None:
        self.station.GetInputPort("robot.drive.command").FixValue(self.context, [v, omega])

    def run(self, duration: float) -> None:
        self.simulator.AdvanceTo(self.context.get_time() + duration)

    def output(self, name: str) -> Any:
        return self.station.GetOutputPort(name).Eval(self.context).copy()

    def motion(self, duration: float = 0.1) -> tuple[float, float]:
        """Speed (m/s) and turn rate (rad/s) of the true pose over a while."""
        before = self.output("truth.robot.pose")
        self.run(duration)
        moved = self.output("truth.robot.pose") - before
        turn = math.remainder(moved[2], 2 * math.pi)
        chord = math.hypot(moved[0], moved[1])
        return chord / duration, turn / duration


@pytest.mark.parametrize("dynamics", ["multibody", "kinematic"])
@pytest.mark.parametrize("chopped", ["enable", "inputs"])
def test_the_wheels_turn_as_the_unequal_motors_make_of_the_pulses(
    dynamics: str, chopped: Any
) -> None:
    gains = {"right_gain": 0.95, "left_gain": 1.03}
    motors = f"{{chopped: {chopped}, right_gain: 0.95, left_gain: 1.03}}"
    rig = Rig(f"robot.drive={{type: dc_motors, motors: {motors}}}", dynamics=dynamics)
    command = np.array([0.15, 0.4])
    rig.command(*command)
    rig.run(4.0)
    np.testing.assert_allclose(rig.output("robot.drive.sent"), command)
    # What the robot means, what eight bits make of it, what the motors do.
    wanted = (command[0] + command[1] * BASE / 2 * np.array([1, -1])) / R
    parameters = MotorParameters(chopped=chopped, **gains)
    pwm = pulse_widths(MotorModel(parameters).duty(wanted))
    right, left = MotorModel(parameters, list(gains.values())).steady_speed(pwm / 255)
    v, omega = rig.motion()
    assert v == pytest.approx(R * (right + left) / 2, rel=0.01)
    assert omega == pytest.approx(R * (right - left) / BASE, rel=0.02)
    assert abs(omega - command[1]) > 0.05  # which is not what it meant


def test_a_command_beyond_the_motors_is_known_to_be_slower() -> None:
    rig = Rig("robot.drive={type: dc_motors, motors: {right_gain: 1.0, left_gain: 1.0}}")
    rig.command(0.5, -2.0)
    rig.run(4.0)
    reach = MotorModel(MotorParameters()).max_speed * R
    v, omega = rig.output("robot.drive.sent")
    assert v - omega * BASE / 2 == pytest.approx(reach)
    assert omega / v == pytest.approx(-4.0)
    assert rig.motion() == pytest.approx((v, omega), rel=0.01)


def test_servos_are_still_the_default_and_do_as_they_are_told() -> None:
    rig = Rig()
    rig.command(0.4, 0.5)
    rig.run(2.0)
    assert rig.motion() == pytest.approx((0.4, 0.5), rel=0.005)


@pytest.mark.parametrize("dynamics", ["multibody", "kinematic"])
@pytest.mark.parametrize("drive", ["dc_motors", "wheel_servo"])
def test_encoders_count_the_way_of_the_wheels(dynamics: str, drive: str) -> None:
    rig = Rig(f"robot.drive={drive}", ENCODERS, dynamics=dynamics)
    rig.command(-0.2, 0.8)
    rig.run(0.5)
    for _ in range(3):
        angles = rig.output("robot.encoders.ticks") * 2 * math.pi / 960
        heading = rig.output("truth.robot.pose")[2]
        rig.run(1.0)
        turned = rig.output("robot.encoders.ticks") * 2 * math.pi / 960 - angles
        assert (turned < 0).all()
        turn = math.remainder(rig.output("truth.robot.pose")[2] - heading, 2 * math.pi)
        assert R * (turned[0] - turned[1]) / BASE == pytest.approx(turn, abs=0.01)
    assert turned[0] > turned[1]


def test_an_mpu6050_is_calibrated_while_the_robot_rests() -> None:
    rig = Rig("robot.drive.rest=1.0", MPU6050, "seed=4")
    rig.command(0.0, 1.0)
    rig.run(0.9)
    np.testing.assert_array_equal(rig.output("robot.imu.sample"), [0, 0, 0, 0, 0, GRAVITY])
    raw = Rig("robot.drive.rest=1.0", MPU6050, "robot.sensors.imu.calibration=0.0", "seed=4")
    raw.run(0.9)
    offset = np.degrees(raw.output("robot.imu.sample")[:3])
    assert 2.0 < np.abs(offset).max() <= 20.5
    rig.run(0.12)
    still = np.degrees(rig.output("robot.imu.sample")[:3])
    assert np.abs(still[:2]).max() < 0.3
    rig.run(2.0)
    rate = rig.output("robot.imu.sample")[2]
    assert rate == pytest.approx(1.0, abs=0.035)  # its scale is off by up to 3 %
    assert rate != pytest.approx(1.0, abs=1e-4)


def test_a_figure_of_the_sheet_can_be_overridden() -> None:
    rig = Rig("robot.sensors.imu={type: mpu6050, calibration: 0.0, gyro_bias: [0, 0, 1]}")
    rig.run(0.1)
    assert rig.output("robot.imu.sample")[2] == pytest.approx(1.0, abs=math.radians(21.0))
    scenario = load_scenario("navigation_open", [MPU6050, "robot.sensors.imu.bits=12"])
    parameters = scenario.robot.sensors["imu"].arguments["parameters"]
    assert parameters == Mpu6050Parameters(bits=12)


@pytest.mark.usefixtures("workshop")
def test_a_calibration_in_motion_is_refused(refuse: Callable[..., str]) -> None:
    message = refuse("run", "navigation_open", "--no-meshcat", "--set", MPU6050)
    assert message.endswith(
        "robot.imu.calibration is 1.0: must be at most the 0 s that robot.drive.rest makes the "
        "robot stand"
    )


DEVICES = ("--set", "robot.drive={type: dc_motors, rest: 1.0}", "--set", MPU6050, "--set", ENCODERS)


@pytest.fixture(scope="module")
def run(tagtrail: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundled mission with all of them, to its end."""
    out = tmp_path_factory.mktemp("devices")
    seen = ("--set", "sight=projected", "--seed", "3")
    result = tagtrail("run", "navigation_open", "--no-meshcat", *seen, *DEVICES, "--out", out)
    assert result.err == ""
    return out


def test_the_mission_is_fulfilled_with_all_of_them(run: Path) -> None:
    report = json.loads((run / "report.json").read_text())
    assert report["outcome"] == "reached"
    assert report["metrics"]["position_rmse_m"] < 0.04
    assert report["metrics"]["heading_rmse_deg"] < 1.5
    assert report["health"]["robot.imu.offsets"] == {"bad_imu": 0}


def test_played_back_their_signals_are_the_same(
    run: Path, tagtrail: Callable[..., Any], tmp_path: Path
) -> None:
    play = ("--play", run / "bag", "--duration", "6")
    result = tagtrail("run", "navigation_open", "--no-meshcat", *DEVICES, *play, "--out", tmp_path)
    assert result.err == ""
    first = (run / "estimate.tum").read_text().splitlines()
    again = (tmp_path / "estimate.tum").read_text().splitlines()
    assert len(again) > 290
    assert again == first[: len(again)]
    for topic in ("/robot/encoders", "/robot/imu"):
        before = [(r.log_time, r.data) for r in BagReader(run / "bag").records([topic])]
        after = [(r.log_time, r.data) for r in BagReader(tmp_path / "bag").records([topic])]
        assert len(after) > 240  # wheels at rest have nothing new to say
        assert after == before[: len(after)]


def test_a_filter_that_hears_the_encoders_knows_that_the_motors_are_weak() -> None:
    """Both wheels at 80 % of their speed, and no marker from the third second on."""
    weak = {
        "sight": "projected",
        "duration": 12.0,
        "estimator": "ekf",
        "robot.drive": {"type": "dc_motors", "motors": {"right_gain": 0.8, "left_gain": 0.8}},
        "robot.faults": [{"signal": "front_camera.detections", "kind": "silent", "start": 3.0}],
    }
    encoders = {
        "robot.sensors.encoders": {"type": "wheel_encoders", "ticks_per_turn": 960},
        "encoders": "encoders",
    }
    errors = []
    for settings in (weak, weak | encoders):
        run = simulate(load_scenario("navigation_open", settings))
        log = run.mission.pose_log(run.context)  # type: ignore[attr-defined]
        errors.append(float(np.linalg.norm(log.errors()[-1, :2])))
    without, with_them = errors
    assert with_them < 0.08
    assert without > 5 * with_them


def test_encoders_that_are_not_there_are_refused() -> None:
    with pytest.raises(ScenarioError, match=r"encoders is 'wheels': must be one of the robot's"):
        load_scenario("navigation_open", {"encoders": "wheels"})
