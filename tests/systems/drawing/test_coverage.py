from __future__ import annotations

import numpy as np
import pytest

from systems.drawing.coverage import Box, CoverageSheet, Edges, outlines
from tests.synthetic import coverage

SHAPE = (40, 56)
WHOLE = Box(0, 0, 56, 40)


def polygons(rng: np.random.Generator, count: int, spread: float) -> np.ndarray:
    """Clockwise quadrilaterals of all sizes, some of them beside the picture or around it."""
    angle = np.sort(rng.uniform(0, 2 * np.pi, (count, 4)), axis=1)
    size = np.exp(rng.uniform(-2, 4, (count, 1)))
    corners = np.stack([size * np.cos(angle), size * np.sin(angle)], axis=-1)
    return corners + rng.uniform(-spread, 60 + spread, (count, 1, 2))


def test_it_is_the_exact_area() -> None:
    # The reference integrates by another formula, one edge after the other.
    rng = np.random.default_rng(1)
    measure = CoverageSheet()
    for polygon in polygons(rng, 60, 30.0):
        (found,) = measure([(outlines(polygon[None]), WHOLE)])
        np.testing.assert_allclose(found, coverage(SHAPE, polygon[None], None), atol=2e-6)


def test_by_hand() -> None:
    # A pixel's square reaches half a pixel from its centre.
    square = np.array([[[2.0, 1.0], [4.0, 1.0], [4.0, 2.5], [2.0, 2.5]]])
    (found,) = CoverageSheet()([(outlines(square), Box(0, 0, 6, 5))])
    expected = np.zeros((5, 6))
    expected[1:3, 2:5] = np.outer([0.5, 1.0], [0.5, 1.0, 0.5])
    np.testing.assert_allclose(found, expected, atol=1e-7)


def test_boxes_are_windows_on_one_picture() -> None:
    rng = np.random.default_rng(2)
    shapes = outlines(polygons(rng, 20, 10.0), rng.normal(size=20))
    measure = CoverageSheet()
    whole = measure([(shapes, WHOLE)])[0].copy()
    boxes = [Box(3, 5, 20, 33), WHOLE, Box(50, 0, 56, 2), Box(7, 30, 8, 40), Box(9, 9, 9, 20)]
    for box, part in zip(boxes, measure([(shapes, box) for box in boxes]), strict=True):
        left, top, right, bottom = box
        np.testing.assert_allclose(part, whole[top:bottom, left:right], atol=2e-5)


def test_a_patchwork_is_drawn_by_steps() -> None:
    # Two cells with a seam: three upright lines with the steps of grey, and nothing else matters.
    cells = outlines(
        np.array(
            [
                [[5.3, 4.1], [11.2, 4.1], [11.2, 9.6], [5.3, 9.6]],
                [[11.2, 4.1], [20.7, 4.1], [20.7, 9.6], [11.2, 9.6]],
            ]
        ),
        np.array([30.0, 80.0]),
    )
    seams = Edges(
        np.array([[5.3, 9.6], [11.2, 9.6], [20.7, 9.6], [5.3, 4.1], [11.2, 4.1], [11.2, 9.6]]),
        np.array([[5.3, 4.1], [11.2, 4.1], [20.7, 4.1], [11.2, 4.1], [20.7, 4.1], [5.3, 9.6]]),
        np.array([30.0, 50.0, -80.0, 30.0, 80.0, 30.0]),
    )
    bottom = Edges(np.array([[20.7, 9.6]]), np.array([[11.2, 9.6]]), np.array([80.0]))
    drawn = Edges(
        np.concatenate([seams.start, bottom.start]),
        np.concatenate([seams.end, bottom.end]),
        np.concatenate([seams.weight, bottom.weight]),
    )
    measure = CoverageSheet()
    expected = measure([(cells, WHOLE)])[0].copy()
    np.testing.assert_allclose(measure([(drawn, WHOLE)])[0], expected, atol=1e-4)


def test_edges_from_far_away_keep_their_place() -> None:
    far = 1e8
    wedge = np.array([[[-far, 20.3], [far, 20.3], [far, far], [-far, far]]])
    (found,) = CoverageSheet()([(outlines(wedge), WHOLE)])
    np.testing.assert_allclose(found[20], 0.2, atol=1e-5)
    assert found[:20].max() < 1e-5
    np.testing.assert_allclose(found[21:], 1.0, atol=1e-5)


@pytest.mark.parametrize("turn", [0.0, np.pi / 2])
def test_vertical_and_level_edges_on_the_borders_of_pixels(turn: float) -> None:
    spin = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    square = np.array([[-3.0, -3], [3, -3], [3, 3], [-3, 3]]) @ spin + [10.5, 10.5]
    (found,) = CoverageSheet()([(outlines(square[None]), Box(0, 0, 20, 20))])
    expected = np.zeros((20, 20))
    expected[8:14, 8:14] = 1.0
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_box_around_points_holds_all_that_they_cover() -> None:
    rng = np.random.default_rng(3)
    for polygon in polygons(rng, 200, 20.0):
        touched = np.abs(coverage(SHAPE, polygon[None], None)) > 1e-12
        left, top, right, bottom = Box.around(polygon, 56, 40)
        outside = touched.copy()
        outside[top:bottom, left:right] = False
        assert not outside.any()
