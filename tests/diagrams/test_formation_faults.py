"""Formations to which something happens: failures, hidden and misread beacons, dead motors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from diagrams.formation import FormationScenario
from diagrams.formation_faults import COMMAND, faults_of
from diagrams.formation_mission import FormationMission
from diagrams.run import Run, simulate
from diagrams.scenario import load_scenario

# One move: the first robot that goes reaches the destination.
ONE_MOVE = {
    "sight": "projected",
    "dynamics": "kinematic",
    "record.bag": False,
    "destination": [3.0, 1.3],
    "duration": 200.0,
}
SIX = ONE_MOVE | {"robots": 6}


def run(more: dict[str, Any], out: Path | None = None) -> Run:
    return simulate(load_scenario("formation", ONE_MOVE | more), out=out)


def movers(run: Run) -> list[tuple[int, bool]]:
    """Numbers of the robots that moved, and whether they got there."""
    assert isinstance(run.mission, FormationMission)
    log = run.mission.formation_log(run.context)
    return [(move.robot + 1, move.done) for move in log.moves()]


def test_when_the_mover_fails_on_its_way_another_takes_its_part() -> None:
    ended = run(SIX | {"fail_robot": 6, "fail_at": 6.0})
    assert ended.report["outcome"] == "reached"
    assert movers(ended) == [(6, False), (5, True)]
    assert ended.report["metrics"]["replans"] == 1
    assert ended.report["metrics"]["broken"] is False
    assert ended.report["metrics"]["side_error_max_m"] < 0.01
    log = ended.mission.formation_log(ended.context)  # type: ignore[attr-defined]
    stands = log.truth[log.t > 8.0, 5, :2]
    assert abs(stands - stands[0]).max() < 1e-3  # its motors are dead indeed


def test_upon_a_wreck_nobody_builds() -> None:
    ended = run(SIX | {"fail_robot": 3, "fail_at": 3.0, "fail_as": "wreck"})
    assert ended.report["outcome"] == "reached"
    log = ended.mission.formation_log(ended.context)  # type: ignore[attr-defined]
    given_up, *others = log.moves()
    assert not given_up.done
    assert all(2 not in move.beacons and move.robot != 2 for move in others)


def test_a_wreck_neither_sees_nor_is_seen() -> None:
    failing = SIX | {"fail_robot": 3, "fail_at": 3.0, "fail_as": "wreck"}
    scenario = load_scenario("formation", failing)
    assert isinstance(scenario, FormationScenario)
    own = {(fault.signal, fault.kind) for fault in faults_of(scenario, 3)}
    cameras = ("front_camera.detections", "rear_camera.detections")
    assert own == {(COMMAND, "dead"), *((camera, "silent") for camera in cameras)}
    for fault in faults_of(scenario, 1):
        assert (fault.kind, fault.ids, fault.start) == ("hidden", [8, 9, 10, 11], 3.0)


def fault(**what: Any) -> dict[str, Any]:
    return {"faults": [what]}


@pytest.mark.parametrize(
    ("controller", "ids", "error"),
    # Algorithm I needs all three beacons; resection goes on until it sees hardly any.
    [("algorithm1", [8, 9, 10, 11], 0.1), ("resection", [], 0.006)],
)
def test_a_beacon_that_somebody_hides_is_waited_for(
    controller: str, ids: list[int], error: float, tmp_path: Path
) -> None:
    hidden = {"signal": "rear_camera.detections", "kind": "hidden", "ids": ids}
    more = fault(robot=2, start=20.0, duration=45.0, **hidden)
    ended = run(more | {"controller": controller}, tmp_path)
    assert ended.report["outcome"] == "reached"
    assert ended.report["sim_seconds"] > 65.0
    metrics = ended.report["metrics"]
    assert metrics["waits"] >= 1
    assert metrics["retries"] >= 1
    assert metrics["replans"] == 0
    (move,) = json.loads((tmp_path / "moves.json").read_text())
    assert (move["waits"], move["retries"]) == (metrics["waits"], metrics["retries"])
    assert metrics["destination_error_m"] < error


def test_a_beacon_that_is_taken_for_another_is_refused() -> None:
    """Robot 3's markers are read as robot 4's by everybody for some seconds."""
    misread = {"kind": "misread", "ids": [8, 9, 10, 11], "id_offset": 4}
    signals = ("front_camera.detections", "rear_camera.detections")
    when = {"start": 38.0, "duration": 5.0}
    faults = [{"robot": 0, "signal": s} | when | misread for s in signals]
    ended = run({"faults": faults})
    assert ended.report["outcome"] == "reached"
    assert ended.report["health"]["controller_2"]["misread"] > 10
    assert ended.report["metrics"]["destination_error_m"] < 0.006


def test_a_robot_that_stops_for_a_time_tries_again() -> None:
    ended = run(fault(robot=2, signal=COMMAND, kind="dead", start=10.0, duration=15.0))
    assert ended.report["outcome"] == "reached"
    metrics = ended.report["metrics"]
    assert metrics["waits"] >= 1
    assert metrics["retries"] >= 1
    assert metrics["replans"] == 0
    assert metrics["destination_error_m"] < 0.006


def test_one_that_stops_for_too_long_is_given_up_and_something_else_is_planned() -> None:
    turns = {"turns.patience": 10.0, "turns.pace": 0.1}
    dead = fault(robot=6, signal=COMMAND, kind="dead", start=3.0)
    ended = run(SIX | turns | dead | {"duration": 400.0})
    metrics = ended.report["metrics"]
    assert metrics["replans"] >= 1
    assert movers(ended)[0] == (6, False)
    assert movers(ended)[-1] == (5, True)
    assert ended.report["outcome"] == "reached"


def test_the_planner_says_broken_when_the_formation_is() -> None:
    """A controller that takes another angle for the vertex builds a triangle far too long."""
    sizes = ("robot.body.ring.size", "step.marker_size", "estimator.marker_size")
    wrong = {"controller": {"type": "algorithm1", "dt": 150.0}}
    ended = run(wrong | dict.fromkeys(sizes, 0.15))
    assert ended.report["outcome"] == "broken"
    assert not ended.succeeded
    assert ended.report["metrics"]["broken"] is True


def test_who_is_not_found_after_its_move_is_noticed_before_the_next() -> None:
    """Nobody sees robot 6, nor does it see anybody, from the end of its move on."""
    more = SIX | {"destination": [3.75, 0.0], "duration": 300.0}
    ids = [20, 21, 22, 23]
    cameras = ("front_camera.detections", "rear_camera.detections")
    faults = [
        {"robot": k, "signal": camera, "kind": "hidden", "start": 47.0, "duration": 60.0}
        | ({"ids": ids} if k != 6 else {})
        for k in range(1, 7)
        for camera in cameras
    ]
    ended = run(more | {"faults": faults})
    assert ended.report["health"]["planner"]["unplaced"] == 1
    assert ended.report["outcome"] == "reached"
