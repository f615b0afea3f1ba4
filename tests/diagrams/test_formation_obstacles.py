"""A formation among obstacles: known and sensed ones, what they hide, arenas from the seed."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from diagrams.run import Run, simulate
from diagrams.scenario import load_scenario, save_scenario
from diagrams.schema import ScenarioError, to_plain
from plants.formation_arena import FormationArenaParameters, formation_arena, known_obstacles
from plants.random_arena import random_arena
from systems.planners.formation_lattice import strip
from systems.planners.formation_obstacles import Obstacles, clearance

PROJECTED = {"sight": "projected", "record.bag": False}
# Where the first robot would go.
BOX = {"world.arena.boxes": [{"position": [3.0, 1.3], "size": [0.4, 0.4, 0.5]}]}


def value(run: Run, port: str) -> Any:
    return run.mission._wiring.value(port, run.context)  # type: ignore[attr-defined]


@pytest.fixture(scope="module")
def heard() -> Run:
    """Four seconds with a box that nobody has told the robots of."""
    return simulate(load_scenario("formation_obstacles", PROJECTED | BOX | {"duration": 4.0}))


def test_what_the_robots_hear_is_what_stands_there(heard: Run) -> None:
    obstacles: Obstacles = value(heard, "obstacles.obstacles")
    assert 0.0 < obstacles.stamp < 4.0
    for x, y in [(2.8, 1.3), (2.8, 1.2), (2.85, 1.1)]:  # that side is the robots'
        at = np.array([x, y])
        assert clearance(obstacles, at, at) < 0.1
    for place in strip(4, 1.5):
        assert clearance(obstacles, place, place) > 0.35
    counts = heard.report["health"]["obstacles"]
    assert counts["on_robot"] > 0
    assert counts["stale_scan"] == counts["garbled_scan"] == counts["bad_reading"] == 0


def test_nobody_goes_where_something_was_heard(heard: Run) -> None:
    move = value(heard, "planner.move")
    assert move.status == "moving"
    assert np.hypot(*(move.target - [3.0, 1.3])) > 1.0
    assert heard.report["metrics"]["contacts"] == 0
    # Without the box it is where the first robot goes.
    free = load_scenario("formation_obstacles", PROJECTED | {"duration": 2.0})
    free.world.arena.boxes.clear()
    move = value(simulate(free), "planner.move")
    np.testing.assert_allclose(move.target, [3.0, 1.299], atol=1e-3)


def test_known_obstacles_are_those_of_the_arena() -> None:
    scenario = load_scenario("formation", PROJECTED | BOX | {"duration": 0.5})
    run = simulate(scenario)
    obstacles: Obstacles = value(run, "obstacles.y0")
    known = known_obstacles(scenario.world.arena)
    np.testing.assert_array_equal(obstacles.polygons, known.polygons)
    assert np.hypot(*(value(run, "planner.move").target - [3.0, 1.3])) > 1.0
    hull = run.report["metrics"]["min_clearance_m"]
    # Robot 3, at (2.25, 0), is the nearest, 0.26 m long and 0.3 m wide; the box from (2.8, 1.1).
    assert hull == pytest.approx(math.hypot(0.55 - 0.13, 1.1 - 0.15), abs=0.01)


@pytest.mark.parametrize("sight", ["projected", "rendered"])
def test_an_obstacle_hides_what_is_behind_it(sight: str) -> None:
    """Robot 1 looks along x at robot 3, whose markers are 8 to 11."""

    def seen(boxes: list[Any]) -> set[int]:
        overrides = {"sight": sight, "duration": 0.3, "world.arena.boxes": boxes}
        run = simulate(load_scenario("formation", PROJECTED | overrides))
        station = run.mission.station
        port = station.GetOutputPort("robot1.front_camera.detections")
        found = port.Eval(station.GetMyContextFromRoot(run.context))
        assert np.isfinite(found.stamp)
        return set(found.ids.tolist())

    third = set(range(8, 12))
    box = {"position": [1.5, 0.0], "size": [0.2, 0.5, 0.5]}
    assert seen([]) & third
    assert not seen([box]) & third
    assert seen([box | {"size": [0.2, 0.5, 0.1]}]) & third  # one can look over it


def test_a_robot_that_touches_something_has_failed() -> None:
    """A post by the way, which would be free for a robot as slim as the planner is told."""
    post = {"position": [0.58, 1.104], "radius": 0.05, "height": 0.3}
    slim = {"robot_radius": 0.05, "safety": 0.0, "sight_margin": 0.0}
    run = simulate(
        load_scenario(
            "formation",
            PROJECTED | {"world.arena.cylinders": [post], "formation": slim, "duration": 16.0},
        )
    )
    assert run.report["metrics"]["contacts"] > 0
    assert run.report["metrics"]["min_clearance_m"] < 0.01
    assert run.report["outcome"] == "contact"
    assert not run.succeeded


# --- Arenas from the seed ---


@pytest.mark.parametrize("seed", [0, 7])
def test_the_scenario_holds_the_arena_of_its_seed(seed: int) -> None:
    scenario = load_scenario("formation_clutter", [f"seed={seed}"])
    drawn = formation_arena(seed, FormationArenaParameters(slack=0.1))
    assert scenario.world.arena == drawn.arena
    np.testing.assert_allclose(scenario.places(), drawn.start, atol=1e-4)
    np.testing.assert_allclose(scenario.destination, drawn.destination, atol=1e-4)
    assert scenario.obstacles == "known"


def test_the_saved_scenario_is_an_ordinary_one_with_the_same_arena(tmp_path: Path) -> None:
    scenario = load_scenario("formation_clutter", ["seed=5", "formation.side=1.2"])
    saved = tmp_path / "saved.yaml"
    save_scenario(scenario, saved)
    assert "random:" not in saved.read_text()
    assert to_plain(load_scenario(str(saved))) == to_plain(scenario)
    # The triangles are those that were asked for.
    sides = np.linalg.norm(np.diff(scenario.places(), axis=0), axis=1)
    assert sides.min() == pytest.approx(1.2, abs=1e-3)


def test_each_mission_draws_its_own_kind_of_world() -> None:
    room = load_scenario("navigation_open", ["world.random={}"])
    assert room.world.arena == random_arena(0).arena
    clutter = load_scenario("formation", ["world.random={obstacles: 5}"])
    five = FormationArenaParameters(obstacles=5)
    assert clutter.world.arena == formation_arena(0, five).arena
    assert clutter.world.markers.family == "36h11"  # nothing that is not drawn is lost
    # What is given on top stays.
    there = clutter.start[2]
    same = load_scenario("formation", ["world.random={obstacles: 5}", f"destination={there}"])
    assert same.destination == there
    assert same.start == clutter.start


def refusal(name: str, *overrides: str) -> str:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(name, overrides).build()
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("world.random.stop=3",
         "--set world.random.stop: world.random.stop: unknown key; did you mean 'stops'?"),
        ("world.random.distance=60", "world.random: formation arena: a room of [18.0, 14.0] m has "
         "no way over 60.0 m for triangles of 1.5 m: ask for less"),
        ("world.random.radius=[0.4, 0.1]",
         "world.random.radius is [0.4, 0.1]: must be [least, greatest]"),
        ("formation.side=-1", "formation.side is -1.0: must be greater than 0"),
        ("controller.beyond=0.3", "formation.beyond is 0.2: must be at least 0.3 m, by which the "
         "controller drives past its vertex"),
        ("robots=6", "must be places of all 6 robots"),
        ("obstacles=guessed", "obstacles is 'guessed': must be one of known, sensed"),
        ("sonar.miss=-0.1", "sonar.miss is -0.1: must be less than -0.45"),
        ("robot.sensors.sonar.range_max=4",
         "robot.sensors.sonar: range_max is 4.0: must be at most 2.68 m, "
         "where the cones meet the floor from 0.35 m above it"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(override: str, message: str) -> None:
    assert message in refusal("formation_clutter", override)


def test_sensed_obstacles_take_something_to_sense_with() -> None:
    assert refusal("formation", "obstacles=sensed").endswith(
        "robot.sensors is ['front_camera', 'rear_camera']: must be with a ring of range finders "
        "(type: ultrasonic), or obstacles: known"
    )


@pytest.mark.parametrize("name", ["formation_obstacles", "formation_clutter"])
def test_a_destination_inside_an_obstacle_is_refused(
    tagtrail: Callable[..., Any], name: str, tmp_path: Path
) -> None:
    box = load_scenario(name).world.arena.boxes[0]
    result = tagtrail(
        "run", name, "--no-meshcat", "--set", f"destination={box.position}", "--out", tmp_path
    )
    assert result.status == 2
    (line,) = result.err.strip().splitlines()
    assert line.startswith("tagtrail: --set destination: destination = [")
    assert "lies in boxes[0]: the robot needs 0.200 m of room" in line
