from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import PortDataType

from diagrams.drivers.lidar import Lidar
from diagrams.scenario import load_scenario
from diagrams.station import Station
from systems.io.bag import BagReader
from systems.io.ros_scan import scan_from_ros
from systems.messages import Scan
from systems.scans import scan_points
from systems.sensors.lidar import LidarParameters

LIDAR = """
world:
  arena:
    walls:
      - {start: [-2.5, -2.0], end: [2.5, -2.0]}
      - {start: [2.5, -2.0], end: [2.5, 2.0]}
      - {start: [2.5, 2.0], end: [-2.5, 2.0]}
      - {start: [-2.5, 2.0], end: [-2.5, -2.0]}
robot:
  sensors:
    lidar:
      type: lidar
      rate: 10.0
      latency: 0.02
      position: [0.03, 0.01, 0.15]
      yaw_deg: 180
      range_noise: 0.0
      range_noise_part: 0.0
      dropout_probability: 0.0
      mixed_share: 0.0
"""
# The walls' inner faces, 2.5 cm before their centre lines.
X_WALL, Y_WALL = 2.475, 1.975


@pytest.fixture
def scenario(write_scenario: Callable[..., Path]) -> Path:
    return write_scenario(LIDAR)


def station(scenario: Path, *overrides: str) -> Station:
    return load_scenario(scenario, ["sight=projected", *overrides]).build().station


def scans(station: Station, times: list[float], command: Any = (0.0, 0.0)) -> list[Scan]:
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    if station.HasInputPort("robot.drive.command"):
        station.GetInputPort("robot.drive.command").FixValue(context, np.array(command))
    found = []
    for t in times:
        simulator.AdvanceTo(t)
        found.append(station.GetOutputPort("robot.lidar.scan").Eval(context))
    return found


@pytest.mark.parametrize("dynamics", ["multibody", "kinematic"])
def test_the_robots_lidar_scans_the_arena(scenario: Path, dynamics: str) -> None:
    before, scan = scans(station(scenario, f"dynamics={dynamics}"), [0.119, 0.121])
    assert math.isnan(before.stamp)
    assert scan.frame_id == "robot/lidar"
    assert scan.stamp == pytest.approx(0.1 / 360, abs=1e-8)
    # It stands at (-1.8, -1.4), looking along +y; the wheels and the chassis are not seen.
    assert np.isfinite(scan.ranges).all()
    assert scan.ranges.min() > 0.5
    driver = Lidar(position=[0.03, 0.01, 0.15], yaw_deg=180)
    np.testing.assert_allclose(driver.planar_mounting(), [0.03, 0.01, math.pi])
    points = scan_points(scan, driver.planar_mounting())
    x, y = -1.8 - points[:, 1], -1.4 + points[:, 0]
    gap = np.abs([np.abs(x) - X_WALL, np.abs(y) - Y_WALL]).min(axis=0)
    assert gap.max() < 5e-4  # the wheels settle by as much
    # The first ray points backward in the lidar's frame, and that is forward here.
    assert scan.ranges[0] == pytest.approx(Y_WALL + 1.4 - 0.03, abs=5e-4)


def test_a_turning_robots_scan_is_straightened_by_its_twist(scenario: Path) -> None:
    driven = station(scenario, "dynamics=kinematic")
    simulator = Simulator(driven)
    context = simulator.get_mutable_context()
    driven.GetInputPort("robot.drive.command").FixValue(context, [0.2, 0.8])
    simulator.AdvanceTo(1.0)
    pose = driven.GetOutputPort("truth.robot.pose").Eval(context).copy()
    simulator.AdvanceTo(1.021)
    scan = driven.GetOutputPort("robot.lidar.scan").Eval(context)
    mounting = np.array([0.03, 0.01, math.pi])

    def gap(twist: Any) -> float:
        points = scan_points(scan, mounting, twist=twist)
        c, s = math.cos(pose[2]), math.sin(pose[2])
        x, y = np.array([[c, -s], [s, c]]) @ points.T + pose[:2, None]
        return float(np.abs([np.abs(x) - X_WALL, np.abs(y) - Y_WALL]).min(axis=0).max())

    assert gap(np.array([0.2, 0.8])) < 1e-3
    assert gap(None) > 0.02


def test_recorded_and_played_back_the_scans_are_the_same(
    write_scenario: Callable[..., Path], tagtrail: Callable[..., Any], tmp_path: Path
) -> None:
    # With all its noise.
    scenario = write_scenario("robot: {sensors: {lidar: {type: lidar, latency: 0.02}}}\n")
    arguments = ("--no-meshcat", "--set", "sight=projected", "--duration", "2")
    result = tagtrail("run", scenario, *arguments, "--out", tmp_path / "run")
    assert result.err == ""
    bag = BagReader(tmp_path / "run" / "bag")
    assert bag.topics()["/robot/lidar/scan"] == "sensor_msgs/msg/LaserScan"
    recorded = [scan_from_ros(m) for _, _, m in bag.messages(["/robot/lidar/scan"])]
    assert len(recorded) == 10
    assert all(not math.isnan(scan.stamp) for scan in recorded)
    np.testing.assert_allclose(np.diff([s.stamp for s in recorded]), 1 / 5.5, atol=1e-8)

    driven = load_scenario(scenario, ["sight=projected"]).build()
    simulator = Simulator(driven.diagram)
    context = driven.station.GetMyContextFromRoot(simulator.get_context())
    played = station(scenario, f"recording={tmp_path / 'run' / 'bag'}")
    times = [0.1, 0.45, 1.0, 1.5]
    for t, again in zip(times, scans(played, times), strict=True):
        simulator.AdvanceTo(t)
        scan = driven.station.GetOutputPort("robot.lidar.scan").Eval(context)
        assert len(again) == len(scan) == (0 if t < 0.2 else 360)
        for name in ("stamp", "angle_min", "angle_increment", "time_increment", "range_min"):
            np.testing.assert_array_equal(getattr(again, name), getattr(scan, name))
        np.testing.assert_array_equal(again.ranges, scan.ranges)
    failed = sum(int(np.isnan(scan.ranges).sum()) for scan in recorded)
    assert 5 < failed < 60  # of 3600 rays: drop-outs are kept as such


def test_the_port_is_the_same_simulated_and_played(
    scenario: Path, tagtrail: Callable[..., Any], tmp_path: Path
) -> None:
    arguments = ("--no-meshcat", "--set", "sight=projected", "--duration", "0.5")
    assert tagtrail("run", scenario, *arguments, "--out", tmp_path / "run").err == ""
    played = station(scenario, f"recording={tmp_path / 'run' / 'bag'}")
    for one in (station(scenario), played):
        port = one.GetOutputPort("robot.lidar.scan")
        assert port.get_data_type() == PortDataType.kAbstractValued
        assert type(port.Allocate().get_value()) is Scan
    messages = BagReader(tmp_path / "run" / "bag").messages(["/tf_static"])
    ((_, _, static),) = messages
    (mounting,) = (t for t in static.transforms if t.child_frame_id == "robot/lidar")
    assert mounting.header.frame_id == "robot/base_link"
    p, q = mounting.transform.translation, mounting.transform.rotation
    assert (p.x, p.y, p.z) == pytest.approx((0.03, 0.01, 0.15))
    assert abs(q.z) == pytest.approx(1.0)


def test_a_recording_without_scans_is_refused(
    scenario: Path, navigation: Any, refuse: Callable[..., str]
) -> None:
    said = refuse("run", scenario, "--no-meshcat", "--play", navigation.bag)
    assert "lacks the topic /robot/lidar/scan" in said


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("rate=20", "rate is 20.0: must be 5.5 to 10"),
        ("rays=3", "rays is 3: must be 4 to"),
        ("latency=-1", "latency is -1"),
        ("position=[0,0]", "position is"),
        ("yaw_deg=.inf", "yaw_deg is inf"),
        ("beam_divergence=0", "beam_divergence is 0"),
        ("reflection=1", "reflectivity"),
    ],
)
def test_wrong_settings_are_refused(
    scenario: Path, refuse: Callable[..., str], setting: str, said: str
) -> None:
    line = refuse("run", scenario, "--no-meshcat", "--set", f"robot.sensors.lidar.{setting}")
    assert said in line


def test_the_drivers_default_is_an_a1m8() -> None:
    driver = Lidar()
    p = driver.parameters
    assert p == LidarParameters()
    assert (p.rate, p.rays, p.range_min, p.range_max) == (5.5, 360, 0.15, 12.0)
    np.testing.assert_array_equal(driver.planar_mounting(), np.zeros(3))
