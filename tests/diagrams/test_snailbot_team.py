"""Shells that move: a robot on the back of another, and on a reference robot that is driven."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

import diagrams.shell_robot
from diagrams.run import Run
from systems.estimators.reference_motion import KnownShellMotion
from systems.shell.angles import rotation_vector
from tests.diagrams.snailbot_runs import CLIMB, errors, log_of, run

AXES = ("roll", "pitch", "yaw")
PERIOD = 8.0  # s, in which the reference robot turns to and fro


# --- One on the back of the other ---


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Both drive over their second markers; with all results."""
    path = tmp_path_factory.mktemp("chain")
    finished = run(
        "team.0.speed=0.03",
        "errors={mounting_deg: 1, gyro_bias_deg_s: 0.3, flow_scale: 0.02, rock_deg: 0.3, "
        "placement_deg: 0.5}",
        "duration=2.4",
        name="snailbot_chain", out=path,
    )  # fmt: skip
    return SimpleNamespace(run=finished, path=path, metrics=finished.report["metrics"])


def pose_in(finished: Run, parent: str, child: str) -> RigidTransform:
    """Where SceneGraph has one robot's base_link, or a shell, in the frame of a shell."""
    station: Any = finished.mission.station
    query = station.GetOutputPort("scene.query_object").Eval(
        station.GetMyContextFromRoot(finished.context)
    )
    robot = station.robots.get(child)
    frame = robot.frame_id if robot is not None else station.shells[child.removesuffix("'s")]
    X_WP = query.GetPoseInWorld(station.shells[parent].frame_id)
    return X_WP.inverse() @ query.GetPoseInWorld(getattr(frame, "frame_id", frame))


def test_each_of_a_team_knows_where_it_is_on_its_carrier(chain: Any) -> None:
    for k, prefix in enumerate(("", "robot_2_")):
        for axis in AXES:
            assert chain.metrics[f"{prefix}{axis}_rmse_deg"] < 1.2
        assert 0.01 < chain.metrics[f"{prefix}nees_mean"] < 4.0
        assert chain.metrics[f"{prefix}position_rmse_m"] < 0.002
        assert chain.metrics[f"{prefix}min_adhesion_margin"] > 1
        log = log_of(chain.run, k)
        told = pose_in(chain.run, ("reference", "robot")[k], ("robot", "robot_2")[k])
        np.testing.assert_allclose(log.p[-1], told.translation(), atol=1e-9)
        np.testing.assert_allclose(log.R[-1], told.rotation().matrix(), atol=1e-9)
    # The carrier does not rock: what it carries would.
    first = log_of(chain.run)
    normal = first.p / np.linalg.norm(first.p, axis=1, keepdims=True)
    assert np.degrees(np.linalg.norm(np.cross(first.R[:, :, 2], normal), axis=1)).max() < 0.6


def test_the_last_ones_pose_on_the_first_is_the_composed_one(chain: Any) -> None:
    log = chain.run.mission.chain_log(chain.run.context)
    X_RB = pose_in(chain.run, "reference", "robot_2")  # by the scene, not by a composition
    np.testing.assert_allclose(log.p[-1], X_RB.translation(), atol=1e-6)
    turn = rotation_vector(log.R[-1] @ X_RB.rotation().matrix().T)
    assert np.degrees(np.linalg.norm(turn)) < 1e-3
    assert np.linalg.norm(log.p[-1]) > 0.2  # beside both shells
    for axis in AXES:
        assert chain.metrics[f"chain_{axis}_rmse_deg"] < 1.7
    # 0.5 degrees of the first turn the second by 1.5 mm.
    assert chain.metrics["chain_position_rmse_m"] < 0.005
    assert 0.01 < chain.metrics["chain_nees_mean"] < 4.0


def test_the_chain_is_less_sure_than_either(chain: Any) -> None:
    log = chain.run.mission.chain_log(chain.run.context)
    parts = [log_of(chain.run, k) for k in (0, 1)]
    traces = [np.trace(part.covariance[-1, :3, :3]) for part in (*parts, log)]
    # Independent rotations add, whatever frame they are told in.
    assert traces[2] == pytest.approx(traces[0] + traces[1], rel=1e-3)
    least = np.linalg.eigvalsh(log.covariance[log.scored()]).min()
    assert least > -1e-15
    # The lever arm: it knows its place worse than on the second's shell.
    assert np.trace(log.covariance[-1, 3:, 3:]) > np.trace(parts[1].covariance[-1, 3:, 3:])


def test_a_teams_results_bear_names_and_make_way_for_one_robots(
    chain: Any, tagtrail: Callable[..., Any]
) -> None:
    for name in ("summary.png", "estimate.tum", "truth.tum", "table1.json", "table1.png"):
        stem, _, suffix = name.partition(".")
        assert (chain.path / name).is_file()
        assert (chain.path / f"{stem}_robot_2.{suffix}").is_file()
    learned = json.loads((chain.path / "calibration.json").read_text())
    assert list(learned) == ["robot", "robot_2"]
    assert learned["robot"]["mounting_deg"]["truth"] != learned["robot_2"]["mounting_deg"]["truth"]
    (chain.path / "notes_robot_2.txt").write_text("the user's own")
    again = tagtrail(
        "run", "snailbot", "--no-meshcat", "--set", "sight=projected", "--set", CLIMB,
        "--duration", "0.1", "--out", chain.path,
    )  # fmt: skip
    assert again.status == 1, again.err
    left = {path.name for path in chain.path.glob("*robot_2*")}
    assert left == {"notes_robot_2.txt"}
    assert list(json.loads((chain.path / "calibration.json").read_text())) == ["robot"]


# --- A reference robot that moves ---


class Backward(KnownShellMotion):
    """Tells the opposite of how the shell moves."""

    def _calc_velocity(self, context: Context, output: Any) -> None:
        super()._calc_velocity(context, output)
        output.SetFromVector(-output.CopyToVector())


class Still(KnownShellMotion):
    """Says that the shell stands: what a filter believes that is not told of it."""

    def _calc_velocity(self, context: Context, output: Any) -> None:
        del context
        output.SetFromVector(np.zeros(6))


def on_a_moving_one(motion: type[KnownShellMotion], monkeypatch: pytest.MonkeyPatch) -> Run:
    """Two markers' worth of a drive with perfect sensors: what is left is what is told wrongly."""
    monkeypatch.setattr(diagrams.shell_robot, "KnownShellMotion", motion)
    quick = f"world.motion.rotation_period={PERIOD}"
    return run("errors=none", quick, "duration=2.0", name="snailbot_moving_reference")


def bias(finished: Run) -> float:
    """Size of the gyro's bias that was learned, deg/s; there is none but drift."""
    mission: Any = finished.mission
    learned = mission.robots[0].value("estimator.calibration", finished.context)[:3]
    return float(np.degrees(np.linalg.norm(learned)))


@pytest.fixture(scope="module")
def told() -> Run:
    with pytest.MonkeyPatch.context() as monkeypatch:
        return on_a_moving_one(KnownShellMotion, monkeypatch)


def test_on_a_moving_robot_it_knows_where_it_is(told: Run) -> None:
    settled = errors(log_of(told))[10:]
    assert settled.max() < 0.6
    assert bias(told) < 0.4
    assert told.report["health"]["estimator"]["bad_reference"] == 0
    assert told.report["metrics"]["nees_mean"] < 2.0
    # The shell did move: by half of its yaw of 1 radian, and more.
    station = told.mission.station
    X_WR = station.GetOutputPort("reference.pose").Eval(station.GetMyContextFromRoot(told.context))
    assert np.linalg.norm(rotation_vector(X_WR.rotation().matrix())) > 0.5


@pytest.mark.parametrize("wrong", [Still, Backward])
def test_not_told_how_the_shell_moves_it_blames_its_gyro(
    told: Run, wrong: type[KnownShellMotion], monkeypatch: pytest.MonkeyPatch
) -> None:
    other = on_a_moving_one(wrong, monkeypatch)
    assert bias(other) > 10 * bias(told)
    settled, confused = (errors(log_of(each))[10:] for each in (told, other))
    assert confused.max() > 10 * settled.max()


def test_the_known_motion_is_that_of_the_shell_in_its_own_frame(told: Run) -> None:
    # By hand, of yaw, pitch and roll that swing as a (1 - cos(2 pi t / T)) / 2.
    phase = 2 * np.pi * told.context.get_time() / PERIOD
    yaw, pitch, roll = np.array([1.0, 0.3, 0.2])[:, None] * [
        (1 - np.cos(phase)) / 2,
        np.pi / PERIOD * np.sin(phase),
    ]
    (_, d_yaw), (p, d_pitch), (r, d_roll) = yaw, pitch, roll
    rate = [
        d_roll - d_yaw * np.sin(p),
        d_pitch * np.cos(r) + d_yaw * np.sin(r) * np.cos(p),
        -d_pitch * np.sin(r) + d_yaw * np.cos(r) * np.cos(p),
    ]
    mission: Any = told.mission
    velocity = mission.robots[0].value("shell_motion.reference_velocity", told.context)
    np.testing.assert_allclose(velocity[:3], rate, atol=1e-9)
    assert np.linalg.norm(rate) > 0.3


@pytest.mark.parametrize("name", ["snailbot_chain", "snailbot_moving_reference"])
def test_a_recording_is_played_in_meshcat_with_the_same_estimates(
    name: str, tagtrail: Callable[..., Any], tmp_path: Path
) -> None:
    """On the shell of a robot that moves, too: its motion is known, and shown."""
    short = ("--set", "sight=projected", "--set", "duration=0.5")
    made = tagtrail("run", name, *short, "--no-meshcat", "--out", tmp_path / "a")
    assert made.status == 1  # the time was up
    played = tagtrail("run", name, *short, "--play", tmp_path / "a/bag", "--out", tmp_path / "b")
    assert played.err == "" or "Meshcat" in played.err
    assert (tmp_path / "b/replay.html").is_file()
    for path in (tmp_path / "a").glob("estimate*.tum"):
        before, after = (np.loadtxt(folder / path.name) for folder in (path.parent, tmp_path / "b"))
        n = min(len(before), len(after))
        assert n > 20
        np.testing.assert_array_equal(before[:n], after[:n])
