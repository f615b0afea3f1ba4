"""A user's scenario in a folder of its own: own arena, markers, robot, camera, controller."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from systems.io.bag import BagReader

SCENE = """
mission: navigation
description: Once around the table
duration: 40.0
sight: projected

world:
  markers:
    family: tag36h11
    size: 0.15
    tags:
      - {id: 10, position: [1.96, 0.0, 0.3], facing_deg: 180}
      - {id: 11, position: [1.96, 0.8, 0.3], facing_deg: 180}
      - {id: 12, position: [0.8, 1.96, 0.3], facing_deg: -90, size: 0.2}
      - {id: 13, position: [0.0, 1.96, 0.3], facing_deg: -90}
      - {id: 14, position: [-0.8, 1.96, 0.3], facing_deg: -90}
      - {id: 15, position: [-1.96, 0.4, 0.3], facing_deg: 0}
      - {id: 16, position: [1.96, -0.8, 0.3], facing_deg: 180}
  arena:
    walls:
      - {start: [2, -2], end: [2, 2]}
      - {start: [2, 2], end: [-2, 2]}
      - {start: [-2, 2], end: [-2, -2]}

robot:
  body: {type: differential_drive, wheel_radius: 0.05, base: 0.24, length: 0.3, width: 0.18}
  drive: wheel_servo
  start: {x: -1.0, y: -0.8}
  sensors:
    eye: {type: camera, calibration: wide.yaml, rate: 10.0, position: [0.1, 0.0, 0.2]}
    gyro: {type: imu, gyro_noise_density: 1e-3}

camera: eye
imu: gyro
waypoints:
  - [0.6, -0.6]
  - [0.6, 0.8]
estimator: {type: kf, speed_noise: 0.1}
controller: {type: "bold:Bold", speed: 0.4}
"""

BOLD = """
import numpy as np
from pydrake.systems.framework import LeafSystem


class Bold(LeafSystem):
    def __init__(self, *, speed: float):
        super().__init__()
        self.pose = self.DeclareVectorInputPort("pose", 3)
        self.goal = self.DeclareVectorInputPort("goal", 2)
        self.speed = speed
        self.DeclareVectorOutputPort("command", 2, self.calc)

    def calc(self, context, output):
        x, y, theta = self.pose.Eval(context)
        goal = self.goal.Eval(context)
        bearing = np.arctan2(goal[1] - y, goal[0] - x) - theta
        output.SetFromVector([self.speed * max(np.cos(bearing), 0), 2 * np.sin(bearing)])
"""


@pytest.fixture(scope="module")
def own(tagtrail: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the user's run; the command was given elsewhere."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "table.yaml").write_text(SCENE)
    (folder / "bold.py").write_text(BOLD)
    (folder / "wide.yaml").write_text(  # as ROS's calibration writes it
        "image_width: 800\nimage_height: 600\ncamera_name: wide\n"
        "camera_matrix: {rows: 3, cols: 3, data: [420, 0, 399.5, 0, 420, 299.5, 0, 0, 1]}\n"
        "distortion_model: plumb_bob\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [-0.05, 0.01, 0, 0, 0]}\n"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("elsewhere"))
        result = tagtrail("run", folder / "table.yaml", "--no-meshcat", "--out", folder / "out")
    assert (result.status, result.err) == (0, "")
    return folder / "out"


def test_it_runs_to_its_end(own: Path) -> None:
    report = json.loads((own / "report.json").read_text())
    assert (report["scenario"], report["outcome"]) == ("table", "reached")
    assert report["metrics"]["waypoints_reached"] == 2
    assert report["metrics"]["position_rmse_m"] < 0.05
    assert report["metrics"]["heading_rmse_deg"] < 2.0


def test_it_is_the_users_robot_camera_and_controller_that_ran(own: Path) -> None:
    bag = BagReader(own / "bag")
    topics = bag.topics()
    assert {"/robot/eye/detections", "/robot/eye/camera_info", "/robot/gyro"} <= set(topics)
    (_, _, info), *_ = bag.messages(["/robot/eye/camera_info"])
    assert (info.width, info.height, info.k[0], info.d[0]) == (800, 600, 420.0, -0.05)
    seen = {
        (tag.family, tag.id)
        for _, _, message in bag.messages(["/robot/eye/detections"])
        for tag in message.detections
    }
    assert seen <= {("tag36h11", number) for number in range(10, 17)}
    assert len(seen) >= 4
    t, x, y = np.loadtxt(own / "truth.tum")[:, :3].T
    assert (x[0], y[0]) == pytest.approx((-1.0, -0.8), abs=1e-6)
    speed = np.hypot(np.diff(x), np.diff(y)) / np.diff(t)
    assert 0.37 < speed.max() < 0.42


def test_its_saved_scenario_runs_the_same_from_anywhere(
    own: Path, tagtrail: Callable[..., Any], workshop: Path
) -> None:
    result = tagtrail("run", own / "scenario.yaml", "--no-meshcat", "--duration", "4")
    assert (result.status, result.err) == (1, "")
    again = (workshop / "out" / "table" / "estimate.tum").read_text().splitlines()
    assert len(again) > 190
    assert again == (own / "estimate.tum").read_text().splitlines()[: len(again)]
