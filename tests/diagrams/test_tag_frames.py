"""Frames on a circle: without noise observed and true frames are one, with noise they are not."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.geometry import Meshcat, MeshcatParams

from diagrams.run import simulate
from diagrams.scenario import load_scenario
from systems.io.bag import BagReader
from systems.io.ros_motion import transforms_from_ros
from systems.io.ros_vision import detections_from_ros

NOISE = "robot.sensors.front_camera.projector.pixel_noise"


@pytest.fixture(scope="module")
def runs(tagtrail: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Runs by their noise, px."""
    found = {}
    for noise in ("0", "0.1", "0.3"):
        found[noise] = tmp_path_factory.mktemp("frames")
        arguments = ("--no-meshcat", "--set", f"{NOISE}={noise}")
        result = tagtrail("run", "tag_frames", *arguments, "--out", found[noise])
        assert (result.status, result.err) == (0, "")
    return found


def metrics(folder: Path) -> dict[str, Any]:
    report = json.loads((folder / "report.json").read_text())
    assert report["outcome"] == "round"
    found: dict[str, Any] = report["metrics"]
    return found


def test_without_noise_they_are_one(runs: dict[str, Path]) -> None:
    m = metrics(runs["0"])
    assert m["tags_seen"] == 8
    assert m["observations"] > m["frames"] > 150
    assert m["tag_position_error_max_m"] < 1e-6
    assert m["camera_position_error_max_m"] < 1e-6
    assert m["rotation_error_max_deg"] < 1e-4
    assert m["flipped_fraction"] == 0


def test_with_noise_they_are_not(runs: dict[str, Path]) -> None:
    little, much = metrics(runs["0.1"]), metrics(runs["0.3"])
    for key in ("tag_position_error_mean_m", "rotation_error_mean_deg"):
        assert 0 < little[key] < much[key]
    assert 0.002 < much["tag_position_error_mean_m"] < 0.03
    assert 2 < much["rotation_error_mean_deg"] < 12
    # A tag's rotation swings the camera by its distance, of 1 to 3 m.
    lever = much["camera_position_error_mean_m"] / math.radians(much["rotation_error_mean_deg"])
    assert 1.0 < lever < 3.0


def test_the_camera_goes_round_on_a_circle(runs: dict[str, Path]) -> None:
    rows = np.loadtxt(runs["0.3"] / "truth_camera.tum")
    t, x, y, z = rows[:, :4].T
    # base_link goes round on 1 m; the camera is 0.1 m ahead of it.
    np.testing.assert_allclose(np.hypot(x, y), math.hypot(1.0, 0.1), atol=1e-3)
    np.testing.assert_allclose(z, 0.25)
    turned = np.unwrap(np.arctan2(y, x))
    np.testing.assert_allclose(turned - turned[0], 0.4 * t, atol=0.01)
    seen = np.loadtxt(runs["0"] / "observed_camera.tum")
    true = {row[0]: row[1:] for row in np.loadtxt(runs["0"] / "truth_camera.tum").round(9)}
    for row in seen:
        np.testing.assert_allclose(row[1:4], true[row[0].round(9)][:3], atol=1e-6)


def test_cam_T_tag_is_recorded(runs: dict[str, Path]) -> None:
    reader = BagReader(runs["0.3"] / "bag")
    found = [
        detections_from_ros(m) for _, _, m in reader.messages(["/rig/front_camera/detections"])
    ]
    seen = {(d.stamp, int(tag)) for d in found for tag in d.ids}
    transforms = {
        (tf.stamp, int(tf.child_frame_id.rpartition(":")[2]))
        for _, _, m in reader.messages(["/tf"])
        for tf in transforms_from_ros(m)
    }
    assert transforms == seen


def test_the_replay_shows_the_frames(tmp_path: Path) -> None:
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    scenario = load_scenario("tag_frames", {"duration": 1.0})
    simulate(scenario, out=tmp_path, meshcat=meshcat)
    for kind in ("true", "observed"):
        for name in ("camera", *(f"tag {k}" for k in range(8))):
            for part in ("x", "y", "z", "middle"):
                assert meshcat.HasPath(f"frames/{kind}/{name}/{part}"), (kind, name)
    assert meshcat.HasPath("frames/path of truth/3")
    assert meshcat.HasPath("frames/path of observed/3")
    assert (tmp_path / "replay.html").stat().st_size > 1e6


@pytest.mark.parametrize(
    ("setting", "line"),
    [
        ("circle.radius=0", "circle.radius is 0.0: must be greater than 0"),
        ("circle.speed=-1", "circle.speed is -1.0: must be greater than 0"),
        (
            "camera=encoders",
            "camera is 'encoders': must be one of the robot's sensors that fit: front_c",
        ),
        ("world.markers.tags=[]", "world.markers is 'empty': must be of tags"),
    ],
)
def test_nonsense_is_one_line(
    refuse: Callable[..., str], tmp_path: Path, setting: str, line: str
) -> None:
    assert line in refuse("run", "tag_frames", "--no-meshcat", "--set", setting, "--out", tmp_path)
