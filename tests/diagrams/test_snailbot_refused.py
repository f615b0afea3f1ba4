"""What is wrong with a scenario of robots on shells: one line that says what, where, what else."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from diagrams.scenario import bundled_scenarios
from systems.shell.layout import shell_markers
from tests.diagrams.snailbot_runs import run

Refuse = Callable[..., str]

SHORT = ("--no-meshcat", "--set", "sight=projected", "--duration", "0.05")
BUNDLED = bundled_scenarios()["snailbot"]


def line_of(text: str) -> int:
    """The line of the bundled scenario that begins with a text."""
    lines = BUNDLED.read_text().splitlines()
    (number,) = [n for n, line in enumerate(lines, 1) if line.strip().startswith(text)]
    return number


# --- Markers ---


def unchanged(tags: dict[int, dict[str, Any]]) -> None:
    """The paper's map as it is."""
    del tags


def marker_map(
    folder: Path, change: Callable[[dict[int, dict[str, Any]]], None] = unchanged
) -> Path:
    """Writes the paper's map with something else about its markers, by id."""
    content = shell_markers().to_json()
    change({tag["ID"]: tag for tag in content["tags"]})
    path = folder / "shell.json"
    path.write_text(json.dumps(content))
    return path


def refused_map(refuse: Refuse, path: Path) -> str:
    scene = path.with_name("scene.yaml")
    scene.write_text("extends: snailbot\nworld:\n  markers: shell.json\n")
    before = f"{scene}:2: world: marker map {path}: "
    line = refuse("run", scene, *SHORT)
    assert line.startswith(before)
    return line.removeprefix(before)


def test_a_map_with_two_equal_ids(refuse: Refuse, workshop: Path) -> None:
    def change(tags: dict[int, dict[str, Any]]) -> None:
        tags[4]["ID"] = 2

    said = refused_map(refuse, marker_map(workshop, change))
    assert said == "tags[3].ID is 2: there is a tag of that ID already"


@pytest.mark.parametrize(
    ("out", "words"),
    [(1.01, "outside the sphere"), (0.99, "inside the sphere")],
)
def test_a_marker_off_the_sphere(refuse: Refuse, workshop: Path, out: float, words: str) -> None:
    def change(tags: dict[int, dict[str, Any]]) -> None:
        place = tags[9]["pose"]["translation"]
        place.update({axis: out * value for axis, value in place.items()})

    said = refused_map(refuse, marker_map(workshop, change))
    assert said.startswith("marker 9 is off the shell: a corner lies 0.7")
    assert f"mm {words} of radius 75 mm (allowed: 0.2 mm)" in said


def test_a_marker_that_faces_inward(refuse: Refuse, workshop: Path) -> None:
    def change(tags: dict[int, dict[str, Any]]) -> None:
        tags[14]["pose"]["rotation"]["quaternion"] = {"W": 0.0, "X": 0.0, "Y": 0.0, "Z": 1.0}

    said = refused_map(refuse, marker_map(workshop, change))
    assert said == "marker 14 faces the centre of the shell: must face outward"


def test_a_map_of_another_shell(refuse: Refuse, workshop: Path) -> None:
    marker_map(workshop)
    scene = workshop / "scene.yaml"
    scene.write_text("extends: snailbot\nworld: {markers: shell.json, shell: {radius: 0.1}}\n")
    assert "marker 1 is off the shell: a corner lies 25 mm inside the sphere" in refuse(
        "run", scene, *SHORT
    )


def test_the_papers_markers_on_a_marble(refuse: Refuse) -> None:
    line = refuse("run", "snailbot", *SHORT, "--set", "world.shell.radius=0.01")
    assert "world: the paper's markers: size is 0.005: must be less than 0.00366 m" in line


def test_ones_own_map_of_the_paper_is_as_good(workshop: Path) -> None:
    # What the refusals start from is sound, or they would prove nothing.
    marker_map(workshop)
    scene = workshop / "scene.yaml"
    scene.write_text("extends: snailbot\nworld: {markers: shell.json}\n")
    own, bundled = (run("duration=0.2", name=str(name)).report for name in (scene, "snailbot"))
    assert own["metrics"] == bundled["metrics"]
    assert own["health"]["estimator"]["accepted"] > 1


# --- Keys and values ---


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("robot.sensors.camera.height=0.001",
         "robot.sensors.camera.height is 0.001: must be at least 0.002 m: nearer, the camera "
         "touches the shell"),
        ("robot.sensors.imu.rate=50",
         "robot.sensors.imu.rate is 50.0: must be at least the camera's, 60 Hz"),
        ("robot.sensors.camera.rate=400",
         "robot.sensors.camera.processing_time is 0.005: must be less than 0.0025 s, the time "
         "between two pictures"),
        ("robot.sensors.camera.clock_error=0.01",
         "robot.sensors.camera.clock_error is 0.01: must be at most the latency, 0 s: pictures do "
         "not come from the future"),
        ("errors=awful", "errors is 'awful': must be one of none, base, harsh"),
        ("errors={mounting: 3}", "errors.mounting: unknown key; did you mean 'mounting_deg'?"),
        ("errors={rock_deg: -1}", "errors.rock_deg is -1.0: must be 0 or greater"),
        ("erors=base", "erors: unknown key; did you mean 'errors'?"),
        ("dynamics=kinematic", "dynamics is 'kinematic': must be multibody"),
        ("drive_on=gps", "drive_on is 'gps': must be one of estimate, truth"),
        ("iterations=0", "iterations is 0: must be 1 or greater"),
        ("magnet_force=-1", "magnet_force is -1.0: must be 0 or greater, finite"),
        ("camera=front", "camera is 'front': must be one of the robot's sensors that fit: camera"),
        ("camera=imu", "camera is 'imu': must be one of the robot's sensors that fit: camera"),
        ("imu=gyro", "imu is 'gyro': must be one of the robot's sensors that fit: imu"),
        ("robot.body=differential_drive",
         "robot.body is 'differential_drive': must be one that climbs"),
        ("estimator.sensors=[sonar]",
         "estimator.sensors is ['sonar']: must be one or more of marker, flow, imu, each once"),
        ("team=[]", "team is []: must be at least one robot"),
        ("team=[{speed: 0}]", "team[0].speed is 0.0: must be positive"),
        ("team=[{route: round}]", "team[0].route is 'round': must be one of routine, stand"),
        ("team=[{start: {pitch_deg: 91}}]",
         "team[0].start.pitch_deg is 91.0: must be from -90 to 90"),
    ],
)  # fmt: skip
def test_an_override_is_refused_by_its_key(refuse: Refuse, override: str, line: str) -> None:
    said = refuse("run", "snailbot", *SHORT, "--set", override)
    key = override.partition("=")[0]
    assert said.endswith(line)
    where = said.removesuffix(line)
    assert where == f"--set {key}: " or where.startswith(f"{BUNDLED}:")


def test_where_the_bundled_file_says_it_its_line_is_told(refuse: Refuse) -> None:
    camera = "robot.sensors.camera"
    said = refuse(
        "run", "snailbot", *SHORT,
        "--set", f"{camera}.rate=310", "--set", f"{camera}.processing_time=0.001",
    )  # fmt: skip
    assert said == (
        f"{BUNDLED}:{line_of('imu: {')}: robot.sensors.imu.rate is 300.0: must be at least the "
        "camera's, 310 Hz"
    )


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("team=[{start: {on: robot_2}}, {}]",
         "--set team: team[0].start.on is 'robot_2': must be left out, or reference"),
        ("team=[{}, {start: {on: robot_9}}]",
         "--set team: team[1].start.on is 'robot_9': must be left out, or robot"),
        ("team=[{}, {}, {start: {on: robot}}]",
         "--set team: team[2].start.on is 'robot': must be left out, or robot_2"),
        ("robot.sensors.camera.sight=rendered",
         "--set robot.sensors.camera.sight: robot.sensors.camera.sight is 'rendered': must be left "
         "out, where sight is projected: shells look one way to all cameras"),
        ("errors={delay: 0.3}", "--set errors: errors.delay is 0.3: must be at most 0.2 s"),
        ("robot.drive=dc_motors",
         "robot.drive is 'dc_motors': must be wheel_servo: of this body nothing tells how the "
         "wheels turn"),
        ("robot.sensors.odometer=wheel_encoders",
         "robot.odometer.type is 'wheel_encoders': must be a sensor that fits: of this body "
         "nothing tells how far its wheels have turned"),
        ("robot.faults=[{signal: camera.detectoins, kind: frozen}]",
         "faults: there is no signal robot.camera.detectoins; did you mean "
         "'robot.camera.detections'?"),
        ("robot.faults=[{signal: imu.sample, kind: silent}]",
         "faults of robot.imu.sample: kind is 'silent': must be frozen or nan or garbled or dead"),
        ("estimator=systems.estimators.planar_ekf:PlanarEkf",
         "estimator.pose does not fit route.pose: "),
    ],
)  # fmt: skip
def test_what_does_not_fit_together_is_refused(refuse: Refuse, override: str, line: str) -> None:
    said = refuse("run", "snailbot", *SHORT, "--set", override)
    assert said.startswith(line)
    assert said == line or line.endswith(": ")


def test_a_refused_run_writes_nothing(refuse: Refuse, workshop: Path) -> None:
    refuse("run", "snailbot", *SHORT, "--out", "out", "--set", "errors=awful")
    assert list(workshop.iterdir()) == []
