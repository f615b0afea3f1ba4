"""What a formation is refused for: one line that says what, where, and what is allowed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

Refuse = Callable[..., str]

ON_A_LINE = "start=[[0,0],[1.5,0],[3,0],[4.5,0]]"
IN_THE_WAY = "world.arena.boxes=[{position: [9.7, 0.6], size: [1, 1, 1]}]"


def fault(**what: object) -> str:
    return "faults=[{" + ", ".join(f"{key}: {value}" for key, value in what.items()) + "}]"


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("robots=3", "--set robots: robots is 3: must be at least 4"),
        (
            ON_A_LINE,
            "--set start: start is [[0.0, 0.0], [1.5, 0.0], [3.0, 0.0], [4.5, 0.0]]: must be at "
            "least three robots at the vertices of triangles of 1.5 m that share sides",
        ),
        (
            IN_THE_WAY,
            "formation.yaml:49: destination = [9.75, 0.65] lies in boxes[0]: the robot needs "
            "0.200 m of room",
        ),
        (
            "robot.body.ring.size=0.05",
            "robot.body.ring.size is 0.05: must be at least 0.091 m: the anchor is 2.6 m away, "
            "sqrt(3) sides of 1.5 m, and turned by up to 45 degrees its marker must be 12 px wide "
            "in front_camera (focal length 485 px), not 6.6",
        ),
        (
            "formation.side=3",
            "robot.body.ring.size is 0.1: must be at least 0.182 m: the anchor is 5.2 m away, "
            "sqrt(3) sides of 3 m, and turned by up to 45 degrees its marker must be 12 px wide "
            "in front_camera (focal length 485 px), not 6.6",
        ),
        ("step.side=1.2", "step.side is 1.2: must be 1.5, as formation.side is"),
        (
            "estimator.marker_size=0.16",
            "estimator.marker_size is 0.16: must be 0.1, as robot.body.ring.size is",
        ),
        (
            "controller={type: algorithm1, dt: 310}",
            "robot.sensors.front_camera.calibration is 'f485.yaml': must be a camera whose picture "
            "holds 331 px on either side of its axis: controller.dt is 310 px, and half a marker "
            "more; this one holds 320",
        ),
        ("fail_robot=9", "--set fail_robot: fail_robot is 9: must be one of 1 to 4"),
        ("fail_robot=0", "--set fail_robot: fail_robot is 0: must be one of 1 to 4"),
        ("fail_at=-1", "--set fail_at: fail_at is -1.0: must be 0 or greater"),
        ("fail_as=corpse", "--set fail_as: fail_as is 'corpse': must be one of beacon, wreck"),
        (
            "formation.side=-1",
            "--set formation.side: formation.side is -1.0: must be greater than 0",
        ),
        (
            "controller=algoritm1",
            "--set controller: controller.type is 'algoritm1': no such controller; did you mean "
            "'algorithm1'? (or 'module:Class')",
        ),
        (
            fault(robot=9, signal="drive.command", kind="dead"),
            "--set faults: faults[0].robot is 9: must be 0 (all) to 4",
        ),
        (
            fault(robot=1, signal="front_camera.detection", kind="hidden"),
            "faults: there is no signal robot1.front_camera.detection; did you mean "
            "'robot1.front_camera.detections'?",
        ),
        (
            fault(robot=1, signal="drive.command", kind="hidden"),
            "faults of robot1.drive.command: kind is 'hidden': must be frozen or nan or garbled "
            "or dead",
        ),
    ],
)  # fmt: skip
def test_one_line_says_what_where_and_what_is_allowed(
    refuse: Refuse, override: str, line: str, tmp_path: Path
) -> None:
    options = ("--no-meshcat", "--set", "sight=projected", "--set", override)
    said = refuse("run", "formation", *options, "--out", tmp_path)
    assert said.endswith(line), said


@pytest.mark.parametrize("camera", ["front_camera", "rear_camera"])
@pytest.mark.parametrize("controller", ["algorithm1", "resection"])
def test_a_camera_too_narrow_for_the_triangle_is_named(
    refuse: Refuse, camera: str, controller: str, tmp_path: Path
) -> None:
    narrow = tmp_path / "narrow.yaml"
    narrow.write_text(
        "width: 500\nheight: 480\nK: [485, 0, 249.5, 0, 485, 239.5, 0, 0, 1]\nD: [0, 0, 0, 0, 0]\n"
    )
    said = refuse(
        "run", "formation", "--no-meshcat", "--out", tmp_path / "out",
        "--set", f"controller={controller}",
        "--set", f"robot.sensors.{camera}.calibration={narrow}",
    )  # fmt: skip
    assert said.endswith(
        f"robot.sensors.{camera}.calibration is '{narrow}': must be a camera whose picture holds "
        "301 px on either side of its axis: a beacon 30 degrees aside falls 280 px from it, and "
        "half a marker more; this one holds 250"
    ), said
