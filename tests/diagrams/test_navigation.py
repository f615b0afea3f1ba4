from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from diagrams.run import simulate
from diagrams.scenario import load_scenario
from systems.io.bag import BagReader

Array = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[2]
METRICS = {
    "waypoints_reached",
    "waypoints_total",
    "position_rmse_m",
    "heading_rmse_deg",
    "nees_mean",
    "nees_in_bounds",
    "nis_mean",
    "path_length_m",
    "integrated_jerk",
    "contacts",
    "min_clearance_m",
    "mean_clearance_m",
    "time_to_first_fix_s",
    "time_to_goal_s",
}
CLOCKS = ("wall_seconds", "real_time_factor")


def poses(path: Path) -> tuple[Array, Array]:
    """Reads a TUM file: times (n,) and [x, y, theta] (n, 3)."""
    t, x, y, z, qx, qy, qz, qw = np.loadtxt(path).T
    assert not z.any()
    assert not qx.any()
    assert not qy.any()
    np.testing.assert_allclose(np.hypot(qz, qw), 1.0, atol=1e-8)
    return t, np.column_stack([x, y, 2 * np.arctan2(qz, qw)])


def at(times: Array, wanted: Array) -> NDArray[np.intp]:
    """Indices of the wanted times, all of which must be there."""
    index = np.searchsorted(times, wanted - 1e-6)
    np.testing.assert_allclose(times[index], wanted, atol=1e-6)
    return index


def errors(truth: Array, estimate: Array) -> Array:
    difference = estimate - truth
    difference[:, 2] = np.angle(np.exp(1j * difference[:, 2]))
    return difference


def without_clocks(report: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in report.items() if key not in CLOCKS}


@pytest.fixture(params=["navigation", "kinematic"])
def finished(request: pytest.FixtureRequest) -> Any:
    return request.getfixturevalue(request.param)


# One run


def test_the_robot_reaches_its_waypoints(finished: Any) -> None:
    assert finished.status == 0
    report = finished.report
    assert report["outcome"] == "reached"
    assert (report["scenario"], report["seed"]) == ("navigation_open", 3)
    metrics = report["metrics"]
    assert metrics["waypoints_reached"] == metrics["waypoints_total"] == 5
    assert metrics["time_to_goal_s"] == pytest.approx(report["sim_seconds"], abs=1e-9)
    assert report["sim_seconds"] < 60
    assert metrics["position_rmse_m"] < 0.025
    assert metrics["heading_rmse_deg"] < 1.2


def test_the_report_is_whole_and_finite(finished: Any) -> None:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    report = json.loads((finished.path / "report.json").read_text(), parse_constant=refuse)
    assert list(report) == [
        "scenario", "seed", "outcome", "sim_seconds", "wall_seconds", "real_time_factor",
        "metrics", "health",
    ]  # fmt: skip
    assert set(report["metrics"]) == METRICS
    assert np.isfinite(list(report["metrics"].values())).all()
    assert report["real_time_factor"] == pytest.approx(
        report["sim_seconds"] / report["wall_seconds"]
    )
    estimator = report["health"]["estimator"]
    frames = 15 * report["sim_seconds"]
    assert 0.9 * frames < estimator.pop("accepted") <= frames + 1
    assert sum(estimator.values()) < 0.02 * frames
    assert report["health"]["search"]["lost"] <= 2


def test_the_folder_holds_what_it_should(finished: Any) -> None:
    names = {str(p.relative_to(finished.path)) for p in finished.path.rglob("*") if p.is_file()}
    assert names == {
        "report.json", "scenario.yaml", "summary.png", "truth.tum", "estimate.tum",
        "bag/bag_0.mcap", "bag/metadata.yaml",
    }  # fmt: skip
    assert (finished.path / "summary.png").read_bytes().startswith(b"\x89PNG")


def test_the_truth_passes_the_waypoints_in_order_and_touches_no_wall(finished: Any) -> None:
    scenario = load_scenario(str(finished.path / "scenario.yaml"))
    _, truth = poses(finished.path / "truth.tum")
    begin = 0
    for waypoint in scenario.waypoints:
        distance = np.hypot(*(truth[begin:, :2] - waypoint).T)
        # Arrival is judged by the estimate, twenty times a second, at 0.3 m/s.
        inside = np.flatnonzero(distance < scenario.arrival_radius + 0.05)
        assert len(inside)
        begin += inside[0]
    ground = np.column_stack([truth[:, :2], np.full(len(truth), 0.1)])
    room = scenario.robot.body.build().hull_radius
    for wall in scenario.world.arena.walls:
        assert wall.distance(ground).min() > room


def test_the_robot_keeps_its_limits(finished: Any) -> None:
    t, truth = poses(finished.path / "truth.tum")
    np.testing.assert_allclose(truth[0], [-1.8, -1.4, np.pi / 2], atol=1e-6)
    step = np.diff(t)
    speed = np.hypot(*np.diff(truth[:, :2], axis=0).T) / step
    turn = np.abs(np.angle(np.exp(1j * np.diff(truth[:, 2])))) / step
    parameters = load_scenario("navigation_open").controller.arguments["parameters"]
    assert speed.max() < parameters.max_speed * 1.03
    assert turn.max() < parameters.max_turn_rate * 1.03
    assert speed.max() > parameters.max_speed * 0.97


def test_the_metrics_follow_from_the_trajectories(finished: Any) -> None:
    metrics = finished.report["metrics"]
    t, truth = poses(finished.path / "truth.tum")
    known, estimate = poses(finished.path / "estimate.tum")
    e = errors(truth[at(t, known)], estimate)
    assert metrics["position_rmse_m"] == pytest.approx(
        np.sqrt(np.mean(e[:, 0] ** 2 + e[:, 1] ** 2)), rel=1e-6
    )
    assert metrics["heading_rmse_deg"] == pytest.approx(
        np.rad2deg(np.sqrt(np.mean(e[:, 2] ** 2))), rel=1e-6
    )
    assert metrics["path_length_m"] == pytest.approx(
        np.hypot(*np.diff(truth[:, :2], axis=0).T).sum(), rel=1e-6
    )
    assert metrics["time_to_first_fix_s"] == pytest.approx(known[0], abs=1e-9)
    np.testing.assert_allclose(np.diff(known), 0.02, atol=1e-6)


def test_the_consistency_follows_from_the_recorded_covariances(finished: Any) -> None:
    t, truth = poses(finished.path / "truth.tum")
    squared = []
    for _, time, message in BagReader(finished.bag).messages(["/robot/estimate"]):
        P = np.reshape(message.pose.covariance, (6, 6))[np.ix_([0, 1, 5], [0, 1, 5])]
        if P[0, 0] > 1e5:  # nothing known yet
            continue
        p, q = message.pose.pose.position, message.pose.pose.orientation
        estimate = np.array([[p.x, p.y, 2 * np.arctan2(q.z, q.w)]])
        (e,) = errors(truth[at(t, np.array([time]))], estimate)
        squared.append(e @ np.linalg.inv(P) @ e)
    metrics = finished.report["metrics"]
    # The recording lacks the last sample, at most.
    assert metrics["nees_mean"] == pytest.approx(np.mean(squared) / 3, rel=5e-3)
    inside = (np.array(squared) > 0.2158) & (np.array(squared) < 9.3484)
    assert metrics["nees_in_bounds"] == pytest.approx(inside.mean(), abs=2e-3)


def test_wheels_with_contact_do_as_the_kinematic_twin(navigation: Any, kinematic: Any) -> None:
    wheels, twin = navigation.report["metrics"], kinematic.report["metrics"]
    assert wheels["path_length_m"] == pytest.approx(twin["path_length_m"], rel=0.02)
    assert wheels["time_to_goal_s"] == pytest.approx(twin["time_to_goal_s"], rel=0.05)
    assert wheels != twin


def test_a_rendered_run_sees_as_well(rendered: Any) -> None:
    report = rendered.report
    assert (rendered.status, report["outcome"], report["sim_seconds"]) == (1, "timeout", 3.0)
    metrics = report["metrics"]
    assert metrics.pop("time_to_goal_s") is None
    assert np.isfinite(list(metrics.values())).all()
    assert metrics["waypoints_reached"] == 0
    assert metrics["position_rmse_m"] < 0.025
    assert metrics["heading_rmse_deg"] < 1.5
    # A picture 20 ms after each multiple of 1/15 s, all with markers.
    assert report["health"]["estimator"]["accepted"] >= 43


# Many runs


def test_the_saved_scenario_reproduces_the_run_bit_for_bit(navigation: Any, tmp_path: Path) -> None:
    # In another process, in another folder, with strings hashed otherwise.
    subprocess.run(
        [sys.executable, "-m", "tagtrail", "run", navigation.path / "scenario.yaml",
         "--no-meshcat", "--out", "again"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT), "PYTHONHASHSEED": "77"},
        check=True,
        capture_output=True,
    )  # fmt: skip
    again = tmp_path / "again"
    report = json.loads((again / "report.json").read_text())
    assert without_clocks(report) == without_clocks(navigation.report)
    for name in ("bag/bag_0.mcap", "bag/metadata.yaml", "truth.tum", "estimate.tum",
                 "scenario.yaml", "summary.png"):  # fmt: skip
        assert (again / name).read_bytes() == (navigation.path / name).read_bytes(), name


def test_another_seed_is_another_run(
    navigation: Any, tagtrail: Callable[..., Any], tmp_path: Path
) -> None:
    tagtrail(
        "run", navigation.path / "scenario.yaml", "--no-meshcat", "--seed", "4",
        "--duration", "2", "--out", tmp_path,
    )  # fmt: skip
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["seed"] == 4
    _, other = poses(tmp_path / "estimate.tum")
    _, first = poses(navigation.path / "estimate.tum")
    assert not np.allclose(other, first[: len(other)], atol=1e-5)
    # Of every sensor, from its first sample on (of the gyro's port, the first value is zeros).
    for topic, first_sample in (("/robot/imu", 1), ("/robot/front_camera/detections", 0)):
        one, another = (
            next(islice(BagReader(bag).records([topic]), first_sample, None)).data
            for bag in (tmp_path / "bag", navigation.bag)
        )
        assert one != another, topic


def test_a_shorter_run_is_the_beginning_of_a_longer_one(kinematic: Any, shown: Any) -> None:
    # And watching it in Meshcat changes nothing.
    for name in ("truth.tum", "estimate.tum"):
        short = (shown.path / name).read_text().splitlines()
        long = (kinematic.path / name).read_text().splitlines()
        assert len(short) > 290
        assert short == long[: len(short)]


def test_noise_of_one_sensor_leaves_that_of_the_others(tmp_path: Path) -> None:
    bags = []
    for density in (5e-4, 1e-3):
        out = tmp_path / str(density)
        scenario = load_scenario(
            "navigation_open",
            {
                "sight": "projected",
                "dynamics": "kinematic",
                "duration": 0.5,
                "robot.sensors.imu.gyro_noise_density": density,
            },
        )
        simulate(scenario, out=out)
        bags.append(BagReader(out / "bag"))
    imu, detections = (
        [[record.data for record in bag.records([topic])] for bag in bags]
        for topic in ("/robot/imu", "/robot/front_camera/detections")
    )
    assert imu[0] != imu[1]
    # Later ones differ: the robot steers by what it estimates.
    assert detections[0][0] == detections[1][0]


def test_a_run_that_sees_no_marker_ends_with_a_report(
    tagtrail: Callable[..., Any], tmp_path: Path
) -> None:
    path = tmp_path / "blind.yaml"
    path.write_text(
        "extends: navigation_open\nsight: projected\ndynamics: kinematic\nduration: 3\n"
        "world: {markers: {family: 4x4_50, size: 0.1, tags: []}}\n"
    )
    result = tagtrail("run", path, "--no-meshcat", "--out", tmp_path / "out")
    assert (result.status, result.err) == (1, "")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["outcome"] == "timeout"
    metrics = report["metrics"]
    for name in ("position_rmse_m", "nees_mean", "time_to_first_fix_s", "time_to_goal_s"):
        assert metrics[name] is None
    assert metrics["waypoints_reached"] == 0
    # Lost, it stands, then turns on the spot to look for markers.
    _, truth = poses(tmp_path / "out" / "truth.tum")
    assert np.abs(truth[:, :2] - truth[0, :2]).max() < 1e-6
    turned = np.unwrap(truth[:, 2])[-1] - truth[0, 2]
    assert turned == pytest.approx(0.6 * 2.5, rel=0.1)


def test_an_estimator_that_claims_to_be_certain_is_not_consistent(
    tagtrail: Callable[..., Any], tmp_path: Path
) -> None:
    (tmp_path / "oracle.py").write_text(
        "from pydrake.systems.framework import LeafSystem\n"
        "class Sure(LeafSystem):\n"
        "    def __init__(self):\n"
        "        super().__init__()\n"
        "        for name, size in (('pose', 3), ('covariance', 9)):\n"
        "            self.DeclareVectorOutputPort(\n"
        "                name, size, lambda _, out, n=size: out.SetFromVector([0.0] * n))\n"
    )
    path = tmp_path / "sure.yaml"
    path.write_text(
        "extends: navigation_open\nsight: projected\ndynamics: kinematic\nduration: 1\n"
        "estimator: oracle:Sure\n"
    )
    result = tagtrail("run", path, "--no-meshcat", "--out", tmp_path / "out")
    assert (result.status, result.err) == (1, "")
    metrics = json.loads((tmp_path / "out" / "report.json").read_text())["metrics"]
    assert metrics["position_rmse_m"] > 1
    assert metrics["nees_mean"] is None  # infinite
    assert metrics["nees_in_bounds"] == 0
