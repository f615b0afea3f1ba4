"""Bad samples on purpose, in the whole robot: it stays safe, goes on, and the report shows them."""

from __future__ import annotations

from typing import Any

import pytest

from diagrams.run import simulate
from diagrams.scenario import load_scenario
from diagrams.schema import ScenarioError

LASTED = 3.0  # s


def report(*overrides: str, name: str = "navigation") -> dict[str, Any]:
    """Report of the robot's first half minute, in which it passes two waypoints and a cylinder."""
    scenario = load_scenario(name, ["sight=projected", "duration=18", *overrides])
    return dict(simulate(scenario).report)


def failing(signal: str, kind: str) -> dict[str, Any]:
    return report(
        f"robot.faults=[{{signal: {signal}, kind: {kind}, start: 5.0, duration: {LASTED}}}]"
    )


# Which counts tell of it, and how often at least: by sample, by scan, by picture with markers.
@pytest.mark.parametrize(
    ("signal", "kind", "counts"),
    [
        ("imu.sample", "nan", {("estimator", "bad_imu"): 100 * LASTED}),
        ("imu.sample", "garbled", {("estimator", "bad_imu"): 50 * LASTED}),
        ("lidar.scan", "garbled", {(b, "garbled_scan"): 4 * LASTED for b in ("monitor", "mapper")}),
        ("lidar.scan", "nan", {(b, "garbled_scan"): 4 * LASTED for b in ("monitor", "avoider")}),
        ("lidar.scan", "silent", {(b, "stale_scan"): LASTED for b in ("monitor", "avoider")}),
        ("front_camera.detections", "frozen", {("estimator", "gated"): 5 * LASTED}),
        ("front_camera.detections", "unknown_ids", {("localizer", "unknown_id"): 15 * LASTED}),
        ("front_camera.detections", "nan", {("localizer", "bad_corners"): 15 * LASTED}),
    ],
)
def test_the_robot_stays_safe_and_says_what_it_dropped(
    signal: str, kind: str, counts: dict[tuple[str, str], float]
) -> None:
    found = failing(signal, kind)
    metrics = found["metrics"]
    assert metrics["contacts"] == 0
    assert metrics["min_clearance_m"] > 0.05
    assert metrics["waypoints_reached"] >= 1
    assert metrics["position_rmse_m"] < 0.05
    for (block, reason), least in counts.items():
        assert found["health"][block][reason] >= least


def test_a_marker_that_was_moved_by_half_a_metre_is_seen_through() -> None:
    found = report("world.moved_markers=[{id: 3, by: [0.35, 0.35, 0.0]}]")
    assert found["health"]["localizer"]["outlier"] > 5  # beside others
    assert found["metrics"]["position_rmse_m"] < 0.01
    assert found["metrics"]["contacts"] == 0


def test_the_detector_looks_at_the_pictures_that_fail() -> None:
    fault = "robot.faults=[{signal: front_camera.image, kind: garbled, start: 0.5}]"
    found = simulate(
        load_scenario("navigation_open", ["duration=1.5", fault, "sight=rendered"])
    ).report
    # Seven pictures before, of which one or two are on their way.
    assert 4 <= found["health"]["estimator"]["accepted"] <= 8


@pytest.mark.parametrize(
    ("faults", "words"),
    [
        ("{signal: imu.sampel, kind: nan}", "no signal robot.imu.sampel; did you mean 'robot.imu."),
        ("{signal: imu.sample, kind: silent}", "must be frozen or nan or garbled"),
        ("{signal: front_camera.image, kind: frozen}", "let robot.front_camera.detections fail"),
        ("{signal: imu.sample, kind: broken}", r"robot.faults\[0\].kind is 'broken'"),
        ("{signal: imu.sample, kind: nan, start: -1}", "start is -1"),
    ],
)
def test_faults_that_make_no_sense_are_refused(faults: str, words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        report(f"robot.faults=[{faults}]", "duration=0.1")


def test_markers_that_are_not_there_cannot_be_moved() -> None:
    with pytest.raises(ScenarioError, match="moved_markers: 99 is not in the map; known: 0, 1"):
        report("world.moved_markers=[{id: 99, by: [0.1, 0, 0]}]")
