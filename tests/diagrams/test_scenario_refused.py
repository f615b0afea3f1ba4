"""What is wrong with a scenario, and where it says so."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from diagrams.scenario import load_scenario
from diagrams.schema import ScenarioError

Writer = Callable[..., Path]


def refusal(path: Path | str, overrides: Any = ()) -> str:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(str(path), overrides)
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("sihgt=projected", "--set sihgt: sihgt: unknown key; did you mean 'sight'?"),
        ("sight=painted",
         "--set sight: sight is 'painted': must be one of rendered, drawn, projected"),
        ("seed=1.5", "--set seed: seed is 1.5: must be a whole number"),
        ("seed=1e3", "--set seed: seed is 1000.0: must be a whole number"),
        ("seed=-1", "--set seed: seed is -1: must be a whole number from 0 to 2^53 - 1"),
        ("seed=", "--set seed: seed is '': must be a whole number"),
        ("duration=0", "--set duration: duration is 0.0: must be greater than 0"),
        ("duration=.inf", "--set duration: duration is inf: must be greater than 0"),
        ("time_step=.nan", "--set time_step: time_step is nan: must be greater than 0"),
        ("record=true", "--set record: record is True: must be a mapping with bag, images"),
        ("record.bag=1", "--set record.bag: record.bag is 1: must be true or false"),
        ("name=3", "--set name: name is 3: must be text"),
        ("recording=nope", "--set recording: recording is 'nope': there is no such file or folder"),
        ("robot.start.x=.nan", "--set robot.start.x: robot.start.x is nan: must be finite"),
        ("robot.start={x: left}", "--set robot.start: robot.start.x is 'left': must be a number"),
        ("robot.body.base=0",
         "--set robot.body.base: robot.body.base is 0.0: must be greater than 0"),
        ("robot.sensors.imu.gyro_bias=[1, 2]",
         "--set robot.sensors.imu.gyro_bias: robot.sensors.imu.gyro_bias is [1.0, 2.0]: must be "
         "three finite numbers"),
        ("robot.sensors.front_camera.sight=real",
         "--set robot.sensors.front_camera.sight: robot.sensors.front_camera.sight is 'real': "
         "must be one of rendered, drawn, projected"),
        ("camera=imu",
         "--set camera: camera is 'imu': must be one of the robot's sensors that fit: "
         "front_camera"),
        ("imu=gyro", "--set imu: imu is 'gyro': must be one of the robot's sensors that fit: "
                     "front_camera, imu"),
        ("waypoints=[]", "--set waypoints: waypoints is []: must be at least one [x, y]"),
        ("waypoints=[[1, 2, 3]]",
         "--set waypoints: waypoints[0] is [1.0, 2.0, 3.0]: must be [x, y] in metres"),
        ("waypoints.5=[0, 0]", "--set waypoints.5: 5 must be an index from 0 to 4"),
        ("waypoints.first=[0, 0]", "--set waypoints.first: 'first' must be an index from 0 to 4"),
        ("estimator=kff",
         "--set estimator: estimator is 'kff': no such estimator; did you mean 'kf'? (or "
         "'module:Class')"),
        ("estimator.type=kff",
         "--set estimator.type: estimator.type is 'kff': no such estimator; did you mean 'kf'? (or "
         "'module:Class')"),
        ("estimator=null", "--set estimator: estimator is None: must be a name (of the estimator) "
                           "or a mapping with 'type'"),
        ("estimator.gat=3", "--set estimator.gat: estimator.gat: unknown key; did you mean "
                            "'gate'?"),
        ("estimator.gate=high", "--set estimator.gate: estimator.gate is 'high': must be a number"),
        ("estimator.gate=-1", "--set estimator.gate: estimator.gate is -1.0: must be greater than "
                              "0"),
        ("robot.body=car", "--set robot.body: robot.body is 'car': no such body; known: "
                           "differential_drive, limo, snailbot (or 'module:Class')"),
        ("robot.body.type=car", "--set robot.body.type: robot.body.type is 'car': no such body; "
                                "known: differential_drive, limo, snailbot (or 'module:Class')"),
        ("a.b.c=3", "--set a.b.c: a: unknown key; known: "),
        ("world.markers=nope.json", "--set world.markers: world.markers is 'nope.json': no such "
                                    "file in "),
        ("seed=[1,", "--set: '[1,' is not YAML"),
        ("seed", "--set seed: must be KEY=VALUE"),
        ("=3", "--set =3: must be KEY=VALUE"),
    ],
)  # fmt: skip
def test_an_override_is_refused_by_its_key(override: str, message: str) -> None:
    said = refusal("navigation_open", [override])
    if message.endswith(("known: ", "in ")):
        assert said.startswith(message)
    else:
        assert said == message


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("position=[1, 2]", "position is [1.0, 2.0]: must be three numbers"),
        ("rate=0", "rate is 0.0: must be greater than 0"),
        ("latency=-1", "latency is -1.0: must be 0 or greater"),
    ],
)
def test_what_a_driver_refuses_stands_where_it_was_written(override: str, said: str) -> None:
    key = "robot.sensors.front_camera"
    scenario = load_scenario("navigation_open", ["sight=projected", f"{key}.{override}"])
    with pytest.raises(ScenarioError) as caught:
        scenario.build()
    name = override.partition("=")[0]
    assert str(caught.value) == f"--set {key}.{name}: {key}.{said}"


@pytest.mark.parametrize("name", ["drive", "estimate", "Camera", "front camera", "x/y", "é", "1st"])
def test_a_device_needs_a_name_that_ros_and_the_station_can_use(name: str) -> None:
    said = refusal("navigation_open", {f"robot.sensors.{name}": {"type": "imu"}})
    assert f"robot.sensors is {name!r}: must be a name in lower case" in said


# Files


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", ": must be a mapping"),
        ("- 1\n", ": must be a mapping"),
        ("seed: [1\n", ":2: not YAML: expected ',' or ']', but got '<stream end>'"),
        ("seed: 1\nseed: 2\n",
         ':2: not YAML: found duplicate key "seed" with value "2" (original value: "1")'),
        ("seed: 1\n\tname: x\n",
         ":2: not YAML: found character '\\t' that cannot start any token"),
        ("seed: 1\n", ": the scenario lacks the key 'mission'"),
        ("mission: navigation\n", ": the scenario lacks the key 'world'"),
        ("mission: navigatoin\n",
         ":1: mission is 'navigatoin': no such mission; did you mean 'navigation'? (or "
         "'module:Class')"),
        ("mission: 3\n", ":1: mission is 3: must be text"),
        ("extends: navigation\n3: 4\n", ":2: 3: unknown key; known: "),
        ("extends: navigation\nworld:\n", ":2: world is None: must be a mapping with markers, "
                                          "arena"),
        ("extends: navigation\nwaypoints:\n  - [-1.7, 1.0]\n  - [-0.8, 0.1]\n",
         ":4: waypoints[1] = [-0.8, 0.1] lies in walls[4]: the robot needs 0.125 m of room"),
        ("extends: navigation\nrobot:\n  body: {length: 0.4}\n  start:\n    x: -1.0\n",
         ":4: robot.start"),
        ("extends: navigation\nworld:\n  arena:\n    walls:\n      - {start: [0, 0], end: [0, 0]}"
         "\n", ":5: world.arena.walls[0].end is [0.0, 0.0]: must be another point than start"),
        ("extends: navigation\nworld:\n  arena:\n    walls:\n      - start: [0, 0]\n",
         ":5: world.arena.walls[0] lacks the key 'end'"),
        ("extends: navigation\nworld:\n  markers:\n    family: 4x4_50\n    size: 0\n    tags: []\n",
         ":5: world.markers.size is 0.0: must be greater than 0"),
        ("extends: navigation\nworld:\n  markers: {family: 4x4_51, size: 0.1, tags: []}\n",
         ":3: world.markers: marker family is '4x4_51': unknown; "),
        ("extends: navigation\nworld:\n  markers:\n    family: 4x4_50\n    size: 0.1\n    tags:\n"
         "      - {id: 50, position: [0, 0, 0.2], facing_deg: 0}\n",
         ":3: world.markers: id is 50: DICT_4X4_50 has the ids 0 to 49"),
        ("extends: navigation\nworld:\n  markers:\n    family: 4x4_50\n    size: 0.1\n    tags:\n"
         "      - {id: 1, position: [0, 0, 0.2], facing_deg: 0}\n"
         "      - {id: 1, position: [1, 0, 0.2], facing_deg: 0}\n",
         ":3: world.markers: id is 1: must be given once"),
        ("extends: navigation\nworld:\n  markers:\n    family: 4x4_50\n    size: 0.1\n    tags:\n"
         "      - {id: 1, position: [0, 0], facing_deg: 0}\n",
         ":7: world.markers.tags[0].position is [0.0, 0.0]: must be [x, y, z] in metres"),
        ("extends: navigation\nrobot:\n  sensors:\n    front_camera:\n      calibration: my.yaml\n",
         ":5: robot.sensors.front_camera.calibration is 'my.yaml': no such file in "),
    ],
)  # fmt: skip
def test_a_file_is_refused_with_its_line(write_scenario: Writer, text: str, message: str) -> None:
    path = write_scenario(text, extends=None)
    assert refusal(path).startswith(f"{path}{message}")


def test_a_file_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\x00")
    assert refusal(binary) == f"{binary}: not a text file"
    assert refusal(tmp_path) == f"scenario {tmp_path}: no such file"
    assert refusal("navigatoin") == (
        "scenario 'navigatoin': no such file or bundled name; did you mean 'navigation'?"
    )
    assert refusal("nope.yaml") == "scenario nope.yaml: no such file"
