from __future__ import annotations

import math
from dataclasses import asdict
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad

from systems.formation.error_models import (
    RULES,
    FoldedNormalErrors,
    MeasuredErrors,
    ScaledErrors,
    StepErrorParameters,
    chained_errors,
    new_vertex,
    summed_errors,
    unfold,
)
from systems.formation.vertex_walk import VertexWalk, closest_vertex_walk

Array = NDArray[np.float64]

SIDE = 1.5
LATERAL, LONGITUDINAL = (0.036, 0.021), (0.013, 0.009)  # m, the paper's
PATH_1 = 4 * [(12.0, 0.0), (12.0, 6.0), (0.0, 6.0), (0.0, 0.0)]
PATH_2 = [(6.125, 0.65), (6.125, 3.65), (1.125, 3.65), (1.125, 0.65)]
STRIP = [(30.0, 0.65)]


@cache
def walk_along(name: str) -> VertexWalk:
    return closest_vertex_walk({"path 1": PATH_1, "path 2": PATH_2, "strip": STRIP}[name])


def drawn(walk: VertexWalk, runs: int, seed: int = 0, sign: str = "random") -> Array:
    errors = FoldedNormalErrors(parameters=StepErrorParameters(sign=sign))
    return errors.draw(np.random.default_rng(seed), (runs, len(walk)))


# --- The error of one triangle ---


@pytest.mark.parametrize(("mean", "deviation"), [LATERAL, LONGITUDINAL, (5.0, 0.5), (1.0, 0.75)])
def test_unfolded_normal_has_the_moments_when_folded(mean: float, deviation: float) -> None:
    offset, spread = unfold(mean, deviation)

    def moment(order: int) -> float:
        def integrand(x: float) -> float:
            return abs(x) ** order * math.exp(-(((x - offset) / spread) ** 2) / 2)

        ends = offset - 12 * spread, offset + 12 * spread
        area = quad(integrand, *ends, points=[0.0], epsabs=0)[0]
        return float(area / (spread * math.sqrt(2 * math.pi)))

    assert moment(1) == pytest.approx(mean, rel=1e-9)
    assert math.sqrt(moment(2) - moment(1) ** 2) == pytest.approx(deviation, rel=1e-8)


def test_unfolded_ends() -> None:
    assert unfold(0.3, 0.0) == (0.3, 0.0)
    half_normal = math.sqrt(2 / math.pi)
    assert unfold(half_normal, math.sqrt(1 - 2 / math.pi)) == pytest.approx((0.0, 1.0), abs=1e-5)


def test_absolute_errors_are_the_papers() -> None:
    n = 200_000
    errors = FoldedNormalErrors().draw(np.random.default_rng(1), (n,))
    for k, (mean, deviation) in enumerate((LATERAL, LONGITUDINAL)):
        size = np.abs(errors[:, k])
        assert size.mean() == pytest.approx(mean, abs=4 * deviation / math.sqrt(n))
        assert size.std() == pytest.approx(deviation, rel=0.01)
        # Neither side is preferred, whatever the size.
        root_mean_square = math.hypot(mean, deviation)
        assert abs(errors[:, k].mean()) < 4 * root_mean_square / math.sqrt(n)
    assert abs(np.corrcoef(errors.T)[0, 1]) < 4 / math.sqrt(n)
    assert abs(np.corrcoef(np.abs(errors).T)[0, 1]) < 4 / math.sqrt(n)
    # A normal of these numbers, folded, is something else: they are those after folding.
    wrong = np.abs(np.random.default_rng(1).normal(*LONGITUDINAL, n))
    assert abs(wrong.mean() - LONGITUDINAL[0]) > 20 * LONGITUDINAL[1] / math.sqrt(n)


def test_constant_signs() -> None:
    errors = FoldedNormalErrors(parameters=StepErrorParameters(sign="constant"))
    found = errors.draw(np.random.default_rng(2), (100_000,))
    for k, size in enumerate((LATERAL, LONGITUDINAL)):
        offset, spread = unfold(*size)
        assert found[:, k].mean() == pytest.approx(offset, abs=4 * spread / math.sqrt(100_000))
        assert np.abs(found[:, k]).mean() == pytest.approx(size[0], rel=0.01)


def test_measured_errors_are_drawn_together_from_the_trials() -> None:
    trials = np.array([[0.01, -0.02], [0.03, 0.05], [-0.04, 0.0]])
    found = MeasuredErrors(trials).draw(np.random.default_rng(3), (3000, 4))
    assert found.shape == (3000, 4, 2)
    which = (found[:, :, None] == trials).all(axis=3)
    assert (which.sum(axis=2) == 1).all()
    np.testing.assert_allclose(which.mean(axis=(0, 1)), 1 / 3, atol=0.02)


def test_scaled_errors() -> None:
    once, twice = (
        errors.draw(np.random.default_rng(4), (5,))
        for errors in (FoldedNormalErrors(), ScaledErrors(FoldedNormalErrors(), 2.0))
    )
    np.testing.assert_array_equal(twice, 2 * once)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({"lateral_mean": -0.1}, "lateral_mean is -0.1: must be 0 or greater"),
        ({"longitudinal_deviation": 0.0099}, r"longitudinal_deviation is 0.0099: must be at most"),
        ({"sign": "left"}, "sign is 'left': must be one of random, constant"),
    ],
)
def test_parameters_refused(arguments: dict[str, object], line: str) -> None:
    with pytest.raises(ValueError, match=line):
        StepErrorParameters(**{**asdict(StepErrorParameters()), **arguments})


@pytest.mark.parametrize("trials", [[], [1.0, 2.0], [[math.nan, 0.0]]])
def test_trials_refused(trials: list[object]) -> None:
    with pytest.raises(ValueError, match="trials is"):
        MeasuredErrors(trials)


# --- The sum ---


def test_sum_of_a_strip_by_hand() -> None:
    # Along a strip robots head 30 degrees to the right and to the left of it, in turn.
    walk = walk_along("strip")
    lateral, longitudinal = 0.03, 0.01
    errors = np.full((1, len(walk), 2), [lateral, longitudinal])
    summed = summed_errors(walk, errors)[0]
    c, s = math.cos(math.radians(30)), 0.5
    np.testing.assert_allclose(walk.vertices[0], [3.0, 1.5 * c])  # the first heads to the left
    np.testing.assert_allclose(
        summed[0], [longitudinal * c - lateral * s, longitudinal * s + lateral * c]
    )
    pairs = np.arange(1, len(walk) // 2 + 1)[:, None]
    np.testing.assert_allclose(summed[1::2], pairs * [2 * c * longitudinal, 2 * c * lateral])


def test_sum_grows_with_the_root_of_the_moves() -> None:
    walk = walk_along("path 1")
    summed = summed_errors(walk, drawn(walk, 4000))
    squares = (summed**2).sum(axis=2).mean(axis=0)
    step = sum(value**2 for value in (*LATERAL, *LONGITUDINAL))
    # The error of a mean of squares of two normal numbers of unlike size is below sqrt(2 / n).
    expected = step * np.arange(1, len(walk) + 1)
    np.testing.assert_allclose(squares, expected, rtol=5 * math.sqrt(2 / 4000))


@pytest.mark.parametrize(("path", "paper"), [("path 1", 0.535), ("path 2", 0.135)])
def test_sum_reproduces_the_papers_table(path: str, paper: float) -> None:
    walk = walk_along(path)
    summed = summed_errors(walk, drawn(walk, 10_000))
    mean = np.linalg.norm(summed[:, -1], axis=1).mean()
    assert mean == pytest.approx(paper, rel=0.15)


def test_constant_errors_do_not() -> None:
    # Around closed paths they cancel.
    for path, paper in (("path 1", 0.535), ("path 2", 0.135)):
        walk = walk_along(path)
        summed = summed_errors(walk, drawn(walk, 2000, sign="constant"))
        assert abs(np.linalg.norm(summed[:, -1], axis=1).mean() / paper - 1) > 0.15


# --- Where a robot builds its triangle ---


def displaced_beacons(n: int = 500) -> tuple[Array, Array, Array]:
    random = np.random.default_rng(5)
    tip = SIDE * np.array([math.sqrt(3) / 2, 0.5])
    nominal = np.array([tip, tip * [1, -1], [0.0, 0.0]])
    left, right, anchor = nominal[:, None] + random.normal(0, 0.12, (3, n, 2))
    return left, right, anchor


def angle(a: Array, b: Array) -> Array:
    """Returns the angles from a to b, degrees."""
    cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return np.degrees(np.arctan2(cross, (a * b).sum(axis=-1)))


def test_by_bearings_beacons_are_seen_30_degrees_apart() -> None:
    left, right, anchor = displaced_beacons()
    vertex = new_vertex(left, right, anchor)
    # Looking back, what is on the robot's left is to the right.
    np.testing.assert_allclose(angle(left - vertex, anchor - vertex), 30, atol=1e-9)
    np.testing.assert_allclose(angle(anchor - vertex, right - vertex), 30, atol=1e-9)


def test_by_the_edge_sides_are_equal_and_the_anchor_does_not_matter() -> None:
    left, right, anchor = displaced_beacons()
    vertex = new_vertex(left, right, anchor, rule="edge")
    edge = np.linalg.norm(left - right, axis=1)
    np.testing.assert_allclose(np.linalg.norm(left - vertex, axis=1), edge)
    np.testing.assert_allclose(np.linalg.norm(right - vertex, axis=1), edge)
    assert (angle(left - vertex, right - vertex) > 0).all()  # beyond, not on the anchor's side
    np.testing.assert_array_equal(vertex, new_vertex(left, right, anchor + 1, rule="edge"))


@pytest.mark.parametrize("rule", RULES)
def test_turned_scaled_and_mirrored_beacons(rule: str) -> None:
    left, right, anchor = displaced_beacons()
    vertex = new_vertex(left, right, anchor, rule=rule)
    c, s = math.cos(0.7), math.sin(0.7)
    turn = 1.3 * np.array([[c, s], [-s, c]])
    moved = [points @ turn + [3.0, -2.0] for points in (left, right, anchor)]
    np.testing.assert_allclose(
        new_vertex(*moved, rule=rule), vertex @ turn + [3.0, -2.0], atol=1e-9
    )
    mirror = [1.0, -1.0]
    found = new_vertex(right * mirror, left * mirror, anchor * mirror, rule=rule)
    np.testing.assert_allclose(found, vertex * mirror, atol=1e-9)


def test_beacons_on_one_circle_with_the_robot_tell_nothing() -> None:
    # left, anchor and right on the circle on which every point sees them 30 degrees apart.
    at = np.radians([120.0, 180.0, 240.0])
    left, anchor, right = np.stack([np.cos(at), np.sin(at)], axis=1)[:, None]
    radius = np.linalg.norm(new_vertex(left, right, anchor))
    assert np.isnan(radius) or radius == pytest.approx(1.0)


# --- The chain ---


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("robots", [4, 9])
def test_chain_without_errors_is_the_walk(rule: str, robots: int) -> None:
    walk = closest_vertex_walk([(12.0, 0.0), (12.0, 9.0)], robots=robots)
    chain = chained_errors(walk, np.zeros((3, len(walk), 2)), rule=rule)
    # What is rounded grows with the moves, as all errors of a chain.
    np.testing.assert_allclose(chain.errors, 0.0, atol=1e-9)
    assert not chain.broken().any()
    np.testing.assert_allclose(chain.worst_sides, 1.0)


@pytest.mark.parametrize("rule", RULES)
def test_first_move_of_chain_and_sum_agree(rule: str) -> None:
    walk = walk_along("path 2")
    errors = drawn(walk, 50)
    chain = chained_errors(walk, errors, rule=rule)
    np.testing.assert_allclose(chain.errors[:, 0], summed_errors(walk, errors)[:, 0], atol=1e-12)


@pytest.mark.parametrize("rule", RULES)
def test_robots_stand_where_the_errors_say(rule: str) -> None:
    # Whatever happened before: a robot without an error stands as the rule says on the others.
    walk = walk_along("path 2")
    errors = drawn(walk, 20)
    errors[:, 5:] = 0
    chain = chained_errors(walk, errors, rule=rule)
    at = np.repeat(walk.start[None], 20, axis=0)
    for k, mover in enumerate(walk.movers):
        at[:, mover] = vertex = walk.vertices[k] + chain.errors[:, k]
        left, right, anchor = (at[:, beacon] for beacon in walk.beacons[k])
        if k < 5:
            continue
        known = chain.moves > k
        assert known.any()
        if rule == "bearings":
            angles = angle(left - vertex, anchor - vertex), angle(anchor - vertex, right - vertex)
            np.testing.assert_allclose(np.array(angles)[:, known], 30, atol=1e-9)
        else:
            apart = [np.linalg.norm(a - b, axis=1)[known]
                     for a, b in ((left, right), (left, vertex), (right, vertex))]  # fmt: skip
            np.testing.assert_allclose(apart[1:], apart[:1] * 2)


@pytest.mark.parametrize("rule", RULES)
def test_errors_are_along_the_axes_as_they_are(rule: str) -> None:
    walk = walk_along("path 2")
    errors = drawn(walk, 20)
    errors[:, 5] = 0
    without = chained_errors(walk, errors, rule=rule)
    errors[:, 5] = [0.03, 0.04]
    shift = (chained_errors(walk, errors, rule=rule).errors - without.errors)[:, 5]
    at = np.repeat(walk.start[None], 20, axis=0)
    for k, mover in enumerate(walk.movers[:6]):
        at[:, mover] = walk.vertices[k] + without.errors[:, k]
    away = at[:, walk.movers[5]] - at[:, walk.beacons[5, 2]]
    assert angle(away, away[:1]).std() > 2  # degrees; they are not as they should be
    np.testing.assert_allclose(np.linalg.norm(shift, axis=1), 0.05)
    np.testing.assert_allclose(angle(away, shift), math.degrees(math.atan2(0.03, 0.04)))


@pytest.mark.parametrize(("part", "stands"), [(0.601, 1), (0.599, 0), (1.599, 1), (1.601, 0)])
def test_chain_breaks_at_its_limits(part: float, stands: int) -> None:
    # Both sides of the new triangle are as long when the robot stands on its axis, short or beyond.
    walk = closest_vertex_walk([(3.0, 1.3)])
    height = math.sqrt(part**2 - 0.25) - math.sqrt(3) / 2
    errors = np.zeros((3, len(walk), 2))
    errors[1, 0, 1] = height * SIDE
    chain = chained_errors(walk, errors)
    assert chain.moves.tolist() == [1, stands, 1]
    assert chain.broken().tolist() == [False, not stands, False]
    assert chain.worst_sides[1] == pytest.approx(part)
    assert np.isnan(chain.errors[1, 0]).all() == (not stands)
    assert np.isfinite(chain.errors[[0, 2]]).all()


def test_broken_runs_stay_so_and_the_others_do_not_notice() -> None:
    walk = walk_along("path 2")
    errors = drawn(walk, 6)
    alone = chained_errors(walk, errors)
    assert not alone.broken()[1]
    errors[3, 4] = [0.0, SIDE]
    chain = chained_errors(walk, errors)
    assert chain.moves[3] == 4
    assert np.isfinite(chain.errors[3, :4]).all()
    assert np.isnan(chain.errors[3, 4:]).all()
    others = [0, 1, 2, 4, 5]
    np.testing.assert_array_equal(chain.errors[others], alone.errors[others])
    np.testing.assert_array_equal(chain.moves[others], alone.moves[others])


def test_what_stands_on_the_papers_errors_breaks() -> None:
    # Along a strip, nearly all within 40 moves; the edge holds them.
    walk = closest_vertex_walk([(36.0, 0.65)])
    errors = drawn(walk, 1000)
    assert len(walk) > 40
    broken = {rule: (chained_errors(walk, errors, rule=rule).moves < 40).mean() for rule in RULES}
    assert broken["bearings"] > 0.9
    assert broken["edge"] < 0.01


def test_chain_is_far_worse_than_the_sum_while_it_stands() -> None:
    walk = walk_along("path 2")
    errors = drawn(walk, 2000)
    chain = chained_errors(walk, errors)
    whole = ~chain.broken()
    mean = np.linalg.norm(chain.errors[whole, -1], axis=1).mean()
    assert mean > 2 * np.linalg.norm(summed_errors(walk, errors)[:, -1], axis=1).mean()


@pytest.mark.parametrize("model", [summed_errors, chained_errors])
def test_errors_refused(model: object) -> None:
    walk = walk_along("path 2")
    with pytest.raises(
        ValueError, match=r"errors is \(2, 3, 2\): must be of shape \(runs, 15, 2\)"
    ):
        model(walk, np.zeros((2, 3, 2)))  # type: ignore[operator]
    with pytest.raises(ValueError, match="errors is 'not finite'"):
        model(walk, np.full((2, 15, 2), np.nan))  # type: ignore[operator]


def test_rule_refused() -> None:
    walk = walk_along("path 2")
    with pytest.raises(ValueError, match="rule is 'side': must be one of bearings, edge"):
        chained_errors(walk, np.zeros((1, 15, 2)), rule="side")
