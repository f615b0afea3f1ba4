from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from diagrams.cli import main
from diagrams.route import Mounting, limits_from, planar_poses
from diagrams.trajectories import read_tum, write_poses, write_tum
from systems.angles import spatial_pose
from systems.planners.route import load_route
from tests.replay_world import CAMERA, X_BC, circuit

WORLD = circuit(3)


def drive() -> tuple[np.ndarray, np.ndarray]:
    """Once around and a bit more, a little unsteady."""
    route = WORLD.route
    poses = np.column_stack([route.x, route.y, route.theta])
    poses = np.vstack([poses, poses[:30]])
    poses[:, :2] += np.random.default_rng(0).normal(0, 0.002, (len(poses), 2))
    return 0.05 * np.arange(len(poses)), poses


def camera_poses(poses: np.ndarray) -> np.ndarray:
    rows = []
    for pose in poses:
        X_WC = spatial_pose(pose) @ X_BC
        rows.append([*X_WC.rotation().ToQuaternion().wxyz(), *X_WC.translation()])
    return np.array(rows)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    t, poses = drive()
    WORLD.tags.save(tmp_path / "map.json")
    write_tum(tmp_path / "base.tum", t, poses)
    write_poses(tmp_path / "camera.tum", t, camera_poses(poses))
    return tmp_path


def run(folder: Path, *more: str, trajectory: str = "base.tum", tags: str = "map.json") -> int:
    return main(
        ["route", str(folder / tags), str(folder / trajectory), "--out",
         str(folder / "made" / "route.json"), *more]
    )  # fmt: skip


def test_a_route_a_report_and_a_figure_are_written(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(folder, "--set", "max_speed=0.4", "--camera-ahead", "0.1") == 0
    route = load_route(folder / "made" / "route.json")
    assert route.closed
    assert route.limits["max_speed"] == 0.4
    assert route.v.max() <= 0.4 + 1e-9
    report = json.loads((folder / "made" / "route_report.json").read_text())
    assert report["metrics"]["lap_time_s"] == pytest.approx(route.duration)
    assert report["metrics"]["length_m"] == pytest.approx(route.length)
    assert report["metrics"]["two_tag_fraction"] >= 0.95
    assert report["binds"]["speed"] > 0.5
    picture = cv2.imread(str(folder / "made" / "route.png"))
    assert min(picture.shape[:2]) > 500
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100
    printed = capsys.readouterr().out
    assert f"{route.duration:.4g}" in printed
    assert "speed binds" in printed


def test_the_cameras_trajectory_gives_the_robots_route(folder: Path) -> None:
    made = folder / "made" / "route.json"
    assert run(folder, "--camera-ahead", "0.1") == 0
    base = load_route(made)
    assert run(folder, "--camera-ahead", "0.1", trajectory="camera.tum") == 0
    camera = load_route(made)
    assert camera.duration == pytest.approx(base.duration, abs=1e-3)
    times = np.linspace(0, 20, 50)
    np.testing.assert_allclose(camera.poses_at(times), base.poses_at(times), atol=2e-3)


def test_the_camera_of_the_maps_folder_is_taken(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    CAMERA.save(folder / "other.yaml")
    usual = (folder / "other.yaml").read_text()
    assert run(folder, "--camera", str(folder / "other.yaml")) == 0
    # One that sees next to nothing.
    (folder / "camera.yaml").write_text(
        "width: 64\nheight: 48\nK: [2000, 0, 31.5, 0, 2000, 23.5, 0, 0, 1]\nD: [0, 0, 0, 0, 0]\n"
    )
    assert run(folder) == 2
    assert "min_tags cannot be kept" in capsys.readouterr().err
    (folder / "camera.yaml").write_text(usual)
    assert run(folder) == 0


def test_a_route_may_be_left_open(folder: Path) -> None:
    assert run(folder, "--open") == 0
    route = load_route(folder / "made" / "route.json")
    assert not route.closed
    assert route.v[0] == pytest.approx(0.0, abs=1e-6)


def spoil(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: lines[:30], "must be 1.5 m or more"),
        (lambda lines: lines[:0], "is empty"),
        (lambda lines: [*lines[:4], "0.2 nan 0 0 0 0 0 1"], "line 5 is not finite"),
        (lambda lines: [*lines[:4], "0.2 1 2 3"], "line 5 is '0.2 1 2 3'"),
        (lambda lines: [*lines[:4], "0.2 0 0 0 0 0 0 2"], "line 5: the quaternion is of length 2"),
        (lambda lines: [*lines[:4], lines[2]], "line 5: t is 0.1, must be after 0.15"),
        (lambda lines: ["binary \x00", *lines], "line 1 is"),
    ],
)
def test_a_bad_trajectory_is_refused_in_one_line(
    folder: Path,
    change: Callable[[list[str]], list[str]],
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    spoil(folder / "base.tum", change)
    assert run(folder) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (folder / "made").exists()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--set", "max_sped=1"], "unknown limit 'max_sped': did you mean 'max_speed'?"),
        (["--set", "max_speed=fast"], "max_speed is 'fast': must be a number"),
        (["--set", "min_tags=2.5"], "min_tags is '2.5': must be a whole number"),
        (["--set", "corridor=0"], "corridor is 0.0"),
        (["--set", "max_curvature=0.2"], "max_curvature is"),
        (["--camera", "nowhere.yaml"], "nowhere.yaml"),
    ],
)
def test_bad_limits_are_refused_in_one_line(
    folder: Path, more: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(folder, *more) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_files_that_are_missing_are_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(folder, trajectory="gone.tum") == 2
    assert "gone.tum: No such file" in capsys.readouterr().err
    assert run(folder, tags="gone.json") == 2
    assert "gone.json: No such file" in capsys.readouterr().err


def test_a_robot_that_lies_on_its_side_is_refused() -> None:
    q = [math.cos(math.pi / 4), math.sin(math.pi / 4), 0.0, 0.0]  # a quarter turn about x
    # base_link so turned is no robot that stands; the same turn the other way is a camera.
    rolled = np.tile([math.cos(0.5), math.sin(0.5), 0, 0, 0, 0, 0], (5, 1))
    with pytest.raises(ValueError, match="57 deg from the map's z"):
        planar_poses(rolled, Mounting())
    level = np.tile([*q, 0, 0, 0], (5, 1))
    level[:, 1] *= -1  # optical z along y, optical y down
    poses, _ = planar_poses(level, Mounting())
    np.testing.assert_allclose(poses[:, 2], math.pi / 2)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    t, poses = drive()
    write_tum(tmp_path / "a.tum", t, poses)
    (tmp_path / "a.tum").write_text("# t x y z\n\n" + (tmp_path / "a.tum").read_text())
    again, spatial = read_tum(tmp_path / "a.tum")
    np.testing.assert_allclose(again, t, atol=1e-8)
    planar, height = planar_poses(spatial, Mounting(height=0.3))
    assert height == pytest.approx(0.3)
    np.testing.assert_allclose(planar[:, :2], poses[:, :2], atol=1e-8)
    np.testing.assert_allclose(np.cos(planar[:, 2] - poses[:, 2]), 1.0)


def test_limits_are_the_defaults_but_for_the_changes() -> None:
    limits = limits_from(["min_tags=1", "corridor=0.3"])
    assert (limits.min_tags, limits.corridor, limits.tag_distance) == (1, 0.3, 0.35)
