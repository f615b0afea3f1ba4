"""The formation, wired: a few moves in the plant, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from diagrams.formation_metrics import FormationLog, formation_metrics
from diagrams.run import Run, simulate
from diagrams.scenario import load_scenario
from systems.formation.triangles import next_vertex
from systems.planners.formation_lattice import strip

# What robots with errors do is in `test_formation_errors`.
PROJECTED = {"sight": "projected", "record.bag": False, "errors": "none"}


@pytest.fixture(scope="module")
def one_move() -> Run:
    """A destination that the first robot reaches."""
    return simulate(load_scenario("formation", PROJECTED | {"destination": [3.0, 1.3]}))


def test_the_robot_farthest_away_builds_the_next_triangle(one_move: Run) -> None:
    assert one_move.report["outcome"] == "reached"
    log = one_move.mission.formation_log(one_move.context)  # type: ignore[attr-defined]
    (move,) = log.moves()
    assert move.robot == 1  # from (0, 1.3)
    np.testing.assert_allclose(move.target, [3.0, 1.299], atol=1e-3)
    np.testing.assert_allclose(move.place, move.target, atol=0.006)
    np.testing.assert_allclose(move.sides, [1.5, 1.5], atol=0.006)


def test_the_others_stand_meanwhile(one_move: Run) -> None:
    log = one_move.mission.formation_log(one_move.context)  # type: ignore[attr-defined]
    standing = np.delete(log.truth, 1, axis=1)[:, :, :2]
    assert np.abs(standing - strip(4, 1.5)[[0, 2, 3]]).max() < 1e-3


def test_the_metrics_are_those_of_the_truth(one_move: Run) -> None:
    metrics = one_move.report["metrics"]
    assert metrics["moves"] == 1
    assert metrics["broken"] is False
    assert metrics["destination_error_m"] < 0.006
    assert metrics["side_error_max_m"] < 0.006
    assert 0.0 < metrics["nees_mean"] < 3.0


def test_only_the_cameras_in_use_take_pictures() -> None:
    """While robot 2 moves it looks ahead, and only now and then back, where nobody is.

    The cameras of robot 3 rest since the start.
    """
    scenario = load_scenario("formation", PROJECTED | {"duration": 10.0})
    run = simulate(scenario)
    station = run.mission.station
    context = station.GetMyContextFromRoot(run.context)
    stamps = [
        station.GetOutputPort(f"{camera}.detections").Eval(context).stamp
        for camera in ("robot2.front_camera", "robot2.rear_camera", "robot3.front_camera")
    ]
    assert stamps[0] > 9.8
    assert 9.3 < stamps[1] < stamps[0]
    assert stamps[2] < 2.0


def test_the_papers_way_arrives_less_exactly() -> None:
    """Algorithm I without an estimator: no depth, no correction."""
    paper = {"controller": "algorithm1", "estimator": "none", "planner": "closest"}
    run = simulate(load_scenario("formation", PROJECTED | paper | {"destination": [3.0, 1.3]}))
    assert run.report["outcome"] == "reached"
    assert 0.002 < run.report["metrics"]["destination_error_m"] < 0.08


def test_of_four_robots_none_may_fail() -> None:
    run = simulate(load_scenario("formation", PROJECTED | {"fail_robot": 2, "fail_at": 5.0}))
    assert run.report["outcome"] == "too_few_robots"
    assert not run.succeeded


def log_of(errors: Any) -> FormationLog:
    """One move of robot 1 that ends with its place off by `errors` from its vertex."""
    truth = np.zeros((3, 4, 3))
    truth[:, :, :2] = strip(4, 1.5)
    vertex = next_vertex(truth[0, [2, 3, 0], :2])
    truth[1:, 1, :2] = vertex + np.asarray(errors)
    record = np.zeros((3, 10))
    record[1:] = [1, 1, 2, 3, 0, *vertex, 1, 2, 1]
    return FormationLog(np.arange(3.0), record, truth, truth[:, :, :2], None, None)


def test_errors_are_split_along_and_across_the_way_from_the_anchor() -> None:
    log = log_of([0.0, 0.0])
    move = log.moves()[0]
    away = (move.vertex - log.truth[0, 0, :2]) / np.linalg.norm(move.vertex - log.truth[0, 0, :2])  # type: ignore[index]
    metrics = formation_metrics(log_of(0.03 * away), 1.5)
    assert metrics["longitudinal_error_mm"] == pytest.approx(30.0)
    assert metrics["lateral_error_mm"] == pytest.approx(0.0, abs=1e-9)
    assert metrics["destination_error_m"] == pytest.approx(0.03)
    assert metrics["broken"] is False
    assert (metrics["waits"], metrics["retries"], metrics["replans"]) == (2, 1, 0)


def test_a_side_far_too_long_breaks_the_formation() -> None:
    assert formation_metrics(log_of([1.5, 0.9]), 1.5)["broken"] is True


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("robots=3", "robots is 3: must be at least 4"),
        ("start=[[0,0],[1,0],[2,0],[3,0]]", "start is [[0.0, 0.0], [1.0, 0.0]"),
        ("start=[[0,0],[1.5,0]]", "start is [[0.0, 0.0], [1.5, 0.0]]: must be places of all 4"),
        ("world.arena.boxes=[{position: [9.7, 0.6], size: [1, 1, 1]}]", "destination"),
        ("step.side=2", "step.side is 2.0: must be 1.5, as formation.side is"),
        ("fail_robot=9", "fail_robot is 9: must be one of 1 to 4"),
        ("robot.body.ring=null", "robot.body.ring is None: must be markers for the others to see"),
        ("controller.side=3", "controller.side: unknown key"),
        ("planner=best", "planner is 'best': must be one of closest, astar"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_in_one_line(
    tagtrail: Callable[..., Any], override: str, message: str, tmp_path: Any
) -> None:
    result = tagtrail("run", "formation", "--no-meshcat", "--set", override, "--out", tmp_path)
    assert result.status == 2
    assert message in result.err
    assert len(result.err.strip().splitlines()) == 1
