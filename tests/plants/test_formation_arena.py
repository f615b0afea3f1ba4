from __future__ import annotations

import itertools

import numpy as np
import pytest

from plants.formation_arena import FormationArenaParameters, formation_arena, known_obstacles
from plants.planar_shapes import PlanarShapes
from systems.planners.formation_ground import FormationParameters
from systems.planners.formation_lattice import fit_lattice
from systems.planners.formation_obstacles import clearance
from tests.systems.planners.formations import fewest_moves


def test_a_seed_repeats_its_arena_and_another_gives_another() -> None:
    first, again, other = (formation_arena(seed) for seed in (3, 3, 4))
    assert first.arena == again.arena
    np.testing.assert_array_equal(first.start, again.start)
    np.testing.assert_array_equal(first.way, again.way)
    assert first.arena != other.arena


@pytest.mark.parametrize("seed", range(10))
def test_a_search_of_its_own_finds_a_way(seed: int) -> None:
    made = formation_arena(seed)
    room = FormationParameters().room
    found = fewest_moves(made.start, made.destination, made.arena.footprints(), room)
    assert found is not None
    assert found <= len(made.way) - 2


@pytest.mark.parametrize("seed", range(10))
def test_the_hidden_way_is_one(seed: int) -> None:
    made = formation_arena(seed)
    parameters = FormationParameters()
    covered = made.arena.footprints()
    fit_lattice(made.start, parameters.side)  # raises if they are no formation
    first_two = {tuple(p) for p in made.way[:2].reshape(-1, 2).round(6)}
    assert {tuple(p) for p in made.start.round(6)} == first_two
    assert np.linalg.norm(made.way[-1] - made.destination, axis=1).min() < 1e-9
    for triangle in made.way:
        for a, b in itertools.combinations(triangle, 2):
            assert np.linalg.norm(a - b) == pytest.approx(parameters.side)
        assert covered.distances_from(triangle).min() >= parameters.room
    for one, two in itertools.pairwise(made.way):
        assert len({tuple(p) for p in np.concatenate([one, two]).round(6)}) == 4  # share a side
        # Who takes the new corner drives past it before it backs in.
        near = np.linalg.norm(two[:, None] - one, axis=2).min(axis=1)
        new = two[near.argmax()]
        ahead = new - two[near < 0.1].mean(axis=0)
        past = new + parameters.beyond * ahead / np.linalg.norm(ahead)
        assert covered.distances_from(past[None]).min() >= parameters.room
    distance = np.linalg.norm(made.destination - made.start.mean(axis=0))
    assert distance >= FormationArenaParameters().distance


def test_known_obstacles_are_the_footprints() -> None:
    made = formation_arena(1)
    obstacles = known_obstacles(made.arena, stamp=2.0)
    covered = made.arena.footprints()
    assert len(obstacles) == len(covered)
    assert obstacles.stamp == 2.0
    for point in np.random.default_rng(0).uniform(-8, 8, (200, 2)):
        expected = covered.distances_from(point[None]).min()
        assert max(clearance(obstacles, point, point), 0) == pytest.approx(max(expected, 0))


def test_wider_robots_get_a_wider_way() -> None:
    wide = FormationParameters(robot_radius=0.3, safety=0.3)
    made = formation_arena(2, formation=wide)
    for triangle in made.way:
        assert made.arena.footprints().distances_from(triangle).min() >= 0.6


def test_slack_is_more_room_beside_the_way() -> None:
    made, tight = formation_arena(1, FormationArenaParameters(slack=0.2)), formation_arena(1)
    wide = FormationParameters().room + 0.2
    found = fewest_moves(made.start, made.destination, made.arena.footprints(), wide)
    assert found is not None
    assert fewest_moves(tight.start, tight.destination, tight.arena.footprints(), wide) is None


def test_all_obstacles_are_in_the_room_and_of_their_sizes() -> None:
    parameters = FormationArenaParameters(size=[12.0, 10.0], obstacles=20, distance=4.0)
    arena = formation_arena(0, parameters).arena
    assert 0 < len(arena.boxes) + len(arena.cylinders) <= 20
    for obstacle in (*arena.boxes, *arena.cylinders):
        assert abs(obstacle.position[0]) <= 6.0
        assert abs(obstacle.position[1]) <= 5.0
    assert all(0.15 <= c.radius <= 0.4 for c in arena.cylinders)
    room = PlanarShapes.joined([wall.footprint() for wall in arena.walls])
    assert room.distances_from(np.zeros((1, 2))).min() == pytest.approx(5.0)


def test_a_room_without_a_way_is_refused() -> None:
    with pytest.raises(ValueError, match="has no way over 8"):
        formation_arena(0, FormationArenaParameters(size=[4.0, 4.0]))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("size", [1.0]),
        ("box_side", [2.0, 1.0]),
        ("radius", [0.0, 1.0]),
        ("obstacles", -1),
        ("cylinder_share", 1.5),
        ("stops", -1),
        ("distance", 0.0),
        ("height", -1.0),
        ("slack", -0.1),
    ],
)
def test_nonsense_is_refused(field: str, value: object) -> None:
    with pytest.raises(ValueError, match=rf"{field} is .*: must be"):
        FormationArenaParameters(**{field: value})  # type: ignore[arg-type]
