from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from diagrams.drivers.camera import R_FORWARD_OPTICAL
from diagrams.schema import file_path
from plants.arena import ArenaParameters, check_free, check_markers
from plants.obstacles import Wall
from plants.random_arena import (
    RandomArena,
    RandomArenaParameters,
    free_regions,
    random_arena,
)
from systems.cameras import load_camera
from systems.markers.visibility import ProjectorParameters, visible_markers
from systems.raycasting import Solids

SEEDS = range(12)


@pytest.fixture(scope="module")
def rooms() -> list[RandomArena]:
    return [random_arena(seed) for seed in SEEDS]


def test_a_seed_gives_the_same_room_and_another_seed_another() -> None:
    first, again, other = random_arena(3), random_arena(3), random_arena(4)
    assert first.arena == again.arena
    assert first.markers.to_json() == again.markers.to_json()
    np.testing.assert_array_equal(first.start, again.start)
    np.testing.assert_array_equal(first.waypoints, again.waypoints)
    assert first.arena != other.arena


def test_there_is_what_was_asked_for() -> None:
    p = RandomArenaParameters(
        size=[5.0, 4.0], obstacles=7, cylinder_share=3 / 7, box_side=[0.3, 0.4], radius=[0.1, 0.12],
        height=0.7, waypoints=5, leg=1.2, marker_size=0.1, marker_spacing=1.0, marker_height=0.4,
    )  # fmt: skip
    for seed in SEEDS:
        room = random_arena(seed, p)
        arena = room.arena
        assert (len(arena.walls), len(arena.boxes), len(arena.cylinders)) == (4, 4, 3)
        assert all(0.3 <= side <= 0.4 for box in arena.boxes for side in box.size[:2])
        assert all(0.1 <= cylinder.radius <= 0.12 for cylinder in arena.cylinders)
        assert {wall.height for wall in arena.walls} == {0.7}
        assert {cylinder.height for cylinder in arena.cylinders} == {0.7}
        assert {box.size[2] for box in arena.boxes} == {0.7}
        assert room.waypoints.shape == (5, 2)
        stops = np.vstack([room.start[:2], room.waypoints])
        assert (np.linalg.norm(np.diff(stops, axis=0), axis=1) >= 1.2).all()
        assert {m.size for m in room.markers} == {0.1}
        assert {m.X_WM.translation()[2] for m in room.markers} == {0.4}
        # The room is as large between its walls as was asked for.
        inside = arena.footprints().distances_from(np.array([[-2.49, 0.0], [0.0, 1.99]]))
        assert inside[:4].min() == pytest.approx(0.01)


def test_obstacles_keep_apart(rooms: list[RandomArena]) -> None:
    for room in rooms:
        plan = room.arena.footprints()
        gaps = plan.distances(plan)
        gaps[:4, :4] = 1.0  # the walls meet
        assert gaps[~np.eye(len(gaps), dtype=bool)].min() >= 0.1 - 1e-9


def test_every_leg_can_be_driven_by_a_disc_as_wide_as_the_passage(
    rooms: list[RandomArena],
) -> None:
    """By another way than the generator's: a search over a coarser graph of straight moves."""
    for room in rooms:
        plan = room.arena.footprints()
        stops = np.vstack([room.start[:2], room.waypoints])
        step = 0.05
        seen = {(0, 0)}
        front = [(0, 0)]
        left = set(range(1, len(stops)))
        while front and left:
            i, j = front.pop()
            here = stops[0] + step * np.array([i, j])
            left -= {k for k in left if np.linalg.norm(stops[k] - here) < 2 * step}
            ahead = [(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)]
            moves = [move for move in ahead if move not in seen]
            if moves:
                ends = stops[0] + step * np.array(moves)
                middles = (ends + here) / 2
                room_for = np.minimum(
                    plan.distances_from(ends).min(axis=0), plan.distances_from(middles).min(axis=0)
                )
                free = [m for m, gap in zip(moves, room_for, strict=True) if gap >= 0.3 - 0.015]
                seen |= set(free)
                front += free
        assert not left
        for stop in stops:
            check_free(room.arena, stop.tolist(), 0.3, "stop")


def test_a_wall_with_a_door_parts_regions_when_the_passage_is_wider_than_the_door() -> None:
    def room(door: float) -> ArenaParameters:
        return ArenaParameters(
            walls=[
                Wall(start=[0.0, -2.0], end=[0.0, -door / 2]),
                Wall(start=[0.0, door / 2], end=[0.0, 2.0]),
            ]
        )

    def regions(door: float, passage: float) -> tuple[int, int]:
        x, y, numbers = free_regions(room(door), [4.0, 4.0], passage)
        row = int(np.argmin(np.abs(y)))
        west, east = (int(np.argmin(np.abs(x - side))) for side in (-1.5, 1.5))
        return int(numbers[row, west]), int(numbers[row, east])

    for door, passage, through in ((0.7, 0.6, True), (0.65, 0.6, True), (0.59, 0.6, False)):
        west, east = regions(door, passage)
        assert min(west, east) > 0
        assert (west == east) == through


def test_markers_can_be_put_there_and_none_is_hidden(rooms: list[RandomArena]) -> None:
    for room in rooms:
        check_markers(room.arena, room.markers)
        plan = room.arena.footprints()
        for marker in room.markers:
            normal = marker.X_WM.rotation().matrix()[:2, 0]
            place = marker.X_WM.translation()[:2]
            # Something carries it, and nothing stands right before it.
            before, behind = place + 0.15 * normal, place - 0.01 * normal
            assert plan.distances_from(before[None]).min() > 0.1
            assert plan.distances_from(behind[None]).min() < 0


def test_some_marker_is_seen_from_most_places(rooms: list[RandomArena]) -> None:
    """With the bundled robot's camera, from places where it may be, looking anywhere."""
    camera = load_camera(file_path("vga.yaml", "cameras"))
    rng = np.random.default_rng(0)
    sees, turning = [], []
    for room in rooms[:4]:
        obstacles = [obstacle for _, obstacle in room.arena.standing()]
        solids = Solids([o.shape() for o in obstacles], [o.pose() for o in obstacles])
        X_WM = np.array([m.X_WM.GetAsMatrix34() for m in room.markers])
        x, y, regions = free_regions(room.arena, [6.0, 5.0], 0.6)
        rows, columns = np.nonzero(regions)
        for k in rng.integers(len(rows), size=25):
            at_this_place = []
            for heading in rng.uniform(-math.pi, math.pi) + np.arange(8) * math.pi / 4:
                R = RollPitchYaw(0.0, 0.0, heading).ToRotationMatrix() @ R_FORWARD_OPTICAL
                seen = visible_markers(
                    camera=camera,
                    X_WC=RigidTransform(R, [x[columns[k]], y[rows[k]], 0.12]),
                    X_WM=X_WM,
                    sizes=np.full(len(X_WM), 0.15),
                    cells=room.markers.family.cells,
                    parameters=ProjectorParameters(min_side_px=10.0),
                    solids=solids,
                )
                at_this_place.append(len(seen.index) > 0)
            sees += at_this_place
            turning.append(any(at_this_place))
    assert np.mean(sees) > 0.9
    assert all(turning)


def test_rooms_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match=r"random arena: none of 200 rooms of \[2, 2\] m with 30"):
        random_arena(0, RandomArenaParameters(size=[2, 2], obstacles=30, leg=0.5))
    with pytest.raises(ValueError, match=r"none of 200 rooms .* 1 legs of 9\.0 m"):
        random_arena(0, RandomArenaParameters(size=[3, 3], obstacles=0, waypoints=1, leg=9.0))
    with pytest.raises(ValueError, match="markers, and DICT_4X4_50 has 50: take another family"):
        random_arena(0, RandomArenaParameters(family="4x4_50", marker_spacing=0.3))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"size": [6.0]}, r"size is \[6.0\]: must be two numbers greater than 0"),
        ({"size": [6.0, math.inf]}, "size is .*: must be two numbers greater than 0"),
        ({"box_side": [0.5, 0.3]}, r"box_side is \[0.5, 0.3\]: must be \[least, greatest\]"),
        ({"radius": [0.0, 0.3]}, "radius is .*: must be two numbers greater than 0"),
        ({"obstacles": -1}, "obstacles is -1: must be 0 or greater"),
        ({"cylinder_share": 1.1}, "cylinder_share is 1.1: must be 0 to 1"),
        ({"waypoints": 0}, "waypoints is 0: must be 1 or greater"),
        ({"leg": -1.0}, "leg is -1.0: must be 0 or greater"),
        ({"passage": 0.0}, "passage is 0.0: must be greater than 0"),
        ({"marker_spacing": 0.0}, "marker_spacing is 0.0: must be greater than 0"),
        ({"marker_height": 0.05}, "marker_height is 0.05: must be from 0.1 to 0.4 m"),
        ({"height": 0.3}, "marker_height is 0.25: must be from 0.1 to 0.2 m"),
        ({"family": "4x4_51"}, "family is '4x4_51': unknown"),
    ],
)
def test_nonsense_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RandomArenaParameters(**change)
