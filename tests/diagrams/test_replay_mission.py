"""A LIMO in its plant replays a route by a map of tags."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from diagrams.cli import main
from diagrams.replay_log import replay_metrics
from diagrams.replay_mission import ReplayMission
from diagrams.run import Run, simulate
from diagrams.scenario import load_scenario
from systems.io.bag import BagReader
from systems.markers.layout import load_map

PROJECTED: dict[str, Any] = {"sight": "projected"}


@pytest.fixture(scope="module")
def lap(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Path]:
    out = tmp_path_factory.mktemp("lap")
    return simulate(load_scenario("replay", PROJECTED), out=out), out


def test_a_lap_is_replayed_within_a_centimetre(lap: tuple[Run, Path]) -> None:
    run, _ = lap
    metrics = run.report["metrics"]
    assert run.report["outcome"] == "replayed"
    assert run.succeeded
    assert metrics["cross_track_rmse_m"] < 0.01
    assert metrics["cross_track_max_m"] < 0.03
    assert metrics["two_tag_fraction"] >= 0.95
    assert metrics["nearest_tag_m"] > 0.35
    assert metrics["contacts"] == 0
    route = run.mission.route  # type: ignore[attr-defined]
    assert metrics["lap_time_s"] == pytest.approx(route.duration, rel=0.05)
    assert metrics["path_length_m"] == pytest.approx(route.length, rel=0.02)
    assert 0.5 < metrics["nees_mean"] < 2.0


def test_the_cross_track_error_is_the_distance_from_the_route(lap: tuple[Run, Path]) -> None:
    """Against every point of a finely sampled route."""
    run, _ = lap
    mission = run.mission
    assert isinstance(mission, ReplayMission)
    log = mission.replay_log(run.context)
    assert log.poses.truth is not None
    way = log.on_the_way()
    _, off = log.cross_track(log.poses.truth[way])
    t = np.linspace(0.0, log.route.duration, 20_000)
    dense = log.route.poses_at(t)
    for pose, told in zip(log.poses.truth[way][::50], off[::50], strict=True):
        apart = np.hypot(*(dense[:, :2] - pose[:2]).T)
        near = dense[np.argmin(apart)]
        left = math.cos(near[2]) * (pose[1] - near[1]) - math.sin(near[2]) * (pose[0] - near[0])
        assert abs(told) == pytest.approx(apart.min(), abs=1e-4)
        if apart.min() > 1e-3:
            assert np.sign(told) == np.sign(left)


def test_the_recording_tells_what_was_done(lap: tuple[Run, Path]) -> None:
    _, out = lap
    topics = BagReader(out / "bag").topics()
    for topic in ("/limo/estimate", "/limo/replay_status", "/limo/front_camera/detections", "/tf"):
        assert topic in topics
    words = [m.data for _, _, m in BagReader(out / "bag").messages(["/limo/replay_status"])]
    assert words[0] in ("waiting", "blind_ahead")
    assert "driving" in words
    assert {"summary.png", "route.json", "map.json", "truth.tum", "estimate.tum"} <= {
        path.name for path in out.iterdir()
    }


def test_a_robot_that_sees_nothing_for_a_while_slows_and_stays_on_the_route() -> None:
    blind = [{"signal": "front_camera.detections", "kind": "hidden", "start": 6.0, "duration": 3.0}]
    run = simulate(load_scenario("replay", PROJECTED | {"robot.faults": blind, "duration": 14.0}))
    metrics = run.report["metrics"]
    assert metrics["blind_s"] > 1.5
    assert metrics["lost_s"] == 0
    assert metrics["cross_track_max_m"] < 0.05


def test_a_robot_that_sees_nothing_any_more_stands_and_says_so() -> None:
    blind = [{"signal": "front_camera.detections", "kind": "hidden", "start": 3.0}]
    run = simulate(load_scenario("replay", PROJECTED | {"robot.faults": blind, "duration": 14.0}))
    assert run.report["outcome"] == "lost"
    assert not run.succeeded
    assert run.report["metrics"]["lost_s"] > 3.0
    truth = run.mission.log("truth.limo.pose", run.context)[1]
    assert np.hypot(*(truth[-1, :2] - truth[-50, :2])) < 0.01


def test_something_on_the_route_stops_the_robot_before_it_touches() -> None:
    route = json.loads(Path("diagrams/routes/circuit.json").read_text())
    k = round(4.0 / (route["t"][1] * route["v"][0]))  # 4 m along it
    box = {"position": [route["x"][k], route["y"][k]], "size": [0.2, 0.2, 0.4], "heading_deg": 0}
    run = simulate(
        load_scenario("replay", PROJECTED | {"world.arena.boxes": [box], "duration": 14.0})
    )
    assert run.report["outcome"] == "blocked"
    assert run.report["metrics"]["contacts"] == 0
    assert run.report["metrics"]["slowing_s"] > 0
    assert run.report["metrics"]["blocked_s"] > 3
    assert 0.15 < run.report["metrics"]["path_length_m"] - 2.9 < 1.0


def test_a_map_that_is_off_shows_in_the_truth_and_not_in_the_estimate(tmp_path: Path) -> None:
    """The whole map is shifted by 4 cm: the robot drives beside the route and cannot know."""
    shifted = json.loads(Path("diagrams/maps/circuit.json").read_text())
    for tag in shifted["tags"]:
        tag["pose"]["translation"]["x"] += 0.04
    (tmp_path / "map.json").write_text(json.dumps(shifted))
    changes = {"map": str(tmp_path / "map.json"), "duration": 12.0}
    run = simulate(load_scenario("replay", PROJECTED | changes))
    mission = run.mission
    assert isinstance(mission, ReplayMission)
    log = mission.replay_log(run.context)
    metrics = replay_metrics(log)
    assert log.poses.truth is not None
    late = log.poses.estimate[300:] - log.poses.truth[300:]
    assert late[:, 0].mean() == pytest.approx(0.04, abs=0.005)
    assert abs(late[:, 1].mean()) < 0.005
    assert metrics["estimate_cross_track_rmse_m"] < 0.01
    assert metrics["cross_track_max_m"] > 0.025


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("map=nowhere.json", ["map", "nowhere.json"]),
        ("route=nowhere.json", ["route", "nowhere.json"]),
        ("controller=lqr", ["controller", "lqr", "tvlqr"]),
        ("lidar=front_camera", ["lidar", "front_camera", "fit: lidar"]),
        ("encoders=imu", ["encoders", "imu", "fit: encoders"]),
        ("laps=0", ["laps", "0", "greater than 0"]),
        ("supervisor.stop_after=0.1", ["supervisor", "stop_after", "0.1"]),
        ("robot.body={type: snailbot}", ["snailbot"]),
    ],
)
def test_bad_keys_are_refused_in_one_line(
    change: str, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "replay", "--no-meshcat", "--set", change]) == 2
    message = capsys.readouterr().err.strip()
    assert "\n" not in message
    for word in words:
        assert word in message


def test_a_route_that_is_none_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "route.json").write_text('{"t": [0, 1], "x": [0, "b"]}')
    path = tmp_path / "route.json"
    assert main(["run", "replay", "--no-meshcat", "--set", f"route={path}"]) == 2
    message = capsys.readouterr().err.strip()
    assert str(path) in message
    assert "\n" not in message


def test_the_bundled_map_is_known_by_default() -> None:
    scenario = load_scenario("replay", {})
    bundled = load_map(Path("diagrams/maps/circuit.json"))
    assert set(scenario.load_map().markers) == set(bundled.markers)
