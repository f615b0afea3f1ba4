from __future__ import annotations

import math

import numpy as np
import pytest

from systems.planners.formation_lattice import (
    TriangleLattice,
    bodies_of,
    body_of,
    fit_lattice,
    mirrored,
    strip,
    triangles_of,
)

PAPER = np.array([[0.75, 0.0], [0.0, 1.30], [2.25, 0.0], [1.5, 1.30]])


def test_the_paper_s_start_is_a_rhombus_of_four() -> None:
    lattice, vertices = fit_lattice(PAPER, 1.5)
    assert len(set(vertices)) == 4
    assert len(triangles_of(vertices)) == 2
    # Its heights are rounded to a centimetre: 1.30 for 1.299.
    np.testing.assert_allclose(lattice.positions(np.array(vertices)), PAPER, atol=1e-3)
    np.testing.assert_allclose(strip(4, 1.5), PAPER, atol=1e-3)


def test_more_robots_stand_behind_the_papers_four() -> None:
    places = strip(7, 1.5)
    np.testing.assert_allclose(places[:4], PAPER, atol=1e-3)
    behind = [[-0.75, 0.0], [-1.5, 1.299], [-2.25, 0.0]]
    np.testing.assert_allclose(places[4:], behind, atol=1e-3)


def test_two_steps_of_the_lattice_are_sixty_degrees_apart() -> None:
    lattice = TriangleLattice((1.0, 2.0), math.radians(90.0), 2.0)
    places = lattice.positions(np.array([[0, 0], [1, 0], [0, 1]]))
    np.testing.assert_allclose(places, [[1, 2], [1, 4], [1 - math.sqrt(3), 3]], atol=1e-12)


def test_nearest_is_the_nearest_of_all() -> None:
    random = np.random.default_rng(1)
    lattice = TriangleLattice((0.3, -0.2), 0.7, 1.5)
    points = random.uniform(-6, 6, (300, 2))
    found, distances = lattice.nearest(points)
    grid = np.stack(np.meshgrid(np.arange(-12, 13), np.arange(-12, 13)), axis=-1).reshape(-1, 2)
    apart = np.linalg.norm(lattice.positions(grid)[None] - points[:, None], axis=2)
    np.testing.assert_allclose(distances, apart.min(axis=1), atol=1e-12)
    np.testing.assert_array_equal(found, grid[apart.argmin(axis=1)])
    assert distances.max() <= 1.5 / math.sqrt(3) + 1e-9  # no place is farther from a vertex


@pytest.mark.parametrize("robots", [3, 4, 5, 6, 12, 19, 20])
def test_a_strip_fits_wherever_it_lies(robots: int) -> None:
    random = np.random.default_rng(robots)
    angle, shift = random.uniform(-math.pi, math.pi), random.uniform(-9, 9, 2)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    places = strip(robots, 1.2) @ turn.T + shift
    lattice, vertices = fit_lattice(places, 1.2)
    np.testing.assert_allclose(lattice.positions(np.array(vertices)), places, atol=1e-9)
    assert len(triangles_of(vertices)) == robots - 2
    noisy = places + random.normal(0, 0.03, places.shape)
    assert len(body_of(fit_lattice(noisy, 1.2)[1])) == robots


@pytest.mark.parametrize(
    "places",
    [
        PAPER[:2],  # two are no triangle
        [[0, 0], [1.5, 0], [0, 1.5], [1.5, 1.5]],  # a square
        [[0, 0], [1.5, 0], [3.0, 0], [4.5, 0]],  # a row
        PAPER * 1.5,  # too large
        [*PAPER[:3], PAPER[2]],  # two robots in one place
        [*PAPER[:3], [9.75, 0.0]],  # one on the lattice, but alone
        [*PAPER[:3], [math.nan, 0.0]],
    ],
)
def test_no_formation_is_refused(places: list[list[float]]) -> None:
    with pytest.raises(ValueError, match=r"positions is .* triangles of 1.5 m"):
        fit_lattice(places, 1.5)


def test_a_mirror_image_lies_across_the_side() -> None:
    lattice = TriangleLattice((0.0, 0.0), 0.4, 1.5)
    p, q, r = (2, 1), (3, 1), (2, 2)
    across = mirrored(r, p, q)
    a, b, c, d = (lattice.positions(np.array(v)) for v in (p, q, r, across))
    np.testing.assert_allclose((c + d) / 2, (a + b) / 2, atol=1e-12)
    assert np.linalg.norm(d - c) == pytest.approx(1.5 * math.sqrt(3))
    assert mirrored(across, p, q) == r


def test_triangles_that_share_a_corner_only_do_not_hold_together() -> None:
    hinge = [(0, 0), (1, 0), (0, 1), (-1, 0), (0, -1)]
    assert sorted(map(sorted, bodies_of(hinge))) == [
        [(-1, 0), (0, -1), (0, 0)],
        [(0, 0), (0, 1), (1, 0)],
    ]
    joined = bodies_of([*hinge, (-1, 1)])  # fills the gap on the left
    assert len(joined) == 1
    assert len(joined[0]) == 6
    assert body_of([(0, 0), (1, 0), (2, 0)]) == frozenset()
