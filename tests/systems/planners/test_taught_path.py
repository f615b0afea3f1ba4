from __future__ import annotations

import math

import numpy as np
import pytest

from systems.planners.taught_path import STEP, taught_path


def ring(turns: float, radius: float = 2.0, step: float = 0.03) -> tuple[np.ndarray, np.ndarray]:
    a = np.arange(0.0, 2 * math.pi * turns, step / radius)
    poses = np.column_stack([radius * np.cos(a), radius * np.sin(a), a + math.pi / 2])
    return 0.1 * np.arange(len(a)), poses


def test_a_lap_and_a_bit_is_cut_to_a_lap() -> None:
    path = taught_path(*ring(1.1))
    assert path.closed
    assert path.length == pytest.approx(4 * math.pi, rel=2e-3)
    assert path.cut == pytest.approx(0.4 * math.pi, abs=0.05)
    steps = np.linalg.norm(np.diff(path.polyline, axis=0), axis=1)
    np.testing.assert_allclose(steps, STEP, rtol=0.03)


def test_of_many_laps_the_first_counts() -> None:
    assert taught_path(*ring(3.2)).length == pytest.approx(4 * math.pi, rel=2e-3)


def test_a_lap_that_stops_just_short_is_closed_and_a_longer_gap_is_not() -> None:
    near, far = taught_path(*ring(0.975)), taught_path(*ring(0.9))
    assert near.closed
    assert near.length == pytest.approx(4 * math.pi, rel=2e-3)
    assert not far.closed
    assert far.length == pytest.approx(0.9 * 4 * math.pi, abs=0.04)
    assert not taught_path(*ring(1.1), closed=False).closed


def test_the_drift_of_a_lap_leaves_no_step_where_it_closes() -> None:
    t, poses = ring(1.05)
    drift = 0.06 * np.linspace(0, 1, len(poses))[:, None]
    poses[:, :2] *= 1 + drift / 2.0
    path = taught_path(t, poses)
    assert path.closed
    ahead = np.diff(np.vstack([path.polyline, path.points[1:2]]), axis=0)
    turned = np.diff(np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])))
    assert (
        np.abs(turned).max() < 0.3
    )  # a step of 6 cm within one of 5 cm would turn by a right angle


def test_a_path_that_comes_back_the_other_way_is_open() -> None:
    x = np.concatenate([np.arange(0, 2, 0.03), np.arange(2, 0, -0.03)])
    theta = np.where(np.arange(len(x)) < len(x) / 2, 0.0, math.pi)
    poses = np.column_stack([x, 0 * x, theta])
    assert not taught_path(0.1 * np.arange(len(x)), poses).closed


def test_rests_with_noise_add_no_way() -> None:
    _, poses = ring(0.5)
    rest = np.tile(poses[50], (400, 1))
    rest[:, :2] += np.random.default_rng(0).normal(0, 0.003, (400, 2))
    poses = np.vstack([poses[:50], rest, poses[50:]])
    assert taught_path(0.1 * np.arange(len(poses)), poses).length == pytest.approx(
        2 * math.pi, abs=0.03
    )


def test_the_nearest_place_of_a_ring_lies_on_the_ray_from_its_centre() -> None:
    path = taught_path(*ring(1.1))
    a = np.linspace(0.1, 6, 30)
    place, direction, run = path.nearest(1.7 * np.column_stack([np.cos(a), np.sin(a)]))
    np.testing.assert_allclose(np.linalg.norm(place, axis=1), 2.0, atol=2e-3)
    np.testing.assert_allclose(run, 2.0 * a, atol=0.03)
    np.testing.assert_allclose((place * direction).sum(axis=1), 0.0, atol=0.06)


def spoiled(change: str) -> tuple[np.ndarray, np.ndarray]:
    t, poses = ring(1.1)
    if change == "short":
        return t[:40], poses[:40]
    if change == "jump":
        poses[100:, 0] += 1.0
    if change == "backwards":
        poses[:, 2] += math.pi
    return t, poses


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("short", r"is 1\.17 m long: must be 1\.5 m or more"),
        ("jump", r"jumps by 0\.97 m from t = 9\.90 s to 10\.00 s"),
        ("backwards", "driven backwards"),
    ],
)
def test_what_is_no_path_to_follow_is_refused(change: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        taught_path(*spoiled(change))


def test_an_open_path_is_not_closed_on_demand() -> None:
    with pytest.raises(ValueError, match="to be closed"):
        taught_path(*ring(0.5), closed=True)


def test_noise_neither_lengthens_the_path_nor_bends_it() -> None:
    t, poses = ring(1.1)
    poses[:, :2] += np.random.default_rng(1).normal(0, 0.015, (len(poses), 2))
    path = taught_path(t, poses)
    assert path.closed
    assert path.length == pytest.approx(4 * math.pi, rel=0.015)
    np.testing.assert_allclose(np.linalg.norm(path.points, axis=1), 2.0, atol=0.03)
