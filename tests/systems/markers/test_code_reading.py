from __future__ import annotations

import numpy as np
import pytest
from apriltag import apriltag
from numpy.typing import NDArray

from systems.cameras import PinholeCamera
from systems.markers.code_reading import CodeReader, Reading
from systems.markers.corner_refinement import to_ideal, to_picture
from systems.markers.family import family
from tests.synthetic import Sheet, draw, expose, posed_homography, random_sheets

FAMILIES = ["DICT_4X4_50", "DICT_5X5_1000", "DICT_6X6_250", "DICT_7X7_50", "tag16h5", "tag36h11"]
PIXELS = 8  # a cell, in the enlarged pictures


def enlarged(cells: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.kron(cells, np.ones((PIXELS, PIXELS), np.uint8))


def corners_of(name: str) -> NDArray[np.float64]:
    """Corners of the black square in an enlarged picture with a margin of one cell."""
    low, high = PIXELS - 0.5, PIXELS * (family(name).cells + 1) - 0.5
    return np.array([[[low, low], [high, low], [high, high], [low, high]]])


def read(name: str, cells: NDArray[np.uint8], marker_id: int) -> Reading:
    reader = CodeReader(family=family(name))
    return reader.read(enlarged(cells), np.array([marker_id]), corners_of(name))


@pytest.mark.parametrize("name", FAMILIES)
def test_official_images_read_without_an_error(name: str) -> None:
    reader = CodeReader(family=family(name))
    for marker_id in range(0, family(name).count, 7):
        image = enlarged(family(name).cell_image(marker_id))
        reading = reader.read(image, np.array([marker_id]), corners_of(name))
        assert reading.hamming.tolist() == [0]
        assert reading.rim_errors.tolist() == [0]
        assert reading.decision_margin[0] > 127


@pytest.mark.parametrize("name", FAMILIES)
@pytest.mark.parametrize("flips", [1, 2, 3])
def test_flipped_bits_are_counted(name: str, flips: int) -> None:
    rng = np.random.default_rng(flips)
    cells = family(name).cell_image(5).copy()
    code = [(r, c) for r in range(2, len(cells) - 2) for c in range(2, len(cells) - 2)]
    for k in rng.choice(len(code), flips, replace=False):
        cells[code[k]] = 255 - cells[code[k]]
    reading = read(name, cells, 5)
    assert reading.hamming.tolist() == [flips]
    assert reading.rim_errors.tolist() == [0]


@pytest.mark.parametrize("name", FAMILIES)
def test_another_id_s_image_differs_by_the_distance_of_the_codes(name: str) -> None:
    a, b = family(name).cell_image(3), family(name).cell_image(4)
    assert read(name, a, 4).hamming.tolist() == [int((a != b).sum())]


def test_cells_of_border_and_margin_are_counted_apart_from_the_code() -> None:
    cells = family("DICT_5X5_1000").cell_image(8).copy()
    cells[1, 3] = 255  # a hole in the border
    cells[0, 5] = 0  # a spot on the margin
    cells[-1, 4] = 0
    reading = read("DICT_5X5_1000", cells, 8)
    assert reading.rim_errors.tolist() == [3]
    assert reading.hamming.tolist() == [0]
    assert CodeReader(family=family("DICT_5X5_1000")).rim_cells == 9**2 - 5**2


def test_the_margin_is_proportional_to_the_contrast() -> None:
    reader = CodeReader(family=family("tag36h11"))
    cells = family("tag36h11").cell_image(20)
    margins = []
    for contrast in (200, 100, 50):
        image = enlarged((cells > 0).astype(np.uint8) * np.uint8(contrast) + np.uint8(20))
        margins.append(reader.read(image, np.array([20]), corners_of("tag36h11")).decision_margin)
    np.testing.assert_allclose(np.array(margins) / margins[0], [[1], [0.5], [0.25]], rtol=1e-3)


@pytest.mark.parametrize("blur", [0.0, 1.0])
def test_hamming_and_margin_agree_with_apriltag_3(blur: float) -> None:
    rng = np.random.default_rng(6)
    engine = apriltag("tag36h11", threads=1, decimate=1.0)
    reader = CodeReader(family=family("tag36h11"))
    sheets = random_sheets(rng, family("tag36h11"))
    image = expose(draw((480, 640), sheets, blur=blur), noise=3.0, rng=rng)
    found = sorted(engine.detect(image), key=lambda tag: tag["id"])
    ids = np.array([tag["id"] for tag in found])
    assert ids.tolist() == list(range(len(sheets)))
    reading = reader.read(image, ids, np.stack([sheet.corners() for sheet in sheets]))
    assert reading.hamming.tolist() == [tag["hamming"] for tag in found]
    np.testing.assert_allclose(reading.decision_margin, [tag["margin"] for tag in found], rtol=0.2)


def test_light_that_falls_to_a_third_over_the_marker_changes_no_bit() -> None:
    sheet = Sheet(family("DICT_6X6_250"), 17, posed_homography(centre=(60, 60), side=80))
    light = np.tile(np.linspace(1.0, 0.25, 120), (120, 1))
    image = expose(draw((120, 120), [sheet], light=light))
    reader = CodeReader(family=sheet.family)
    reading = reader.read(image, np.array([17]), sheet.corners()[None])
    assert reading.hamming.tolist() == [0]
    assert reading.rim_errors.tolist() == [0]
    # No one level would have told white from black: the darkest white is darker than the
    # brightest black.
    whites, blacks = 220 * light[:, 100].mean(), 30 * light[:, 20].mean()
    assert whites * 0.5 > blacks


def test_cells_are_where_the_lens_shows_them() -> None:
    camera = PinholeCamera(
        200, 200, np.array([[150.0, 0, 99.5], [0, 150.0, 99.5], [0, 0, 1]]),
        np.array([-0.35, 0.1, 0.0, 0.0]),
    )  # fmt: skip
    centre = to_ideal(np.array([60.0, 60.0]), camera)
    sheet = Sheet(family("tag36h11"), 30, posed_homography(centre=tuple(centre), side=110))
    image = expose(draw((200, 200), [sheet], warp=lambda points: to_picture(points, camera)))
    corners = to_picture(sheet.corners(), camera)[None]
    reader = CodeReader(family=sheet.family)
    with_lens = reader.read(image, np.array([30]), corners, camera)
    without = reader.read(image, np.array([30]), corners)
    assert with_lens.hamming.tolist() == [0]
    assert with_lens.rim_errors.tolist() == [0]
    assert with_lens.decision_margin[0] > without.decision_margin[0]


@pytest.mark.parametrize(
    "corners",
    [
        [[5, 5], [5, 5], [5, 5], [5, 5]],
        [[5, 5], [10, 10], [20, 20], [30, 30]],
        [[np.nan, 5], [9, 9], [1, 2], [3, 4]],
        [[1e30, 5], [9, 9e30], [1, 2], [3, 4]],
        [[-900, -900], [-800, -900], [-800, -800], [-900, -800]],
    ],
)
def test_squares_that_are_none_read_as_wrong_and_finite(corners: list[list[float]]) -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (80, 80)).astype(np.uint8)
    for name in FAMILIES:
        reading = CodeReader(family=family(name)).read(image, np.array([1]), np.array([corners]))
        assert reading.hamming[0] > 1
        assert np.isfinite(reading.decision_margin).all()


def test_pixels_that_the_lens_model_does_not_reach_read_as_wrong() -> None:
    camera = PinholeCamera(
        400, 400, np.array([[100.0, 0, 199.5], [0, 100.0, 199.5], [0, 0, 1]]),
        np.array([-0.4, 0.0, 0.0, 0.0]),
    )  # fmt: skip
    cells = family("DICT_4X4_50").cell_image(1)
    image = np.full((400, 400), 255, np.uint8)
    image[: 8 * PIXELS, : 8 * PIXELS] = enlarged(cells)
    corners = corners_of("DICT_4X4_50")
    assert np.isnan(to_ideal(corners, camera)).any()
    reader = CodeReader(family=family("DICT_4X4_50"))
    assert reader.read(image, np.array([1]), corners).hamming.tolist() == [0]
    assert reader.read(image, np.array([1]), corners, camera).hamming[0] > 1
