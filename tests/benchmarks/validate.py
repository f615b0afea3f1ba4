"""`make validate`: what the detector finds in real pictures, beside its engines alone."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import cv2
import numpy as np
from apriltag import apriltag

from diagrams.sources import pictures
from systems.markers.detector import MarkerDetector
from systems.markers.family import family
from tests.benchmarks.table import Row, show
from tests.recordings import FOLDER, listed_tags, right_and_other


def rows() -> Iterator[Row]:
    """Yields what was found."""
    block = MarkerDetector(family="36h11")
    opencv = cv2.aruco.ArucoDetector(family("36h11").opencv_dictionary())
    bare = apriltag("tag36h11", decimate=1.0, maxhamming=1)
    totals = np.zeros((3, 2), int)
    count = 0
    for path in sorted((FOLDER / "apriltag_photos").glob("*.jpg")):
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        tags = listed_tags(path.with_suffix(".txt"))
        count += len(tags)
        found = block.detect(grey)
        totals[0] += right_and_other(found.ids, found.corners, tags)
        quads, ids, _ = opencv.detectMarkers(grey)
        totals[1] += right_and_other(ids.ravel(), np.concatenate(quads), tags)
        theirs = bare.detect(grey)
        quads = [tag["lb-rb-rt-lt"] - 0.5 for tag in theirs]
        totals[2] += right_and_other([tag["id"] for tag in theirs], quads, tags)
    texts = [f"{right} right, {false} other" for right, false in totals]
    reached = bool(totals[0, 0] >= 46 and totals[0, 1] == 0)
    yield Row(
        f"three photographs with {count} tags of 36h11", texts[0], "46 right, 0 other", reached,
        f"AprilTag 3: {texts[2]}; OpenCV: {texts[1]}",
    )  # fmt: skip
    for picture in pictures(FOLDER / "aruco_camera"):
        found = MarkerDetector(family="DICT_5X5_1000", camera=picture.camera).detect(picture.image)
        ids = sorted(found.ids.tolist())
        reached = ids == [100, 103, 106, 107, 110, 111, 112]
        yield Row("Raspberry Pi camera, DICT_5X5_1000", f"ids {ids}", "all 7, no other", reached)


if __name__ == "__main__":
    if not FOLDER.is_dir():
        sys.exit(f"no recordings at {FOLDER} (set TAGTRAIL_DATA)")
    sys.exit(0 if show("Real pictures", rows()) else 1)
