from __future__ import annotations

import cv2
import numpy as np
import pytest
from apriltag import apriltag

from systems.markers.family import Family, family

TAGS = ["tag16h5", "tag25h9", "tag36h10", "tag36h11"]
ARUCO = sorted(
    name
    for name in {n.lower(): n for n in dir(cv2.aruco) if n.startswith("DICT_")}.values()
    if "apriltag" not in name.lower()
)
# Top-left, top-right, bottom-right, bottom-left of a unit square, x to the right, y down.
SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
CELL = 8  # px


def some_ids(kind: Family, n: int = 24) -> list[int]:
    """The first, the last and some between."""
    return sorted(set(np.linspace(0, kind.count - 1, n).astype(int).tolist()))


def sheet(kind: Family, ids: list[int]) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """A picture of markers in rows of six, and where their corners (4, 2) px are in it."""
    side = (kind.cells + 4) * CELL
    image = np.full((side * -(-len(ids) // 6), side * 6), 255, np.uint8)
    corners = {}
    for k, marker_id in enumerate(ids):
        y, x = np.array(divmod(k, 6)) * side
        tile = np.kron(kind.cell_image(marker_id, margin=2), np.ones((CELL, CELL), np.uint8))
        image[y : y + side, x : x + side] = tile
        # Edges between pixels; OpenCV counts from pixel centres.
        corners[marker_id] = np.array([x, y]) + CELL * (2 + kind.cells * SQUARE) - 0.5
    return image, corners


def opencv_finds(kind: Family, image: np.ndarray) -> dict[int, np.ndarray]:
    settings = cv2.aruco.DetectorParameters()
    settings.errorCorrectionRate = 0.0  # every cell must be right
    settings.minMarkerPerimeterRate = 0.01
    detector = cv2.aruco.ArucoDetector(kind.opencv_dictionary(), settings)
    corners, ids, _ = detector.detectMarkers(image)
    assert len(set(ids.ravel().tolist())) == len(ids)
    return {int(i): c[0] for i, c in zip(ids.ravel(), corners, strict=True)}


def test_there_are_families_to_test() -> None:
    assert len(ARUCO) >= 17
    assert {"DICT_4X4_50", "DICT_5X5_1000", "DICT_ARUCO_ORIGINAL"} <= set(ARUCO)


@pytest.mark.parametrize("name", ARUCO)
def test_the_official_image_is_found_upright_by_opencv(name: str) -> None:
    kind = family(name)
    assert not kind.is_apriltag
    ids = some_ids(kind)
    image, expected = sheet(kind, ids)
    found = opencv_finds(kind, image)
    assert sorted(found) == ids
    for marker_id in ids:
        np.testing.assert_allclose(found[marker_id], expected[marker_id], atol=1.0)


@pytest.mark.parametrize("name", TAGS)
def test_the_official_image_is_found_upright_by_apriltag(name: str) -> None:
    kind = family(name)
    assert kind.is_apriltag
    ids = some_ids(kind)
    image, expected = sheet(kind, ids)
    found = {tag["id"]: tag for tag in apriltag(name, maxhamming=0).detect(image)}
    assert sorted(found) == ids
    for marker_id in ids:
        # In AprilTag's own words: left bottom, right bottom, right top, left top.
        corners = np.array(found[marker_id]["lb-rb-rt-lt"])[::-1] - 0.5
        np.testing.assert_allclose(corners, expected[marker_id], atol=0.5)


@pytest.mark.parametrize("name", TAGS)
def test_opencvs_idea_of_an_apriltag_is_turned_by_half_a_turn(name: str) -> None:
    kind = family(name)
    ids = some_ids(kind)
    image, expected = sheet(kind, ids)
    found = opencv_finds(kind, image)
    assert sorted(found) == ids
    for marker_id in ids:
        turned = np.roll(expected[marker_id], 2, axis=0)
        np.testing.assert_allclose(found[marker_id], turned, atol=1.0)


@pytest.mark.parametrize("name", ARUCO + TAGS)
def test_the_numbers_of_a_family_are_its_dictionarys(name: str) -> None:
    kind = family(name)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, kind.dictionary))
    assert kind.name == name
    assert kind.bits == dictionary.markerSize
    assert kind.cells == kind.bits + 2
    assert kind.count == dictionary.bytesList.shape[0]
    assert kind.max_correction == dictionary.maxCorrectionBits
    digits = [int(d) for d in "".join(c if c.isdigit() else " " for c in name).split()]
    if name.startswith("DICT_") and name[5].isdigit():
        assert [kind.bits, kind.bits, kind.count] == digits
    if name in TAGS:  # tag36h11: 36 bits, Hamming distance 11
        assert kind.bits**2 == digits[0]
        assert kind.max_correction <= (digits[1] - 1) // 2


def test_the_image_has_a_black_border_and_the_asked_margin() -> None:
    kind = family("DICT_4X4_50")
    for margin in (0, 1, 3):
        image = kind.cell_image(7, margin)
        assert image.shape == (6 + 2 * margin, 6 + 2 * margin)
        assert set(np.unique(image)) == {0, 255}
        rings = [
            np.concatenate([r[0], r[-1], r[:, 0], r[:, -1]])
            for r in (image[k : len(image) - k, k : len(image) - k] for k in range(margin + 1))
        ]
        assert all((ring == 255).all() for ring in rings[:margin])
        assert (rings[margin] == 0).all()


@pytest.mark.parametrize(
    ("alias", "name"),
    [
        ("36h11", "tag36h11"),
        ("tag36h11", "tag36h11"),
        ("TAG36H11", "tag36h11"),
        ("DICT_APRILTAG_36h11", "tag36h11"),
        ("DICT_APRILTAG_36H11", "tag36h11"),
        ("apriltag_36h11", "tag36h11"),
        ("16h5", "tag16h5"),
        ("4x4_50", "DICT_4X4_50"),
        ("DICT_4X4_50", "DICT_4X4_50"),
        ("aruco_4x4_50", "DICT_4X4_50"),
        (" dict_5x5_1000 ", "DICT_5X5_1000"),
        ("aruco_original", "DICT_ARUCO_ORIGINAL"),
    ],
)
def test_aliases_name_one_family(alias: str, name: str) -> None:
    assert family(alias).name == name
    assert family(alias) == family(name)


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("DICT_4X4_51", "did you mean 'DICT_4X4_50'"),
        ("tag36h12", "did you mean 'tag36h11'"),
        ("", "known: DICT_4X4_100"),
    ],
)
def test_an_unknown_family_is_refused_with_the_nearest(name: str, hint: str) -> None:
    with pytest.raises(ValueError, match=f"marker family is '{name}': unknown; {hint}"):
        family(name)


@pytest.mark.parametrize("marker_id", [-1, 50])
def test_an_id_outside_the_family_is_refused(marker_id: int) -> None:
    with pytest.raises(ValueError, match=rf"id is {marker_id}: DICT_4X4_50 has the ids 0 to 49"):
        family("DICT_4X4_50").cell_image(marker_id)
