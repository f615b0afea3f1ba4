"""The robot whole: motors, MPU6050, lidar, obstacles."""

from __future__ import annotations

import math
from typing import Any

import pytest

from diagrams.run import Run, simulate
from diagrams.scenario import load_scenario
from diagrams.schema import ScenarioError


def run(name: str, *overrides: str) -> Run:
    return simulate(load_scenario(name, ["sight=projected", *overrides]))


@pytest.fixture(scope="module")
def whole() -> Run:
    return run("navigation")


def test_it_reaches_its_waypoints_and_touches_nothing(whole: Run) -> None:
    metrics = whole.report["metrics"]
    assert whole.report["outcome"] == "reached"
    assert metrics["contacts"] == 0
    assert metrics["min_clearance_m"] > 0.03
    assert metrics["position_rmse_m"] < 0.01
    assert metrics["heading_rmse_deg"] < 0.5
    # Neither too sure of itself nor too timid; one run is one draw.
    assert 0.4 < metrics["nees_mean"] < 2.0
    assert 0.4 < metrics["nis_mean"] < 2.0
    assert all(math.isfinite(value) for value in metrics.values())


def test_nothing_is_dropped_without_a_word(whole: Run) -> None:
    health = whole.report["health"]
    for block in ("avoider", "monitor"):
        assert health[block]["no_scan"] <= 5  # until the lidar's first turn is done
        assert health[block]["stale_scan"] == health[block]["garbled_scan"] == 0
    assert health["planner"]["no_path"] == 0


def test_the_papers_own_algorithms_are_a_matter_of_three_keys() -> None:
    paper = run("navigation", "estimator=kf", "avoider=sector", "planner=none", "duration=20")
    kinds = {type(system).__name__ for system in paper.mission.diagram.GetSystems()}
    assert {"PlanarKalmanFilter", "SectorAvoider"} <= kinds
    assert not kinds & {"PlanarEkf", "AStarPlanner", "OccupancyMapper", "VfhPlus"}
    assert paper.report["metrics"]["contacts"] == 0
    assert paper.report["metrics"]["waypoints_reached"] >= 1


def test_an_avoider_that_drives_needs_no_controller() -> None:
    dwa = run("navigation", "avoider=dwa", "duration=15")
    assert dwa.report["metrics"]["contacts"] == 0
    assert dwa.report["metrics"]["waypoints_reached"] >= 1


def test_a_trap_is_left_with_a_map_and_given_up_without() -> None:
    with_map = run("navigation_trap").report
    assert with_map["outcome"] == "reached"
    assert with_map["metrics"]["contacts"] == 0
    without = run("navigation_trap", "planner=none").report
    assert without["outcome"] == "blocked"
    assert without["metrics"]["contacts"] == 0


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_random_rooms(seed: int) -> None:
    report = run("navigation_random", f"seed={seed}").report
    assert report["outcome"] == "reached"
    assert report["metrics"]["contacts"] == 0


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["lidar=null"], "lidar is None: must be one of the sensors, or planner: none"),
        (["lidar=null", "planner=none"], "or avoider: none"),
        (["lidar=imu"], "lidar is 'imu': must be one of the robot's sensors that fit: lidar"),
        (["avoider=vfh"], "no such avoider; known: dwa, none, sector, vfh_plus"),
        (["planner=rrt"], "no such planner; "),
    ],
)
def test_blocks_that_do_not_fit_are_refused(overrides: list[Any], message: str) -> None:
    with pytest.raises(ScenarioError) as refusal:
        load_scenario("navigation", overrides)
    assert message in str(refusal.value)


def test_a_touch_is_told_even_when_the_time_runs_out() -> None:
    # A cylinder drives over the robot, which stands while its gyro is calibrated.
    ram = "{radius: 0.1, height: 0.5, path: [[-1.2, -1.4], [-1.9, -1.4]], speed: 0.6}"
    report = run(
        "navigation", "dynamics=kinematic", "duration=1.5", f"world.arena.moving=[{ram}]"
    ).report
    assert report["outcome"] == "contact"
    assert report["metrics"]["contacts"] == 1
    assert report["metrics"]["min_clearance_m"] < 0
