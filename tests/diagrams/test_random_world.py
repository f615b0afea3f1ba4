"""Worlds that come from the seed: what is drawn, what is kept, what is saved."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from diagrams.scenario import load_scenario, save_scenario
from diagrams.schema import ScenarioError, to_plain
from diagrams.world import TagList
from plants.random_arena import RandomArenaParameters, random_arena

Writer = Callable[..., Path]

BUNDLED = RandomArenaParameters(size=[6.0, 5.0], obstacles=10, waypoints=3, leg=2.0, passage=0.6)


@pytest.mark.parametrize("seed", [0, 7])
def test_the_scenario_holds_the_room_of_its_seed(seed: int) -> None:
    scenario = load_scenario("navigation_random", [f"seed={seed}"])
    room = random_arena(seed, BUNDLED)
    assert scenario.seed == seed
    assert scenario.world.arena == room.arena
    assert scenario.waypoints == room.waypoints.tolist()
    np.testing.assert_allclose(scenario.robot.start.pose(), room.start, atol=1e-12)
    found = scenario.world.marker_map()
    assert (found.family.name, found.size) == (room.markers.family.name, room.markers.size)
    assert list(found.markers) == list(room.markers.markers)
    for marker in found:
        assert marker.X_WM.IsNearlyEqualTo(room.markers.markers[marker.id].X_WM, 1e-7)
        assert marker.size == room.markers.markers[marker.id].size
    scenario.build()


def test_the_saved_scenario_is_an_ordinary_one_with_the_same_room(tmp_path: Path) -> None:
    scenario = load_scenario("navigation_random", ["seed=5"])
    saved = tmp_path / "saved.yaml"
    save_scenario(scenario, saved)
    assert "random:" not in saved.read_text()
    again = load_scenario(str(saved))
    assert to_plain(again) == to_plain(scenario)
    # Another seed then is other noise in the same room.
    other = load_scenario(str(saved), ["seed=6"])
    assert other.world == scenario.world
    assert other.waypoints == scenario.waypoints
    assert other.seed == 6


def test_who_asks_for_a_random_world_does_away_with_the_one_below(write_scenario: Writer) -> None:
    path = write_scenario("world: {random: {}}\n")
    scenario = load_scenario(str(path))
    room = random_arena(0)
    assert isinstance(scenario.world.markers, TagList)
    assert scenario.world.arena == room.arena
    assert scenario.waypoints == room.waypoints.tolist()
    by_override = load_scenario("navigation_open", ["world.random={}"])
    assert to_plain(by_override.world) == to_plain(scenario.world)
    # All else is as it was.
    below = load_scenario("navigation_open")
    assert scenario.robot.sensors == below.robot.sensors
    assert scenario.robot.body == below.robot.body


def test_what_is_given_beside_it_or_above_it_stays(write_scenario: Writer) -> None:
    path = write_scenario(
        "seed: 2\nwaypoints: [[0.05, 0.1]]\nworld:\n  random: {obstacles: 0, waypoints: 2}\n"
        "  arena: {boxes: [{position: [1.5, 1.0], size: [0.3, 0.3, 0.3]}]}\n"
    )
    scenario = load_scenario(str(path), ["robot.start={x: -2.0, y: 0.5}"])
    room = random_arena(2, RandomArenaParameters(obstacles=0, waypoints=2))
    assert scenario.waypoints == [[0.05, 0.1]]
    assert [box.position for box in scenario.world.arena.boxes] == [[1.5, 1.0]]
    assert scenario.world.arena.walls == room.arena.walls
    start = scenario.robot.start
    # The heading, which nobody gave, is the drawn one.
    assert (start.x, start.y) == (-2.0, 0.5)
    assert np.radians(start.heading_deg) == pytest.approx(room.start[2])
    # An override of one parameter does not do away with what the file gives.
    more = load_scenario(str(path), ["world.random.marker_spacing=1.2"])
    assert more.waypoints == [[0.05, 0.1]]
    assert len(more.world.markers.tags) < len(scenario.world.markers.tags)
    # A scenario on top may give waypoints too.
    top = write_scenario("waypoints: [[0.3, 0.2]]\n", name="top.yaml", extends=str(path))
    assert load_scenario(str(top)).waypoints == [[0.3, 0.2]]


def refusal(name: str | Path, *overrides: str) -> str:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(str(name), overrides)
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("world.random.obstacels=3",
         "--set world.random.obstacels: world.random.obstacels: unknown key; did you mean "
         "'obstacles'?"),
        ("world.random.passage=-1",
         "--set world.random.passage: world.random.passage is -1.0: must be greater than 0"),
        ("world.random.size=6", "--set world.random.size: world.random.size is 6: must be a list"),
        ("world.random.leg=9",
         "world.random: random arena: none of 200 rooms of [6.0, 5.0] m with 10 obstacles has 3 "
         "legs of 9.0 m with a passage of 0.6 m: ask for less"),
        ("seed=1.5", "--set seed: seed is 1.5: must be a whole number"),
        ("waypoints=[[9, 9, 9]]",
         "--set waypoints: waypoints[0] is [9.0, 9.0, 9.0]: must be [x, y] in metres"),
        ("world.arnea={}", "--set world.arnea: world.arnea: unknown key; did you mean 'arena'?"),
    ],
)  # fmt: skip
def test_a_key_that_is_wrong_is_named(override: str, message: str) -> None:
    assert refusal("navigation_random", override).endswith(message)


def test_a_robot_too_large_for_the_room_is_told_where_the_room_was_asked_for(
    write_scenario: Writer,
) -> None:
    path = write_scenario("duration: 9.0\nworld:\n  random: {passage: 0.3}\n")
    said = refusal(path, "robot.body={type: differential_drive, length: 1.6}")
    assert said.startswith(f"{path}:4: ")
    assert "the robot needs 0.80" in said


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("world.arena.boxes=[{position: [0.0, 1.0], size: [0.3, 0.3, 0.3]}]",
         "waypoints[1] = [0, 1] lies in boxes[0]: the robot needs 0.125 m of room"),
        ("world.arena.cylinders=[{position: [-1.8, -1.2], radius: 0.1}]",
         "robot.start = [-1.8, -1.4] is 0.100 m from cylinders[0]: the robot needs 0.125 m of "
         "room"),
        ("world.arena.boxes=[{position: [0.0], size: [0.3, 0.3, 0.3]}]",
         "world.arena.boxes[0].position is [0.0]: must be [x, y] in metres"),
        ("world.arena.cylinders=[{position: [0.0, 0.0]}]",
         "world.arena.cylinders[0] lacks the key 'radius'"),
        ("world.arena.moving=[{radius: 0.1, path: [[0.5, 0]], speed: 0.2}]",
         "world.arena.moving[0].path is [[0.5, 0.0]]: must be at least two points [x, y]"),
        ("world.arena.moving=[{radius: 0.1, path: [[0.5, 0], [1.5, 0]], speed: 0.2}]",
         "world.arena.moving[0]: its path leads through walls[5]: 0.500 m too near"),
    ],
)  # fmt: skip
def test_obstacles_of_nonsense_are_refused_by_name(override: str, message: str) -> None:
    assert refusal("navigation_open", override).endswith(message)
