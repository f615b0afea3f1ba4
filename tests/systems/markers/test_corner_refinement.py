from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from systems.cameras import PinholeCamera
from systems.markers.corner_refinement import refine_corners, to_ideal, to_picture
from systems.markers.family import Family, family
from tests.synthetic import (
    CornerErrors,
    Sheet,
    corner_errors,
    coverage,
    draw,
    expose,
    jagged,
    posed_homography,
    random_sheets,
)

Array = NDArray[np.float64]

ARUCO = family("DICT_4X4_50")
APRILTAG = family("tag36h11")
BOTH = pytest.mark.parametrize("kind", [ARUCO, APRILTAG], ids=lambda kind: kind.name)
BARREL = PinholeCamera(
    640,
    480,
    np.array([[420.0, 0, 319.5], [0, 430.0, 239.5], [0, 0, 1]]),
    np.array([-0.3, 0.08, 0.001, -0.002, 0.0]),
)
ONE = Sheet(ARUCO, 3, posed_homography(centre=(60.3, 55.8), side=50, turn=0.4, tilt=0.7))


def spoilt(rng: np.random.Generator, truth: Array, size: float) -> Array:
    """Starts as bad as OpenCV's: half a pixel too small, and off by up to `size` px."""
    inward = truth.mean(axis=1, keepdims=True) - truth
    inward /= np.linalg.norm(inward, axis=-1, keepdims=True)
    return truth + 0.5 * inward + rng.uniform(-size, size, truth.shape)


def refined(
    kind: Family,
    *,
    pictures: int = 4,
    start_error: float = 1.0,
    noise: float = 0.0,
    sheets: dict[str, Any] | None = None,
    drawing: dict[str, Any] | None = None,
) -> CornerErrors:
    rng = np.random.default_rng(7)
    results = []
    for _ in range(pictures):
        placed = random_sheets(rng, kind, **(sheets or {}))
        shape = (sheets or {}).get("shape", (480, 640))
        image = expose(draw(shape, placed, **(drawing or {})), noise=noise, rng=rng)
        truth = np.stack([sheet.corners() for sheet in placed])
        start = spoilt(rng, truth, start_error)
        results.append((np.arange(len(truth)), refine_corners(image, start, kind.cells), truth))
    return corner_errors(results)


def light_from_the_left() -> Array:
    # It doubles every 100 px: by half over a marker.
    return np.tile(0.4 + 0.6 * np.abs(np.sin(np.arange(640) * np.pi / 320)), (480, 1))


def test_coverage_of_a_triangle_is_its_area() -> None:
    triangle = np.array([[2.3, 1.1], [11.7, 4.9], [5.2, 9.6]])
    (ax, ay), (bx, by) = triangle[1] - triangle[0], triangle[2] - triangle[0]
    found = coverage((12, 15), triangle[None])
    assert found.sum() == pytest.approx((ax * by - ay * bx) / 2, abs=1e-12)
    assert found.min() > -1e-12
    assert found.max() < 1 + 1e-12
    assert found[5, 6] == pytest.approx(1.0)
    assert found[0, 14] == 0.0


def test_exact_picture_agrees_with_brute_force_supersampling() -> None:
    exact = draw((110, 120), [ONE])
    n, total = 16, np.zeros((110, 120))
    for dx in (np.arange(n) + 0.5) / n - 0.5:
        for dy in (np.arange(n) + 0.5) / n - 0.5:
            T = np.array([[1, 0, -dx], [0, 1, -dy], [0, 0, 1.0]])
            total += jagged((110, 120), [Sheet(ARUCO, 3, T @ ONE.H)])
    difference = total / n**2 - exact
    assert np.abs(difference).max() < 190 / n / 2
    assert np.abs(difference.mean()) < 0.01


@BOTH
def test_exact_pictures_leave_a_hundredth_of_a_pixel(kind: Family) -> None:
    result = refined(kind, pictures=6)
    assert result.std < 0.01
    assert result.shift < 0.002
    assert abs(result.grow) < 0.002
    assert result.worst < 0.1


@BOTH
@pytest.mark.parametrize(
    ("condition", "std", "bias"),
    [
        ({"noise": 2.0}, 0.02, 0.005),
        ({"noise": 5.0}, 0.03, 0.01),
        ({"drawing": {"blur": 0.7}}, 0.02, 0.005),
        ({"drawing": {"blur": 1.5}}, 0.10, 0.04),
        ({"drawing": {"black": 90, "white": 130, "ground": 110}, "noise": 1.0}, 0.03, 0.01),
        ({"drawing": {"light": light_from_the_left()}}, 0.02, 0.01),
        ({"drawing": {"ground": 30}}, 0.015, 0.005),
        ({"drawing": {"ground": 250}}, 0.015, 0.005),
        ({"sheets": {"side": (15, 30), "pitch": 80}, "pictures": 2}, 0.06, 0.015),
        (
            {"sheets": {"side": (200, 260), "pitch": 430, "shape": (430, 860)}, "noise": 3.0},
            0.03,
            0.01,
        ),
    ],
    ids=[
        "noise_2", "noise_5", "blur_0.7", "blur_1.5", "low_contrast", "uneven_light", "dark_ground",
        "light_ground", "15_to_30_px", "200_px_and_more",
    ],
)  # fmt: skip
def test_holds_under(kind: Family, condition: dict[str, Any], std: float, bias: float) -> None:
    result = refined(kind, **condition)
    assert result.std < std
    assert result.shift < bias
    assert abs(result.grow) < bias


@BOTH
def test_pictures_without_anti_aliasing_leave_little_more_than_a_tenth_of_a_pixel(
    kind: Family,
) -> None:
    rng = np.random.default_rng(3)
    results = []
    for _ in range(6):
        sheets = random_sheets(rng, kind)
        truth = np.stack([sheet.corners() for sheet in sheets])
        start = spoilt(rng, truth, 1.0)
        found = refine_corners(jagged((480, 640), sheets), start, kind.cells)
        results.append((np.arange(len(truth)), found, truth))
    result = corner_errors(results)
    assert result.std < 0.13
    assert result.shift < 0.02
    assert abs(result.grow) < 0.02


def test_starts_two_pixels_off_end_in_the_same_place() -> None:
    rng = np.random.default_rng(5)
    sheets = random_sheets(rng, ARUCO, side=(40, 70))
    image = expose(draw((480, 640), sheets))
    truth = np.stack([sheet.corners() for sheet in sheets])
    ends = [
        refine_corners(image, truth + rng.uniform(-2, 2, truth.shape), ARUCO.cells)
        for _ in range(20)
    ]
    assert np.abs(np.array(ends) - truth).max() < 0.1


def test_blurs_three_pixels_wide_are_measured_on_large_markers() -> None:
    result = refined(
        ARUCO,
        sheets={"side": (200, 260), "pitch": 430, "shape": (430, 860), "max_tilt": 0.7},
        drawing={"blur": 3.0},
        noise=2.0,
    )
    assert result.std < 0.06
    assert abs(result.grow) < 0.03


def test_neighbours_one_cell_apart_do_not_disturb() -> None:
    # Black squares touch neither each other nor anything else than a white gap of one cell.
    cell = 9.0
    H = posed_homography(centre=(170.2, 150.6), side=1.0, turn=0.3, tilt=0.5, focal_length=900)
    sheets = []
    for row in (-1, 0, 1):
        for column in (-1, 0, 1):
            pitch = (ARUCO.cells + 1) * cell
            place = np.array(
                [[6 * cell, 0, column * pitch], [0, 6 * cell, row * pitch], [0, 0, 1.0]]
            )
            sheets.append(Sheet(ARUCO, len(sheets), H @ place, margin=0.5))
    image = expose(draw((300, 340), sheets, ground=30.0))
    truth = np.stack([sheet.corners() for sheet in sheets])
    found = refine_corners(image, spoilt(np.random.default_rng(1), truth, 0.7), ARUCO.cells)
    assert np.abs(found - truth).max() < 0.03


def test_sheared_squares() -> None:
    shear = np.array([[55, 40, 70.3], [0, 38, 60.1], [0, 0, 1.0]])
    sheet = Sheet(ARUCO, 1, shear)
    image = expose(draw((130, 160), [sheet]))
    truth = sheet.corners()[None]
    found = refine_corners(image, spoilt(np.random.default_rng(2), truth, 0.7), ARUCO.cells)
    assert np.abs(found - truth).max() < 0.03


def test_markers_at_the_picture_s_rim_keep_their_visible_corners() -> None:
    # The left edge runs 1.5 px from the rim, inside; the white margin is cut off.
    sheet = Sheet(ARUCO, 4, posed_homography(centre=(26.5, 40.2), side=50, turn=0.0))
    image = expose(draw((90, 100), [sheet]))
    truth = sheet.corners()[None]
    start = spoilt(np.random.default_rng(2), truth, 0.5)
    found = refine_corners(image, start, ARUCO.cells)
    assert np.abs(found - truth).max() < 0.1


@pytest.mark.parametrize("shift", [(0.0, -40.0), (-30.0, -30.0), (500.0, 500.0)])
def test_corners_outside_the_picture_stay_finite_and_near(shift: tuple[float, float]) -> None:
    image = expose(draw((110, 120), [ONE]))
    start = ONE.corners()[None] + shift
    found = refine_corners(image, start, ARUCO.cells)
    assert np.isfinite(found).all()
    assert np.abs(found - start).max() <= 8.0


@pytest.mark.parametrize("grey", [0, 255])
def test_a_picture_of_nothing_leaves_the_start_alone(grey: int) -> None:
    start = ONE.corners()[None]
    image = np.full((110, 120), grey, np.uint8)
    np.testing.assert_allclose(refine_corners(image, start, ARUCO.cells), start, atol=1e-4)


def test_degenerate_squares_stay_finite() -> None:
    image = expose(draw((110, 120), [ONE]))
    start = np.array([
        [[5, 5], [5, 5], [5, 5], [5, 5]],
        [[5, 5], [10, 10], [20, 20], [30, 30]],
        [[5, 5], [50, 50], [50, 5], [5, 50]],
    ], float)  # fmt: skip
    assert np.isfinite(refine_corners(image, start, ARUCO.cells)).all()


def test_a_blot_on_an_edge_moves_it_by_less_than_it_would_without_outlier_rejection() -> None:
    rng = np.random.default_rng(9)
    worst = []
    for grey in (0, 90, 160, 255):
        for share in (0.3, 0.5, 0.7):
            image = expose(draw((110, 120), [ONE]))
            a, b = ONE.corners()[[1, 2]]
            centre = np.round((a + share * (b - a)) * 16).astype(int)
            cv2.circle(image, centre.tolist(), 4 * 16, grey, -1, cv2.LINE_AA, 4)
            start = spoilt(rng, ONE.corners()[None], 0.5)
            worst.append(np.abs(refine_corners(image, start, ARUCO.cells) - ONE.corners()).max())
    # A blot 8 px wide hides a fifth of an edge 40 px long; taken at face value, it would move the
    # edge by a fifth of the window's 1.5 px.
    assert max(worst) < 0.1


def test_turning_the_picture_turns_the_corners() -> None:
    image = expose(draw((110, 120), [ONE]))
    found = refine_corners(image, ONE.corners()[None], ARUCO.cells)[0]
    turned = np.ascontiguousarray(np.rot90(image))  # (x, y) goes to (y, width - 1 - x)
    there = np.stack([ONE.corners()[:, 1], 119 - ONE.corners()[:, 0]], axis=-1)
    again = refine_corners(turned, there[None], ARUCO.cells)[0]
    np.testing.assert_allclose(again[:, 0], found[:, 1], atol=0.005)
    np.testing.assert_allclose(again[:, 1], 119 - found[:, 0], atol=0.005)


def test_brightness_and_contrast_do_not_move_corners() -> None:
    picture = draw((110, 120), [ONE], blur=0.6)
    found = refine_corners(expose(picture), ONE.corners()[None], ARUCO.cells)
    paler = refine_corners(expose(picture / 3 + 120), ONE.corners()[None], ARUCO.cells)
    np.testing.assert_allclose(paler, found, atol=0.02)


def test_each_marker_is_refined_as_if_it_were_alone() -> None:
    rng = np.random.default_rng(11)
    sheets = random_sheets(rng, APRILTAG)
    image = expose(draw((480, 640), sheets), noise=2.0, rng=rng)
    start = spoilt(rng, np.stack([sheet.corners() for sheet in sheets]), 0.7)
    together = refine_corners(image, start, APRILTAG.cells)
    for i in range(len(sheets)):
        alone = refine_corners(image, start[i : i + 1], APRILTAG.cells)[0]
        np.testing.assert_allclose(together[i], alone, atol=0.002)


def test_more_squares_than_one_map_of_opencv_has_rows() -> None:
    image = expose(draw((110, 120), [ONE]))
    start = np.repeat(ONE.corners()[None], 2000, axis=0)
    found = refine_corners(image, start, ARUCO.cells)
    np.testing.assert_allclose(found, found[:1].repeat(2000, axis=0), atol=1e-3)
    assert refine_corners(image, start[:0], ARUCO.cells).shape == (0, 4, 2)


@BOTH
def test_lines_are_straight_behind_a_distorting_lens(kind: Family) -> None:
    camera = BARREL
    rng = np.random.default_rng(2)
    results, blind = [], []
    for _ in range(4):
        sheets = []
        for x, y in ((65, 70), (575, 70), (65, 410), (575, 410), (320, 60), (320, 420)):
            centre = to_ideal(np.array([x, y], float), camera)
            H = posed_homography(
                centre=tuple(centre),
                side=rng.uniform(70, 90),
                turn=rng.uniform(0, 6.3),
                tilt=rng.uniform(0, 0.8),
                tilt_axis=rng.uniform(0, 6.3),
            )
            sheets.append(Sheet(kind, len(sheets), H))
        image = expose(draw((480, 640), sheets, warp=lambda points: to_picture(points, camera)))
        truth = to_picture(np.stack([sheet.corners() for sheet in sheets]), camera)
        start = spoilt(rng, truth, 0.7)
        ids = np.arange(len(truth))
        results.append((ids, refine_corners(image, start, kind.cells, camera), truth))
        blind.append((ids, refine_corners(image, start, kind.cells), truth))
    result, without = corner_errors(results), corner_errors(blind)
    assert result.std < 0.015
    assert result.shift < 0.005
    assert abs(result.grow) < 0.005
    assert without.std > 5 * result.std  # the curves are there to be seen


def test_ideal_and_distorted_pixels_are_each_other_s_inverse() -> None:
    pixels = np.random.default_rng(0).uniform((0, 0), (639, 479), (50, 2))
    there = to_ideal(pixels, BARREL)
    assert np.abs(there - pixels).max() > 10
    np.testing.assert_allclose(to_picture(there, BARREL), pixels, atol=1e-6)
