"""Journeys by the estimator's word: exact, honest, against the bound; and wrong on purpose."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from systems.estimators.formation_belief import Look
from tests.formation_world import (
    AROUND,
    FRONT_AND_REAR,
    FormationWorld,
    Trip,
    travel,
    vertex,
)

# Bearings of 0.1 degree and distances of 1 % in each of four pictures.
FOUR_PICTURES = (math.radians(0.1) / 2, 0.01 / 2)


def rms(values: object) -> float:
    return math.sqrt(float(np.mean(np.square(values))))


def trips(seeds: range, moves: int, *, frames: int = 1, changes: dict | None = None, **world):  # type: ignore[no-untyped-def]
    made = [FormationWorld(seed=seed, **world) for seed in seeds]
    return made, [travel(w, w.estimator(**(changes or {})), moves, frames=frames) for w in made]


def nees(found: list[Trip]) -> float:
    return float(np.mean([trip.nees for trip in found]))


def test_a_hundred_moves_are_as_exact_as_they_can_be() -> None:
    """75 m; the filter's covariance is the bound of all places and sightings at once."""
    worlds, found = trips(range(8), 100, camera_yaws=AROUND, lasting=FOUR_PICTURES)
    assert rms([np.hypot(*trip.error[-1]) for trip in found]) <= 0.3
    assert 0.8 <= nees(found) <= 1.25
    assert 0.8 <= np.mean([trip.nis for trip in found]) <= 1.25
    world, trip = worlds[0], found[0]
    P = world.batch_covariance(use_range=True)
    where = np.add.outer(3 * np.array(world.epochs), np.arange(3)).ravel()
    bound, said = (np.sqrt(np.diag(C)) for C in (P[np.ix_(where, where)], trip.belief.P[:12, :12]))
    np.testing.assert_allclose(said, bound, rtol=0.05)
    assert bound[3 * 3] < 0.3
    # The sightings were honest; the gate takes one in a thousand of those.
    assert trip.counts["gated"] <= 0.005 * trip.counts["accepted"]
    assert trip.counts["unplaced"] == 0


@pytest.mark.parametrize("use_range", [True, False])
def test_forty_moves_on_noisy_corners_with_the_two_cameras(use_range: bool) -> None:
    """0.5 px, five pictures, front and rear; the true place against the perfect vertex."""
    _, found = trips(range(4), 40, frames=5, changes={"use_range": use_range}, corner_noise=0.5)
    assert rms([trip.destination[-1] for trip in found]) <= 0.10
    assert 0.7 <= nees(found) <= 1.25


def test_cameras_that_are_taken_for_straight_make_it_dishonest() -> None:
    common = {"lasting": FOUR_PICTURES, "yaw_error": 0.01}
    _, honest = trips(range(3), 20, changes={"gate": 1e9}, **common)
    _, wrong = trips(range(3), 20, changes={"gate": 1e9, "yaw_error": 0.0}, **common)
    assert nees(honest) < 1.6
    assert nees(wrong) > 4.0


def test_bearings_of_the_wrong_sign_are_refused() -> None:
    world = FormationWorld(lasting=FOUR_PICTURES)
    trip = travel(
        world,
        world.estimator(),
        4,
        spoil=lambda _, look: look._replace(values=look.values * [-1, 1]),
    )
    assert trip.counts["gated"] > trip.counts["accepted"] / 2
    assert trip.counts["unplaced"] > 0


def test_the_difference_of_two_cameras_is_learnt() -> None:
    """The yaw error that both have is the robot's heading; what differs is seen."""
    world = FormationWorld(lasting=(1e-4, 1e-3), camera_yaws=AROUND, yaw_error=0.01)
    trip = travel(world, world.estimator(), 12)
    found = trip.belief.x[12:].reshape(4, 4)
    difference = (found - world.yaw_errors) @ np.array([1.0, -1.0, 0.0, 0.0])
    assert np.abs(difference).max() < 0.002
    assert np.abs(world.yaw_errors @ np.array([1.0, -1.0, 0.0, 0.0])).max() > 0.008


def misread(number: int) -> Callable[[int, Look], Look]:
    """Takes the first marker in the mover's pictures for one that it does not see."""

    def spoil(move: int, look: Look) -> Look:
        if move != number or look.observer != move % 4 or len(look.markers) < 3:
            return look
        wrong = look.markers.copy()
        others = [m for m in range(16) if m // 4 not in (look.observer, wrong[0] // 4)]
        wrong[0] = next(m for m in others if m not in wrong)
        return look._replace(markers=wrong)

    return spoil


def test_a_misread_marker_is_found_out_when_a_robot_is_placed() -> None:
    for seed in range(3):
        world = FormationWorld(seed=seed, lasting=FOUR_PICTURES, camera_yaws=AROUND)
        trip = travel(world, world.estimator(), 6, spoil=misread(3))
        assert trip.counts["gated"] >= 1
        assert max(map(np.hypot, *np.array(trip.error).T)) < 0.05
        assert np.mean(trip.nees) < 2.0
        # Had it been believed, the robot would be elsewhere.
        world = FormationWorld(seed=seed, lasting=FOUR_PICTURES, camera_yaws=AROUND)
        believed = travel(world, world.estimator(gate=1e9), 6, spoil=misread(3))
        assert np.mean(believed.nees) > 10.0


def test_a_false_bearing_between_robots_that_stand_is_refused() -> None:
    world = FormationWorld(lasting=(1e-4, 1e-3), camera_yaws=AROUND)
    estimator = world.estimator()
    belief = estimator.start()
    estimator.look(belief, 0.1, world.looks(0.1))
    before = belief.x.copy()
    looks = [look._replace(values=look.values + np.array([0.1, 0.0])) for look in world.looks(0.2)]
    counts = estimator.look(belief, 0.2, looks)
    assert counts["accepted"] == 0
    assert counts["gated"] == sum(len(look.markers) for look in looks) > 5
    np.testing.assert_allclose(belief.x, before, atol=1e-8)  # it goes on from where it was


def test_a_hidden_robot_only_has_fewer_sightings() -> None:
    """Nobody sees robot 1; it still sees the others when it is its turn."""
    world = FormationWorld(seed=1, lasting=FOUR_PICTURES, camera_yaws=AROUND, blocked=(1,))
    free = FormationWorld(seed=1, lasting=FOUR_PICTURES, camera_yaws=AROUND)
    hidden, seen = (travel(w, w.estimator(), 12) for w in (world, free))
    assert hidden.counts["unplaced"] == hidden.counts["gated"] == 0
    assert hidden.counts["accepted"] < seen.counts["accepted"]
    assert np.mean(hidden.nees) < 2.0
    assert hidden.deviation[-1] > seen.deviation[-1]
    assert hidden.deviation[-1] < 0.1


def test_one_that_moves_tells_nothing_about_the_others() -> None:
    world = FormationWorld(seed=2, lasting=FOUR_PICTURES, camera_yaws=AROUND)
    estimator = world.estimator()
    belief = estimator.start()
    estimator.look(belief, 0.1, world.looks(0.1))
    estimator.depart(belief, 0, 0.1)
    others = belief.P[3:12, 3:12].copy()
    assert math.sqrt(belief.P[0, 0]) > 5.0
    for k in range(1, 30):  # it drives, and is followed
        world.put(0, world.poses[0] + [0.05, 0.02, 0.0])
        t = 0.1 + 0.1 * k
        estimator.look(belief, t, world.looks(t))
        errors, P = world.errors_of(belief)
        assert np.hypot(*errors[:2]) < 0.05
        assert errors[:3] @ np.linalg.solve(P[:3, :3], errors[:3]) < 22.0
    # As soon as it is not seen any more, the others are known as well as before it moved.
    world.blocked = (0,)
    alone = [look._replace(markers=look.markers[:0], values=look.values[:0])
             if look.observer == 0 else look for look in world.looks(4.0)]  # fmt: skip
    estimator.look(belief, 4.0, alone)
    np.testing.assert_allclose(belief.P[3:12, 3:12], others, rtol=0.02, atol=1e-9)


def test_pictures_from_before_a_move_are_late() -> None:
    world = FormationWorld(lasting=FOUR_PICTURES, camera_yaws=AROUND)
    estimator = world.estimator()
    belief = estimator.start()
    estimator.depart(belief, 0, 1.0)
    counts = estimator.look(belief, 1.1, world.looks(0.9))
    of_mover = sum(
        int((look.markers // 4 == 0).sum()) if look.observer else len(look.markers)
        for look in world.looks(0.9)
    )
    assert counts["late"] == of_mover > 0
    assert estimator.look(belief, 1.2, world.looks(0.9))["accepted"] == 0  # the same again


def test_markers_that_nobody_carries_or_twice_are_dropped() -> None:
    world = FormationWorld()
    estimator = world.estimator()
    belief = estimator.start()
    values = np.zeros((5, 2))
    values[4] = np.nan
    look = Look(0, 0, 0.1, np.array([99, 1, 5, 5, 8]), values)
    counts = estimator.look(belief, 0.1, [look])
    assert counts["unknown_marker"] == 2  # 1 is its own
    assert counts["repeated_marker"] == 2
    assert counts["bad_corners"] == 1
    assert counts["accepted"] == 0


def test_vertices_make_equilateral_triangles() -> None:
    for k in range(6):
        a, b, c = (vertex(k + i)[:2] for i in range(3))
        sides = [np.hypot(*(p - q)) for p, q in ((a, b), (b, c), (c, a))]
        np.testing.assert_allclose(sides, 1.5, rtol=1e-12)
    assert len(FRONT_AND_REAR) == 2


def test_more_robots_know_better_where_the_last_one_is() -> None:
    """Ten moves: the information bound falls with their number, and the estimate follows it."""
    errors, bounds = {}, {}
    for robots in (4, 6, 12):
        trips = []
        for seed in range(6):
            world = FormationWorld(robots=robots, seed=seed, lasting=(0.00035, 0.003))
            trips.append(travel(world, world.estimator(), 10))
        least = world.batch_covariance(use_range=True)[-3:-1, -3:-1]  # of the last vertex
        bounds[robots] = math.sqrt(np.trace(least))
        errors[robots] = math.sqrt(np.mean([(trip.error[-1] ** 2).sum() for trip in trips]))
        assert 0.5 < np.mean([trip.nees for trip in trips]) < 1.5
        assert errors[robots] < 1.5 * bounds[robots]
    assert bounds[12] < bounds[6] < bounds[4]
    assert max(errors[6], errors[12]) < errors[4]
