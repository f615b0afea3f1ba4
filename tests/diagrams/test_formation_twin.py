"""The formation on kinematic twins, its recording, and the recording played back."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.systems.primitives import Adder, DiscreteTimeDelay, ZeroOrderHold

from diagrams.formation_recording import look_rate, part_of
from diagrams.run import Run, simulate
from diagrams.scenario import load_scenario
from systems.io.bag import BagReader
from systems.io.ros_motion import planar_estimate_from_ros

TWIN = {"sight": "projected", "dynamics": "kinematic", "destination": [3.0, 1.3], "seed": 4}
PLANT = TWIN | {"dynamics": "multibody"}


@dataclass(frozen=True)
class Recorded:
    """A run on the twins, and where its results are."""

    run: Run
    folder: Path


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """One move, recorded."""
    folder = tmp_path_factory.mktemp("twin")
    return Recorded(simulate(load_scenario("formation", TWIN), out=folder), folder)


def log(run: Run) -> Any:
    return run.mission.formation_log(run.context)  # type: ignore[attr-defined]


def lines(folder: Path, name: str) -> list[str]:
    return (folder / name).read_text().splitlines()


def test_twins_reach_the_destination(twin: Recorded) -> None:
    report = twin.run.report
    assert report["outcome"] == "reached"
    assert report["metrics"]["moves"] == 1
    assert report["metrics"]["broken"] is False
    assert report["metrics"]["destination_error_m"] < 0.006


def test_twins_and_plant_agree(twin: Recorded) -> None:
    """Seen and steered alike: the same noise, and a plant that follows its kinematics to 0.1 %.

    On its way of 4 m the robot is within 15 mm of where its twin was at that time, and at its
    vertex within 4 mm; the others stand within 1 mm of theirs.
    """
    plant = simulate(load_scenario("formation", PLANT | {"record.bag": False}))
    a, b = log(twin.run), log(plant)
    (here,), (there,) = a.moves(), b.moves()
    assert here.robot == there.robot
    assert abs(here.t - there.t) <= 1.0
    np.testing.assert_allclose(here.place, there.place, atol=0.004)
    n = int(np.searchsorted(a.t, min(here.t, there.t)))
    off = np.linalg.norm(a.truth[:n, :, :2] - b.truth[:n, :, :2], axis=2)
    assert 0 < off[:, here.robot].max() < 0.015
    assert np.delete(off, here.robot, axis=1).max() < 0.001
    driven = np.linalg.norm(np.diff(a.truth[:, here.robot, :2], axis=0), axis=1).sum()
    assert driven > 3.0


def test_a_run_that_is_not_recorded_is_the_same(twin: Recorded) -> None:
    bare = simulate(load_scenario("formation", TWIN | {"record.bag": False}))
    assert bare.report["metrics"] == twin.run.report["metrics"]
    assert bare.report["health"] == twin.run.report["health"]


def test_the_recording_says_where_the_robots_were_believed_to_be(twin: Recorded) -> None:
    truth = log(twin.run).truth
    bag = BagReader(twin.folder / "bag")
    for k in range(4):
        *_, (_, t, message) = bag.messages([f"/robot{k + 1}/estimate"])
        pose, covariance = planar_estimate_from_ros(message)
        assert message.header.frame_id == "map"
        assert t == pytest.approx(twin.run.context.get_time(), abs=1.1)
        np.testing.assert_allclose(pose[:2], truth[-1, k, :2], atol=0.006)
        assert 1e-4 < np.sqrt(covariance[0, 0]) < 0.02
    *_, (_, _, tf) = bag.messages(["/tf"])
    frames = [transform.child_frame_id for transform in tf.transforms]
    assert frames == [f"robot{k}/base_link" for k in (1, 2, 3, 4)]
    placed = tf.transforms[1].transform.translation
    np.testing.assert_allclose([placed.x, placed.y], truth[-1, 1, :2], atol=0.006)


def test_who_stands_takes_no_room_in_the_recording(twin: Recorded) -> None:
    seconds = twin.run.context.get_time()
    bag = BagReader(twin.folder / "bag")
    count = {k: len(list(bag.messages([f"/truth/robot{k}/pose"]))) for k in (1, 2)}
    assert seconds - 2 < count[1] < seconds + 2  # once a second
    assert count[2] > 8 * seconds  # on its way, at the rate of the controllers, 10 Hz


def test_played_back_the_estimates_and_the_moves_are_the_same(
    twin: Recorded, tagtrail: Callable[..., Any], tmp_path: Path
) -> None:
    arguments = ["--set", "destination=[3.0, 1.3]", "--no-meshcat", "--out", tmp_path]
    result = tagtrail("run", "formation", "--play", twin.folder / "bag", *arguments)
    assert result.err == ""
    for k in (1, 2, 3, 4):
        before, after = (lines(f, f"estimate_robot{k}.tum") for f in (twin.folder, tmp_path))
        assert len(before) - 6 <= len(after) <= len(before)
        assert after == before[: len(after)]
    moves = [json.loads((folder / "moves.json").read_text()) for folder in (twin.folder, tmp_path)]
    assert len(moves[1]) == 1
    for key in ("number", "t", "robot", "beacons", "target"):
        assert moves[1][0][key] == moves[0][0][key], key
    np.testing.assert_allclose(moves[1][0]["place"], moves[0][0]["place"], atol=1e-6)


def test_played_back_another_estimator_says_otherwise(
    twin: Recorded, tagtrail: Callable[..., Any], tmp_path: Path
) -> None:
    arguments = ["--set", "estimator.use_range=false", "--no-meshcat", "--out", tmp_path]
    result = tagtrail(
        "run", "formation", "--play", twin.folder / "bag", "--duration", "20", *arguments
    )
    assert result.err == ""
    name = "estimate_robot2.tum"
    assert lines(tmp_path, name)[-1] != lines(twin.folder, name)[len(lines(tmp_path, name)) - 1]


def test_a_part_of_the_joint_estimate() -> None:
    poses, covariance = np.arange(12.0), np.arange(100.0, 244.0)
    part = part_of(2, 4) @ np.concatenate([poses, covariance])
    np.testing.assert_array_equal(part[:3], [6, 7, 8])
    np.testing.assert_array_equal(part[3:].reshape(3, 3), covariance.reshape(12, 12)[6:9, 6:9])


@pytest.mark.parametrize(
    ("rates", "common"),
    [((20.0, 10.0), 20.0), ((25.0, 10.0), 50.0), ((10.0,), 10.0), ((7.5, 10.0), 30.0),
     ((), 200.0), ((33.3, 20.0), 200.0)],
)  # fmt: skip
def test_a_recorder_looks_whenever_a_block_does(rates: tuple[float, ...], common: float) -> None:
    blocks = [DiscreteTimeDelay(1 / rate, 1, 1) for rate in rates]
    assert look_rate(blocks) == pytest.approx(common)


def test_a_block_that_looks_at_no_time_does_not_count() -> None:
    assert look_rate([Adder(2, 1), ZeroOrderHold(0.1, 1)]) == pytest.approx(10.0)
