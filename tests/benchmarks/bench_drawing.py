"""What it costs to draw a picture directly, beside Drake's renderer, and how exact it is."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform, RotationMatrix

from systems.cameras import PinholeCamera
from systems.drawing.boards import draw_board, marker_sheet
from systems.drawing.coverage import CoverageSheet
from systems.drawing.layers import paint
from systems.drawing.shells import DrawnShell, draw_shell
from systems.markers.detector import MarkerDetector
from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap, marker_corners
from tests.benchmarks.table import Row, show
from tests.rendering import Studio

Array = NDArray[np.float64]

TAG = family("DICT_4X4_50")
FACING = np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]])  # marker frame to optical frame
SIZE = 0.1
CAMERA = PinholeCamera.from_focal_length(640, 480, 600.0)


def rows() -> Iterator[Row]:
    """Yields the measurements."""
    cv2.setNumThreads(1)
    yield from board_rows()
    yield from shell_rows()


def scattered(count: int, rng: np.random.Generator) -> list[RigidTransform]:
    """X_CM of markers of 80 px in a grid of two by two, turned and tilted to 40 degrees."""
    poses = []
    for k in range(count):
        z = CAMERA.K[0, 0] * SIZE / 80
        place = np.array([(160.0, -160.0)[k % 2], (120.0, -120.0)[k // 2 % 2]])
        x, y = (place + rng.uniform(-5, 5, 2)) * z / CAMERA.K[0, 0]
        axis, tilt = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(0, 40))
        lean, _ = cv2.Rodrigues(tilt * np.array([np.cos(axis), np.sin(axis), 0.0]))
        spin, _ = cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(0, 2 * np.pi)]))
        poses.append(RigidTransform(RotationMatrix(lean @ spin @ FACING), [x, y, z]))
    return poses


def draw_boards(poses: list[RigidTransform], sheet: CoverageSheet) -> NDArray[np.uint8]:
    """A picture of the markers 0, 1, ... on grey."""
    picture = np.full((CAMERA.height, CAMERA.width, 1), 130.5, np.float32)
    drawings = []
    for k, X_CM in enumerate(poses):
        printed = marker_sheet(TAG, k, 1)
        drawing = draw_board(CAMERA, X_CM.GetAsMatrix34(), SIZE, printed, 220.0, 30.0)
        assert drawing is not None
        drawings.append(drawing)
    paint(picture, drawings, sheet)
    return picture[:, :, 0].astype(np.uint8)


def board_rows() -> Iterator[Row]:
    """Four flat markers: time and corners."""
    rng = np.random.default_rng(0)
    poses, sheet = scattered(4, rng), CoverageSheet()
    # The studio's camera stays in the world's origin, so the markers' poses are the world's.
    boards = {k: Marker(k, X, SIZE) for k, X in enumerate(poses)}
    studio = Studio(markers=MarkerMap(TAG, SIZE, boards), camera=CAMERA)
    ours, drake = least(
        lambda: draw_boards(poses, sheet), lambda: studio.picture(RigidTransform(), rng), 60
    )
    peers = f"Drake (VTK): {drake:.1f} ms"
    yield Row("4 flat markers of 80 px, 640x480", f"{ours:.2f} ms", "1 ms", ours <= 1.0, peers)

    detector = MarkerDetector(family=TAG)
    errors = []
    for _ in range(50):
        poses = scattered(4, rng)
        found = detector.detect(draw_boards(poses, sheet))
        for marker_id, corners in zip(found.ids, found.corners, strict=True):
            p_C = poses[marker_id].multiply(marker_corners(SIZE).T).T
            errors.append(corners - CAMERA.project(p_C))
    error = np.array(errors)
    rms, shift = float(np.sqrt((error**2).mean())), float(np.abs(error.mean(axis=(0, 1))).max())
    figures = f"RMS {rms:.4f} px, shift {shift:.4f} px ({len(errors)} of 200 found)"
    yield Row("their corners as detected", figures, "0.05 px", rms <= 0.05 and shift <= 0.05)


def shell_rows() -> Iterator[Row]:
    """A shell of 75 mm seen from 10 mm, all over the routine's places."""
    radius, size = 0.075, 0.005
    camera = PinholeCamera.from_focal_length(640, 480, 481.0)
    deep = np.sqrt(radius**2 - size**2 / 2)
    markers = {}
    for k, (yaw, pitch) in enumerate(((0.0, 0.5), (0.8, 0.5), (0.0, 1.05), (0.0, 0.0))):
        R = RotationMatrix.MakeZRotation(yaw) @ RotationMatrix.MakeYRotation(-pitch)
        markers[k] = Marker(k, RigidTransform(R, R @ np.array([deep, 0, 0])), size)
    shell = DrawnShell(
        frame=SceneGraph().world_frame_id(),
        radius=radius,
        markers=MarkerMap(TAG, size, markers, "shell"),
    )
    sheet = CoverageSheet()
    R_down = RotationMatrix(np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]]))

    def draw(yaw: float, pitch: float, height: float) -> NDArray[np.uint8]:
        R = RotationMatrix.MakeZRotation(yaw) @ RotationMatrix.MakeYRotation(-pitch)
        X_SC = RigidTransform(R @ R_down, R @ np.array([radius + height, 0, 0]))
        picture = np.zeros((camera.height, camera.width, 1), np.float32)
        drawing = draw_shell(camera, shell, X_SC.inverse().GetAsMatrix34())
        assert drawing is not None
        paint(picture, [drawing], sheet)
        return picture[:, :, 0].astype(np.uint8)

    for label, yaw, pitch in (
        ("a marker in view", 0.02, 0.49),
        ("none in view", 0.4, 0.25),
        ("near the pole", 0.5, 1.5),
    ):
        ours, _ = least(partial(draw, yaw, pitch, 0.01), lambda: None, 60)
        what = f"shell from 10 mm, {label}, 640x480"
        yield Row(what, f"{ours:.2f} ms", "6 ms", ours <= 6.0, "Drake (VTK), measured: 40-53 ms")
    ours, _ = least(lambda: draw(0.4, 0.25, 0.3), lambda: None, 10)
    yield Row("the whole shell from 300 mm", f"{ours:.1f} ms")


def least(one: Callable[[], Any], other: Callable[[], Any], repeats: int) -> tuple[float, float]:
    """Returns the least times of two functions that take turns, ms."""
    times = np.empty((repeats, 2))
    for k in range(repeats):
        for j, run in enumerate((one, other)):
            start = time.perf_counter()
            run()
            times[k, j] = time.perf_counter() - start
    first, second = 1e3 * times.min(axis=0)
    return float(first), float(second)


if __name__ == "__main__":
    show("Drawing", rows())
