from __future__ import annotations

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from systems.cameras import PinholeCamera
from systems.drawing.boards import draw_board, marker_sheet
from systems.drawing.coverage import CoverageSheet
from systems.drawing.layers import Drawing, paint
from systems.markers.detector import MarkerDetector
from systems.markers.family import family
from systems.markers.layout import marker_corners
from tests.synthetic import Sheet, draw

K = np.array([[600.0, 0.0, 161.3], [0.0, 590.0, 117.6], [0.0, 0.0, 1.0]])
STRAIGHT = PinholeCamera(320, 240, K)
BARREL = PinholeCamera(320, 240, K, np.array([-0.3, 0.1, 1e-3, -2e-3, 0.0]))
FACING = RotationMatrix(np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]]))
SIZE = 0.1


def poses(count: int, seed: int = 0) -> list[RigidTransform]:
    """X_CM of markers of 30 to 80 px, turned at will and tilted to 50 degrees, in the picture."""
    rng = np.random.default_rng(seed)
    result = []
    for _ in range(count):
        z = 600.0 * SIZE / rng.uniform(30, 80)
        x, y = rng.uniform([-80, -50], [80, 50]) * z / 600.0
        axis = rng.uniform(0, 2 * np.pi)
        lean, _ = cv2.Rodrigues(
            np.radians(rng.uniform(0, 50)) * np.array([np.cos(axis), np.sin(axis), 0.0])
        )
        turn = FACING @ RotationMatrix.MakeXRotation(rng.uniform(0, 2 * np.pi))
        result.append(RigidTransform(RotationMatrix(lean) @ turn, [x, y, z]))
    return result


def board(camera: PinholeCamera, X_CM: RigidTransform, name: str, marker: int) -> Drawing | None:
    sheet = marker_sheet(family(name), marker, 1)
    return draw_board(camera, X_CM.GetAsMatrix34(), SIZE, sheet, 220.0, 30.0)


def picture(camera: PinholeCamera, drawings: list[Drawing]) -> np.ndarray:
    canvas = np.full((camera.height, camera.width, 1), 130, np.float32)
    paint(canvas, drawings, CoverageSheet())
    return canvas[:, :, 0]


@pytest.mark.parametrize("name", ["DICT_4X4_50", "tag36h11"])
def test_every_pixel_is_the_exact_mean(name: str) -> None:
    # The reference is integrated cell row by cell row, by another formula, through a homography.
    for k, X_CM in enumerate(poses(12)):
        plane = X_CM.GetAsMatrix34() @ np.array(
            [[0.0, 0, 0], [SIZE, 0, 0], [0, -SIZE, 0], [0, 0, 1]]
        )
        expected = draw((240, 320), [Sheet(family(name), k, K @ plane)])
        drawing = board(STRAIGHT, X_CM, name, k)
        assert drawing is not None
        np.testing.assert_allclose(picture(STRAIGHT, [drawing]), expected, atol=0.01)


@pytest.mark.parametrize("name", ["DICT_4X4_50", "tag36h11"])
@pytest.mark.parametrize("camera", [STRAIGHT, BARREL])
def test_corners_are_found_where_they_are(name: str, camera: PinholeCamera) -> None:
    detector = MarkerDetector(family=name, camera=camera)
    errors = []
    for k, X_CM in enumerate(poses(40, seed=1)):
        drawing = board(camera, X_CM, name, k % 30)
        assert drawing is not None
        image = np.rint(picture(camera, [drawing])).astype(np.uint8)
        found = detector.detect(image)
        assert found.ids.tolist() == [k % 30]
        truth = camera.project(X_CM.multiply(marker_corners(SIZE).T).T)
        errors.append(found.corners[0] - truth)
    error = np.array(errors)
    assert np.abs(error.mean(axis=(0, 1))).max() < 0.01
    assert np.sqrt((error**2).mean()) < 0.05


def test_corners_of_another_lens_are_missed() -> None:
    # What the test above allows is far less than what it is to find.
    (X_CM,) = poses(1, seed=3)
    corners = X_CM.multiply(marker_corners(SIZE).T).T
    assert np.abs(BARREL.project(corners) - STRAIGHT.project(corners)).max() > 0.2


def test_it_is_seen_from_its_printed_side_and_before_the_camera() -> None:
    turned = RigidTransform(FACING, [0, 0, 0.5])
    assert board(STRAIGHT, turned, "DICT_4X4_50", 3) is not None
    back = turned @ RigidTransform(RollPitchYaw(0, 0, np.pi), [0, 0, 0])
    assert board(STRAIGHT, back, "DICT_4X4_50", 3) is None
    behind = RigidTransform(FACING, [0, 0, -0.5])
    assert board(STRAIGHT, behind, "DICT_4X4_50", 3) is None
    assert board(STRAIGHT, RigidTransform(FACING, [5.0, 0, 0.5]), "DICT_4X4_50", 3) is None


def test_one_that_leaves_the_picture_is_cut_at_its_border() -> None:
    large = PinholeCamera(480, 360, K + np.array([[0, 0, 80.0], [0, 0, 60.0], [0, 0, 0]]))
    for x, y in ((-0.13, 0.0), (0.13, 0.05), (0.0, 0.1), (0.02, -0.1), (-0.13, -0.1)):
        X_CM = RigidTransform(FACING @ RotationMatrix.MakeXRotation(0.4), [x, y, 0.5])
        part, whole = board(STRAIGHT, X_CM, "DICT_4X4_50", 5), board(large, X_CM, "DICT_4X4_50", 5)
        assert part is not None
        assert whole is not None
        expected = picture(large, [whole])[60:300, 80:400]
        assert (expected != 130).any()
        np.testing.assert_allclose(picture(STRAIGHT, [part]), expected, atol=1e-3)
