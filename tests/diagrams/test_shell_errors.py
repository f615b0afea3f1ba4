"""What is wrong with a SnailBot, and who is told: no simulation, only what a scenario resolves to.

The numbers are those of the project's table of errors, written down again here.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from diagrams.drivers.shell_body import SnailBotBody
from diagrams.scenario import load_scenario, save_scenario
from diagrams.schema import ScenarioError
from diagrams.shell_errors import PRESETS, ShellErrors
from systems.estimators.shell_ekf_parameters import ShellEkfParameters
from systems.shell.angles import rotation_vector

DEG = math.pi / 180
BASE = {
    "placement_deg": 0.5,
    "mounting_deg": 1.0,
    "flow_scale": 0.02,
    "gyro_bias_deg_s": 0.3,
    "rock_deg": 0.3,
    "missed_passages": 0.2,
    "delay": 0.0,
    "outliers": 0.0,
}
HARSH = BASE | {
    "placement_deg": 1.0,
    "mounting_deg": 2.0,
    "flow_scale": 0.04,
    "rock_deg": 0.6,
    "missed_passages": 0.5,
    "delay": 0.03,
    "outliers": 0.03,
    "outlier_deg": 8.0,
}
TEAM = "team=[{}, {}, {}]"


def scenario(*overrides: str, name: str = "snailbot") -> Any:
    return load_scenario(name, ["sight=projected", *overrides])


def robot(*overrides: str, name: str = "robot") -> tuple[SnailBotBody, Any, Any]:
    """Body, camera and inertial sensor of a robot as it is built."""
    found = scenario(*overrides)
    parameters = found.robots()[name]
    body = parameters.body.build(**found.world.resources())
    return body, *(parameters.sensors[device].build() for device in ("camera", "imu"))


def injected(*overrides: str) -> dict[str, float]:
    """What is wrong with world and robot, in the terms of `ShellErrors`."""
    body, camera, imu = robot(*overrides)
    parameters = imu.parameters
    assert parameters.gyro_bias == [0.0, 0.0, 0.0]
    (bias,) = set(parameters.gyro_bias_tolerance)
    assert camera.clock_error == camera.latency  # as late as the stamps are wrong, not later
    return {
        "placement_deg": scenario(*overrides).faulty_world().placement_tolerance_deg,
        "mounting_deg": camera.mounting_tolerance_deg,
        "flow_scale": camera.height_tolerance,
        "gyro_bias_deg_s": bias / DEG,
        "rock_deg": body.rocking.bound / DEG,
        "missed_passages": camera.missed_passages,
        "delay": camera.clock_error,
        "outliers": scenario(*overrides).bounds().outliers,
    }


def filter_of(*overrides: str) -> ShellEkfParameters:
    parameters = scenario(*overrides).estimator.arguments["parameters"]
    assert isinstance(parameters, ShellEkfParameters)
    return parameters


# --- What is injected ---


def test_the_presets_are_those_of_the_table() -> None:
    for name, expected in (("base", BASE), ("harsh", HARSH), ("none", dict.fromkeys(BASE, 0.0))):
        found = vars(PRESETS[name])
        assert {key: found[key] for key in expected} == expected, name


@pytest.mark.parametrize("name", ["base", "harsh", "none"])
def test_a_preset_reaches_world_body_camera_and_gyro(name: str) -> None:
    expected = {"base": BASE, "harsh": HARSH, "none": dict.fromkeys(BASE, 0.0)}[name]
    found = injected(f"errors={name}")
    assert found == pytest.approx({key: expected[key] for key in found})


def test_bounds_of_ones_own_are_all_there_is() -> None:
    own = "errors={mounting_deg: 3.0, delay: 0.02}"
    expected = dict.fromkeys(BASE, 0.0) | {"mounting_deg": 3.0, "delay": 0.02}
    assert injected(own) == pytest.approx(expected)
    assert injected("errors.rock_deg=0.9", "errors.delay=0.01") == pytest.approx(
        dict.fromkeys(BASE, 0.0) | {"rock_deg": 0.9, "delay": 0.01}
    )


def test_without_errors_the_devices_say_what_is_wrong() -> None:
    key = "robot.sensors"
    overrides = [
        "errors=null",
        "world.placement_tolerance_deg=0.7",
        "robot.body.rocking.bound=0.002",
        f"{key}.camera.mounting_tolerance_deg=0.4",
        f"{key}.camera.height_tolerance=0.01",
        f"{key}.imu.gyro_bias=[0.01, 0, 0]",
    ]
    body, camera, imu = robot(*overrides)
    assert scenario(*overrides).faulty_world().placement_tolerance_deg == 0.7
    assert body.rocking.bound == 0.002
    assert (camera.mounting_tolerance_deg, camera.height_tolerance) == (0.4, 0.01)
    assert imu.parameters.gyro_bias == [0.01, 0.0, 0.0]
    # With a preset the same tolerances are replaced, the gyro's known bias among them.
    assert injected(*overrides[1:]) == pytest.approx(BASE)


def test_a_camera_slower_than_its_stamps_are_wrong_stays_as_slow() -> None:
    _, camera, _ = robot("errors=harsh", "robot.sensors.camera.latency=0.05")
    assert (camera.latency, camera.clock_error) == (0.05, 0.03)


@pytest.mark.parametrize("key", ["missed_passages", "outliers"])
def test_a_part_is_no_more_than_the_whole(key: str) -> None:
    with pytest.raises(ValueError, match=f"{key} is 1.5: must be 0 to 1"):
        ShellErrors(**{key: 1.5})


def test_errors_that_make_no_sense_are_refused() -> None:
    for key in ("placement_deg", "mounting_deg", "rock_deg", "gyro_bias_deg_s", "delay"):
        for value in (-0.1, math.nan, math.inf):
            with pytest.raises(ValueError, match=key):
                ShellErrors(**{key: value})
    with pytest.raises(ScenarioError, match=r"flow_scale is 0\.6: must be less than 0\.5"):
        scenario("errors={flow_scale: 0.6}")


def test_the_camera_is_mounted_wrongly_within_the_bound_and_by_the_seed() -> None:
    class Station:
        """What a mounting asks of a robot."""

        name = "robot"

    seen = []
    body, camera, _ = robot("errors=base")
    Station.body = body
    planned = camera.planned_mounting(Station)
    for seed in range(200):
        true = camera.true_mounting(Station, seed)
        turn = rotation_vector(true.rotation().matrix() @ planned.rotation().matrix().T)
        lower = true.translation() - planned.translation()
        np.testing.assert_array_equal(lower[:2], 0.0)  # it turns about its own centre
        seen.append([*(turn / DEG), 0.010 / (0.010 + lower[2]) - 1])
    drawn = np.array(seen)
    bounds = np.array([1.0, 1.0, 1.0, 0.02])
    assert (np.abs(drawn) <= bounds * (1 + 1e-9)).all()
    # Evenly: a deviation of a bound / sqrt(3), as far as 200 tell, and no two the same.
    np.testing.assert_allclose(drawn.std(axis=0), bounds / math.sqrt(3), rtol=0.12)
    assert len(np.unique(drawn[:, 0])) == 200
    again = camera.true_mounting(Station, 7)
    assert again.IsExactlyEqualTo(camera.true_mounting(Station, 7))


# --- The team ---


def test_each_robot_stands_on_the_one_before_it() -> None:
    robots = scenario(TEAM).robots()
    assert list(robots) == ["robot", "robot_2", "robot_3"]
    assert [r.start.on for r in robots.values()] == ["reference", "robot", "robot_2"]


def test_each_stands_on_the_one_before_it() -> None:
    robots = scenario("team=[{}, {start: {yaw_deg: 90}}, {start: {on: robot_2}}]").robots()
    assert [robot.start.on for robot in robots.values()] == ["reference", "robot", "robot_2"]


def test_the_camera_predicts_by_the_gyro_of_the_scenario() -> None:
    renamed = "robot.sensors={gyro: bmi088, camera: {type: shell_camera, calibration: ov9281.yaml}}"
    for errors in ("errors=base", "errors=null"):
        _, camera, _ = robot(renamed.replace("gyro", "imu"), errors)
        assert camera.imu == "imu"


def test_a_route_is_driven_twice_only_where_it_ends_as_it_begins() -> None:
    open_one = "team=[{route: [{roll_deg: 0, pitch_deg: 0, yaw_deg: 0, arc_deg: 180}]}]"
    scenario(open_one)
    with pytest.raises(ValueError, match=r"team\[0\].route is .*to be driven 2 times"):
        scenario(open_one, "iterations=2")
    scenario(open_one.replace("180", "360"), "iterations=2")
    scenario("iterations=5")


def test_the_filter_is_told_of_a_delay() -> None:
    told = scenario("errors={delay: 0.1}").estimator.arguments["parameters"]
    assert told.delay_std == 0.1


def test_those_who_carry_do_not_rock() -> None:
    for name, carries in (("robot", True), ("robot_2", True), ("robot_3", False)):
        body, camera, _ = robot(TEAM, "errors=harsh", name=name)
        assert body.carries_shell == carries
        assert body.rocking.bound == pytest.approx(0.0 if carries else 0.6 * DEG)
        assert camera.mounting_tolerance_deg == 2.0  # the rest is wrong with all of them


def test_the_magnets_are_all_as_strong_as_asked() -> None:
    for name in ("robot", "robot_2", "robot_3"):
        assert robot(TEAM, "magnet_force=7.5", name=name)[0].magnets.force == 7.5
        assert robot(TEAM, "robot.body.magnets.force=3", name=name)[0].magnets.force == 3.0


# --- What the filter is told ---


def test_a_filter_is_told_of_the_bounds_that_are_wider_than_its_own() -> None:
    own = ShellEkfParameters()
    found = filter_of("errors=harsh")
    # Evenly within a bound b: a standard deviation of b / sqrt(3).
    assert found.mounting_std == pytest.approx(2.0 * DEG / math.sqrt(3))
    assert found.placement_std == pytest.approx(1.0 * DEG / math.sqrt(3))
    assert found.scale_std == pytest.approx(0.04 / math.sqrt(3))
    assert found.rock_std == pytest.approx(0.6 * DEG / math.sqrt(3))
    assert found.gyro_bias_std == own.gyro_bias_std  # wide enough as it is
    for name in ("none", "base"):
        assert filter_of(f"errors={name}") == filter_of("errors=null"), name


def test_nobody_claims_to_know_more_than_before() -> None:
    own = ShellEkfParameters()
    for name, errors in PRESETS.items():
        told = filter_of(f"errors={name}")
        for key, deviation in errors.priors().items():
            assert getattr(told, key) == max(getattr(own, key), deviation), (name, key)


def test_what_the_user_says_of_the_filter_holds() -> None:
    found = filter_of("errors=harsh", "estimator.mounting_std=0.001")
    assert found.mounting_std == 0.001
    assert found.placement_std == pytest.approx(1.0 * DEG / math.sqrt(3))
    whole = "estimator={type: ekf, mounting_std: 0.001}"
    assert filter_of("errors=harsh", whole).mounting_std == 0.001


def test_the_rule_is_told_nothing() -> None:
    choice = scenario("errors=harsh", "estimator=rule").estimator
    assert choice == scenario("errors=none", "estimator=rule").estimator


# --- Saved and loaded ---


@pytest.mark.parametrize(
    "overrides",
    [
        ["errors=harsh"],
        ["errors=harsh", "estimator.mounting_std=0.001"],
        ["errors={rock_deg: 1.5, outliers: 0.1}", "estimator=rule"],
        ["errors=null", "magnet_force=5", TEAM],
    ],
)
def test_a_saved_scenario_is_loaded_the_same(tmp_path: Path, overrides: list[str]) -> None:
    before = scenario(*overrides)
    save_scenario(before, tmp_path / "scenario.yaml")
    after = load_scenario(str(tmp_path / "scenario.yaml"))
    assert after == before
    assert after.estimator == before.estimator
    assert after.robots() == before.robots()
    assert after.faulty_world() == before.faulty_world()
    # The file says what the filter works with, and nothing is told twice.
    save_scenario(after, tmp_path / "again.yaml")
    assert (tmp_path / "again.yaml").read_text() == (tmp_path / "scenario.yaml").read_text()
