"""Which markers of a picture serve to be located by."""

from __future__ import annotations

import numpy as np
import pytest

from systems.markers.sifting import SIFTED, sift

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def squares(*sides):
    return np.array([100.0 + 40 * k + side * SQUARE for k, side in enumerate(sides)])


def none_but(**dropped):
    return {**dict.fromkeys(SIFTED, 0), **dropped}


def test_the_largest_come_first_and_equal_ones_in_their_order():
    order, dropped = sift(np.arange(5), squares(20, 30, 20, 50, 30), 12.0)
    assert order.tolist() == [3, 1, 4, 0, 2]
    assert dropped == none_but()


def test_each_counts_for_the_first_reason_that_holds():
    known = np.array([7, -1, 3, 3, 5, 6, 8, -1])
    corners = squares(20, 30, 40, 40, 20, 5, 30, 5)
    corners[[1, 2, 4], 2, 1] = np.nan
    order, dropped = sift(known, corners, 12.0)
    assert order.tolist() == [6, 0]
    assert dropped == none_but(unknown_id=2, repeated_id=2, bad_corners=1, too_small=1)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("corner", range(4))
@pytest.mark.parametrize("axis", range(2))
def test_a_corner_that_is_no_place_spoils_its_marker_alone(corner, axis, bad):
    corners = squares(20, 30)
    corners[1, corner, axis] = bad
    order, dropped = sift(np.array([4, 9]), corners, 12.0)
    assert order.tolist() == [0]
    assert dropped == none_but(bad_corners=1)


def test_the_shortest_side_decides_whichever_it_is():
    for turn in range(4):
        corners = squares(20)
        corners[0, turn] += 0.5 * (corners[0, turn - 1] - corners[0, turn])
        assert sift(np.array([0]), corners, 10.1)[1] == none_but(too_small=1)
        assert sift(np.array([0]), corners, 10.0)[1] == none_but()


def test_it_agrees_with_sorting_all_areas():
    rng = np.random.default_rng(0)
    for _ in range(50):
        corners = squares(*rng.uniform(5, 60, 12)) + rng.normal(0, 2, (12, 4, 2))
        known = rng.integers(-1, 20, 12)
        order, dropped = sift(known, corners, 12.0)
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).min(axis=1)
        once = np.array([(known == k).sum() == 1 for k in known])
        serves = np.flatnonzero((known >= 0) & once & (edges >= 12))
        x, y = corners[serves].transpose(2, 0, 1)
        areas = abs((x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1)) / 2
        assert order.tolist() == serves[np.argsort(-areas, kind="stable")].tolist()
        assert sum(dropped.values()) == 12 - len(order)


def test_no_marker_at_all():
    order, dropped = sift(np.zeros(0, np.intp), np.zeros((0, 4, 2)), 12.0)
    assert (len(order), dropped) == (0, none_but())
