"""Teaching, optimisation and replay in one run."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from diagrams.cli import main
from diagrams.run import Run, simulate
from diagrams.scenario import load_scenario
from diagrams.teach_replay import TeachReplayScenario
from diagrams.teach_replay_mission import TeachReplayMission, path_errors, tag_errors
from systems.markers.layout import load_map
from systems.planners.route import load_route


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Path]:
    out = tmp_path_factory.mktemp("teach_replay")
    return simulate(load_scenario("teach_replay", {"sight": "projected"}), out=out), out


def test_what_was_taught_is_replayed(done: tuple[Run, Path]) -> None:
    run, _ = done
    metrics = run.report["metrics"]
    assert run.report["outcome"] == "replayed"
    assert run.succeeded
    assert metrics["optimised_tag_error_mean_m"] < 0.02
    assert metrics["optimised_tag_error_max_m"] < 0.04
    assert metrics["trajectory_error_mean_m"] < 0.02
    assert 5 * metrics["optimised_tag_error_mean_m"] < metrics["gated_tag_error_mean_m"]
    assert metrics["gated_tag_error_mean_m"] < metrics["naive_tag_error_mean_m"]
    assert 0.8 < metrics["chi2_per_dof"] < 1.2
    assert metrics["cross_track_rmse_m"] < 0.02
    assert metrics["two_tag_fraction"] >= 0.95
    assert metrics["nearest_tag_m"] > 0.35
    assert metrics["lap_time_s"] == pytest.approx(metrics["planned_lap_time_s"], rel=0.05)


def test_the_errors_are_those_of_the_files(done: tuple[Run, Path]) -> None:
    run, out = done
    found, true = load_map(out / "map" / "map.json"), load_map(Path("diagrams/maps/circuit.json"))
    apart = {
        tag.id: np.linalg.norm(tag.X_WM.translation() - true.markers[tag.id].X_WM.translation())
        for tag in found
    }
    assert apart[0] < 1e-9  # the anchor
    errors = [error for tag, error in apart.items() if tag != 0]
    assert run.report["metrics"]["optimised_tag_error_mean_m"] == pytest.approx(np.mean(errors))
    # The trajectory against the truth that the teaching run has written.
    path = np.loadtxt(out / "map" / "trajectory.tum")
    truth = np.loadtxt(out / "teach" / "truth.tum")
    x, y = (np.interp(path[:, 0], truth[:, 0], truth[:, k]) for k in (1, 2))
    mean = np.hypot(path[:, 1] - x, path[:, 2] - y).mean()
    assert run.report["metrics"]["trajectory_error_mean_m"] == pytest.approx(mean, rel=1e-3)


def test_the_route_is_kept_and_can_be_replayed_again(done: tuple[Run, Path]) -> None:
    _, out = done
    assert load_route(out / "route.json").closed
    again = simulate(
        load_scenario(
            "replay",
            {
                "sight": "projected",
                "map": str(out / "map" / "map.json"),
                "route": str(out / "map" / "route.json"),
                "duration": 8.0,
            },
        )
    )
    assert again.report["metrics"]["cross_track_rmse_m"] < 0.02
    assert again.report["metrics"]["path_length_m"] > 2.0


def test_what_went_wrong_before_the_replay_is_the_outcome(
    done: tuple[Run, Path], tmp_path: Path
) -> None:
    run, _ = done
    mission = run.mission
    assert isinstance(mission, TeachReplayMission)
    taught = mission._taught
    assert taught is not None
    assert len(tag_errors(taught)) == 23
    assert len(path_errors(taught)) > 500
    scenario = load_scenario("teach_replay", {"sight": "projected"})
    assert isinstance(scenario, TeachReplayScenario)
    failed = copy.copy(scenario)
    failed._taught = replace(taught, failure="no_route", plan=None)
    failed.prepared = lambda **_: failed  # type: ignore[method-assign]
    after = simulate(failed, out=tmp_path)
    assert after.report["outcome"] == "no_route"
    assert not after.succeeded
    assert after.report["metrics"]["cross_track_rmse_m"] is None
    assert after.report["metrics"]["optimised_tag_error_mean_m"] is not None
    assert (tmp_path / "summary.png").is_file()


def test_teaching_that_does_not_end_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    arguments = ["run", "teach_replay", "--no-meshcat", "--set", "sight=projected"]
    assert main([*arguments, "--duration", "3", "--out", str(tmp_path)]) == 1
    assert "timeout" in capsys.readouterr().out
    assert "teaching: timeout" in caplog.text
    assert json.loads((tmp_path / "report.json").read_text())["outcome"] == "timeout"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("limits.max_speed=-1", ["limits", "max_speed", "-1"]),
        ("lidar=eye", ["lidar", "eye", "fit: lidar"]),
        ("world.moved_markers=[{id: 3, by: [0.1, 0, 0]}]", ["moved_markers"]),
        ("anchor=77", ["anchor", "77"]),
    ],
)
def test_bad_keys_are_refused_in_one_line(
    change: str, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "teach_replay", "--no-meshcat", "--set", change]) == 2
    message = capsys.readouterr().err.strip()
    assert "\n" not in message
    for word in words:
        assert word in message


def test_without_teaching_the_diagram_has_the_track_itself() -> None:
    scenario = load_scenario("teach_replay", {"sight": "projected"})
    mission = scenario.build()
    assert isinstance(mission, TeachReplayMission)
    route = np.array(scenario.route)
    for x, y in route:
        assert mission.route.closest(np.array([x, y])).distance < 0.01
