from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from diagrams.scenario import (
    bundled_scenarios,
    find_scenario,
    load_scenario,
    merge,
    parse_value,
    save_scenario,
)
from diagrams.schema import ScenarioError

Writer = Callable[..., Path]


def refusal(path: Path | str, overrides: Any = ()) -> str:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(str(path), overrides)
    message = str(caught.value)
    assert "\n" not in message
    return message


def refused_override(*overrides: str) -> str:
    return refusal("navigation_open", overrides)


# Values


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3", 3),
        ("1e-3", 1e-3),
        ("1E3", 1e3),
        ("-.5", -0.5),
        ("0x10", 16),
        ("010", 10),  # not octal, as YAML 1.1 has it
        ("true", True),
        ("yes", "yes"),  # not a truth value, as YAML 1.1 has it
        ("null", None),
        ("", ""),
        ("12:30", "12:30"),  # not a number of base 60
        ("[1, 2.5]", [1, 2.5]),
        ("{a: 1, b: [x]}", {"a": 1, "b": ["x"]}),
        ("my_module:Class", "my_module:Class"),
        ("two words", "two words"),
        ('"3"', "3"),
    ],
)
def test_values_are_those_of_yaml_1_2(text: str, value: Any) -> None:
    parsed = parse_value(text)
    assert parsed == value
    assert type(parsed) is type(value)


def test_files_are_yaml_1_2_too(write_scenario: Writer) -> None:
    path = write_scenario("time_step: 1e-3\nseed: 0x10\nduration: 5\n")
    scenario = load_scenario(str(path))
    assert (scenario.time_step, scenario.seed, scenario.duration) == (1e-3, 16, 5.0)
    assert "record.bag is 'yes'" in refusal(write_scenario("record: {bag: yes}\n"))


def test_merge_keys_of_yaml_are_followed(write_scenario: Writer) -> None:
    text = "search: &quick\n  turn_rate: 1.0\nestimator:\n  <<: *quick\n  type: kf\n"
    path = write_scenario(text)
    # The key that came by the merge has no line of its own there: that of its block is given.
    assert refusal(path).startswith(f"{path}:4: estimator.turn_rate: unknown key")
    path = write_scenario("robot: {start: &here {x: -1.7}}\n")
    assert load_scenario(str(path)).robot.start.x == -1.7


# Layers


def test_mappings_are_merged_and_all_else_is_replaced() -> None:
    base = {"a": {"b": 1, "c": [1, 2]}, "d": 3}
    assert merge(base, {"a": {"c": [5]}, "e": 6}) == {"a": {"b": 1, "c": [5]}, "d": 3, "e": 6}
    assert base == {"a": {"b": 1, "c": [1, 2]}, "d": 3}
    assert merge({"a": {"b": 1}}, {"a": None}) == {"a": None}
    assert merge(3, {"a": 1}) == {"a": 1}
    assert merge({"a": 1}, 3) == 3


@pytest.mark.parametrize(
    ("base", "top", "result"),
    [
        ("kf", {"gate": 3}, {"type": "kf", "gate": 3}),
        ("kf", {"type": "kf", "gate": 3}, {"type": "kf", "gate": 3}),
        ("kf", {"type": "ekf", "gain": 3}, {"type": "ekf", "gain": 3}),
        ("kf", "ekf", "ekf"),
        ({"type": "kf", "gate": 1}, {"gate": 3}, {"type": "kf", "gate": 3}),
        ({"type": "kf", "gate": 1}, "kf", {"type": "kf", "gate": 1}),
        ({"type": "kf", "gate": 1}, "ekf", {"type": "ekf"}),
        ({"type": "kf", "gate": 1}, {"type": "ekf"}, {"type": "ekf"}),
        ({"type": "kf", "gate": 1}, {"type": "kf", "q": 2}, {"type": "kf", "gate": 1, "q": 2}),
    ],
)
def test_a_block_whose_type_changes_starts_anew(base: Any, top: Any, result: Any) -> None:
    assert merge(base, top) == result


def test_files_extend_files(write_scenario: Writer, tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    write_scenario("seed: 1\nduration: 20\nestimator: {gate: 5}\n", "base.yaml")
    top = write_scenario("seed: 2\nestimator: {rate: 50}\n", "sub/top.yaml", extends="../base.yaml")
    scenario = load_scenario(str(top), ["duration=30"])
    assert (scenario.seed, scenario.duration) == (2, 30.0)
    assert scenario.estimator.arguments["parameters"].gate == 5.0
    assert scenario.estimator.arguments["rate"] == 50.0
    assert scenario.name == "top"
    bundled = load_scenario("navigation_open")
    assert scenario.waypoints == bundled.waypoints
    assert scenario.mission == "navigation"


def test_a_refusal_names_the_layer_that_wrote_the_value(write_scenario: Writer) -> None:
    base = write_scenario("seed: 1\nduration: 20\nestimator:\n  gate: -5\n", "base.yaml")
    top = write_scenario("seed: x\n", "top.yaml", extends="base.yaml")
    assert refusal(base) == f"{base}:5: estimator.gate is -5.0: must be greater than 0"
    assert refusal(top) == f"{base}:5: estimator.gate is -5.0: must be greater than 0"
    mended = ["estimator.gate=5"]
    assert refusal(top, mended) == f"{top}:2: seed is 'x': must be a whole number"
    assert refusal(top, [*mended, "seed=-3"]).startswith("--set seed: seed is -3")


def test_a_file_that_extends_itself_is_refused(write_scenario: Writer) -> None:
    path = write_scenario("", extends="scene.yaml")
    assert refusal(path) == f"{path}: extends itself"
    write_scenario("", "one.yaml", extends="two.yaml")
    two = write_scenario("", "two.yaml", extends="three.yaml")
    write_scenario("", "three.yaml", extends="one.yaml")
    assert "extends itself" in refusal(two)


def test_what_a_file_extends_must_be_there(write_scenario: Writer) -> None:
    path = write_scenario("", extends="navigatoin")
    assert refusal(path) == (
        f"{path}: extends: scenario 'navigatoin': no such file or bundled name; "
        "did you mean 'navigation'?"
    )
    path = write_scenario("", extends="base.yaml")
    assert refusal(path) == f"{path}: extends: scenario base.yaml: no such file"
    path = write_scenario("", extends="[navigation]")
    assert refusal(path) == f"{path}: extends is ['navigation']: must be a name or path"


def test_a_scenarios_own_markers_replace_the_map_that_it_extends(write_scenario: Writer) -> None:
    text = """
world:
  markers:
    family: 36h11
    size: 0.2
    tags:
      - {id: 7, position: [2.0, 1.0, 0.3], facing_deg: 180}
  arena: {walls: []}
"""
    scenario = load_scenario(str(write_scenario(text)))
    markers = scenario.world.marker_map()
    assert markers.family.name == "tag36h11"
    (marker,) = markers
    assert (marker.id, marker.size) == (7, 0.2)
    # The printed face looks back along x, its right hand side to +y.
    top_left, top_right = marker.corners()[:2]
    assert top_left == pytest.approx([2.0, 1.1, 0.4])
    assert top_right == pytest.approx([2.0, 0.9, 0.4])
    assert load_scenario("navigation_open").world.markers == "navigation.json"


# --set


def test_set_reaches_into_blocks_written_as_words_and_into_lists() -> None:
    scenario = load_scenario(
        "navigation_open",
        [
            "estimator.gate=12",
            "robot.body.wheel_radius=0.04",
            "waypoints.1=[0.0, 0.9]",
            "waypoints.0.1=0.9",
            "world.arena.walls.4.height=0.5",
            "robot.sensors.imu.gyro_bias.2=1e-3",
            "robot.sensors.imu.type=imu",
        ],
    )
    assert scenario.estimator.arguments["parameters"].gate == 12.0
    assert scenario.robot.body.arguments["parameters"].wheel_radius == 0.04
    assert scenario.waypoints[:2] == [[-1.7, 0.9], [0.0, 0.9]]
    assert scenario.waypoints[2:] == load_scenario("navigation_open").waypoints[2:]
    assert [wall.height for wall in scenario.world.arena.walls] == [0.6] * 4 + [0.5, 0.6]
    imu = scenario.robot.sensors["imu"].arguments["parameters"]
    assert (imu.gyro_bias, imu.gyro_noise_density) == ([0.0, 0.0, 1e-3], 5e-4)


def test_later_overrides_win_and_may_come_as_a_mapping() -> None:
    assert load_scenario("navigation_open", ["seed=1", "seed=2"]).seed == 2
    scenario = load_scenario("navigation_open", {"seed": 5, "estimator": {"type": "kf", "gate": 3}})
    assert (scenario.seed, scenario.estimator.arguments["parameters"].gate) == (5, 3.0)


def test_changing_a_blocks_type_forgets_its_other_keys(
    write_scenario: Writer, tmp_path: Path
) -> None:
    (tmp_path / "own_estimator.py").write_text(
        "from systems.estimators.planar_kalman import PlanarKalmanFilter\n"
        "class Mine(PlanarKalmanFilter):\n"
        "    def __init__(self, *, horizon: int = 3) -> None:\n"
        "        super().__init__()\n"
    )
    path = write_scenario("estimator: {gate: 5}\n")
    scenario = load_scenario(str(path), ["estimator.type=own_estimator:Mine"])
    assert scenario.estimator.arguments == {"horizon": 3}


# Files


def test_a_bundled_name_is_not_hidden_by_a_file_in_the_current_folder(
    write_scenario: Writer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_scenario("seed: 77\n", "navigation_open")
    write_scenario("", "vga.yaml", extends=None)
    write_scenario("", "navigation.json", extends=None)
    scenario = load_scenario("navigation_open")
    assert scenario.seed == 0
    assert scenario.world.markers == "navigation.json"
    assert scenario.robot.sensors["front_camera"].arguments["calibration"] == "vga.yaml"
    assert load_scenario("./navigation_open").seed == 77


@pytest.mark.parametrize("name", sorted(bundled_scenarios()))
def test_every_bundled_scenario_is_found_described_and_built(name: str) -> None:
    assert find_scenario(name).is_file()
    scenario = load_scenario(name, ["sight=projected"])
    assert len(scenario.description) > 20
    mission = scenario.build()
    assert mission.diagram.num_input_ports() == 0


# The resolved scenario


def test_a_saved_scenario_is_the_same_when_loaded_again(
    write_scenario: Writer, tmp_path: Path
) -> None:
    (tmp_path / "my_camera.yaml").write_text(
        "width: 320\nheight: 240\nK: [250, 0, 160, 0, 250, 120, 0, 0, 1]\n"
    )
    path = write_scenario(
        """
seed: 12345678901
time_step: 1.0e-3
description: "a: #b"
estimator: {measurement_noise: [0.1, 0.2, 1.0e-7]}
world:
  markers:
    family: 4x4_50
    size: 0.1
    tags: [{id: 1, position: [1.75, 1.2, 0.2], facing_deg: 30}]
robot: {sensors: {front_camera: {calibration: my_camera.yaml, projector: {max_range: .inf}}}}
"""
    )
    scenario = load_scenario(str(path), ["robot.start.heading_deg=12.5"])
    saved = tmp_path / "elsewhere" / "saved.yaml"
    saved.parent.mkdir()
    save_scenario(scenario, saved)
    again = load_scenario(str(saved))
    assert again == scenario
    assert again.name == "scene"
    # And it is a fixed point: saved again, it is the same file.
    save_scenario(again, tmp_path / "again.yaml")
    assert (tmp_path / "again.yaml").read_text() == saved.read_text()


def test_a_saved_scenario_shows_every_default(tmp_path: Path) -> None:
    save_scenario(load_scenario("navigation_open"), tmp_path / "saved.yaml")
    text = (tmp_path / "saved.yaml").read_text()
    for line in ("  gate: 16.27", "  k_a: 2.0", "    wheel_radius: 0.0325", "  patience: 0.5"):
        assert f"\n{line}\n" in text
