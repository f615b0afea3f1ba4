"""`make validate`: what the detector finds in real pictures, beside its engines alone."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from apriltag import apriltag
from numpy.typing import NDArray

from diagrams.sources import pictures
from systems.markers.detector import MarkerDetector
from systems.markers.family import family
from tests.benchmarks.table import Row, show

Array = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[2]


def data_folder() -> Path:
    """Returns the folder of the recordings."""
    return Path(os.environ.get("TAGTRAIL_DATA", ROOT.parent / "shared" / "data"))


def listed(path: Path) -> tuple[list[int], Array]:
    """Returns ids and corners (n, 4, 2) px of the tags listed beside a photograph.

    They are AprilTag 3's, which counts pixels from the first one's corner.
    """
    rows = [line.replace(",", " ").replace("(", " ").replace(")", " ").split()
            for line in path.read_text().splitlines() if line.strip()]  # fmt: skip
    ids = [int(row[0]) for row in rows]
    return ids, np.array([[float(v) for v in row[1:9]] for row in rows]).reshape(-1, 4, 2) - 0.5


def right_and_false(
    ids: NDArray[np.int64], corners: Array, true_ids: list[int], true_corners: Array
) -> tuple[int, int]:
    """Returns how many listed tags were found with the right id, and how many others."""
    right = 0
    left = set(range(len(true_ids)))
    for marker_id, quad in zip(ids, corners, strict=True):
        centre = quad.mean(axis=0)
        near = [k for k in left if np.hypot(*(true_corners[k].mean(axis=0) - centre)) < 3]
        if near and true_ids[near[0]] == marker_id:
            right += 1
            left.remove(near[0])
    return right, len(ids) - right


def rows() -> Iterator[Row]:
    """Yields what was found."""
    folder = data_folder()
    block = MarkerDetector(family="36h11")
    opencv = cv2.aruco.ArucoDetector(family("36h11").opencv_dictionary())
    bare = apriltag("tag36h11", decimate=1.0, maxhamming=1)
    totals = np.zeros((3, 2), int)
    count = 0
    for path in sorted((folder / "apriltag_photos").glob("*.jpg")):
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        true_ids, true_corners = listed(path.with_suffix(".txt"))
        count += len(true_ids)
        found = block.detect(grey)
        totals[0] += right_and_false(found.ids, found.corners, true_ids, true_corners)
        quads, ids, _ = opencv.detectMarkers(grey)
        totals[1] += right_and_false(ids.ravel(), np.concatenate(quads), true_ids, true_corners)
        tags = bare.detect(grey)
        ids, quads = np.array([t["id"] for t in tags]), [t["lb-rb-rt-lt"] for t in tags]
        totals[2] += right_and_false(ids, np.array(quads) - 0.5, true_ids, true_corners)
    texts = [f"{right} right, {false} other" for right, false in totals]
    reached = bool(totals[0, 0] >= 46 and totals[0, 1] == 0)
    yield Row(
        f"three photographs with {count} tags of 36h11", texts[0], "46 right, 0 other", reached,
        f"AprilTag 3: {texts[2]}; OpenCV: {texts[1]}",
    )  # fmt: skip
    for picture in pictures(folder / "aruco_camera"):
        found = MarkerDetector(family="DICT_5X5_1000", camera=picture.camera).detect(picture.image)
        ids = sorted(found.ids.tolist())
        reached = ids == [100, 103, 106, 107, 110, 111, 112]
        yield Row("Raspberry Pi camera, DICT_5X5_1000", f"ids {ids}", "all 7, no other", reached)


if __name__ == "__main__":
    if not data_folder().is_dir():
        sys.exit(f"no recordings at {data_folder()} (set TAGTRAIL_DATA)")
    sys.exit(0 if show("Real pictures", rows()) else 1)
