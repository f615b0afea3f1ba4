"""Marker families: their names, their official images and which engine detects them.

Every `cv2.aruco` dictionary is a family. The AprilTag dictionaries go by AprilTag's own names
(`tag36h11`, ...) and their official upright image is AprilTag 3's, which is OpenCV's turned by
half a turn. Black square, without the white margin, is what `size` always means.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from systems.validation import nearest

_APRILTAG = {
    "tag16h5": "DICT_APRILTAG_16h5",
    "tag25h9": "DICT_APRILTAG_25h9",
    "tag36h10": "DICT_APRILTAG_36h10",
    "tag36h11": "DICT_APRILTAG_36h11",
}


def _dictionary_names() -> list[str]:
    # OpenCV has some names twice, as 36h11 and 36H11: the last one written wins, in lower case.
    names = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
    return sorted({name.lower(): name for name in sorted(names)}.values())


@dataclass(frozen=True)
class Family:
    """One marker family.

    Attributes:
        name: canonical name: `DICT_4X4_50`, ... or `tag36h11`, ...
        dictionary: name of the `cv2.aruco` dictionary.
        bits: code cells along a side, without the black border.
        count: number of ids (0 to count - 1).
        max_correction: bits that may be corrected without leaving the code's guarantee.
    """

    name: str
    dictionary: str
    bits: int
    count: int
    max_correction: int

    @property
    def is_apriltag(self) -> bool:
        """Whether AprilTag 3 is the engine and defines the upright image."""
        return self.name in _APRILTAG

    @property
    def cells(self) -> int:
        """Cells along a side of the black square: the code and one cell of border either side."""
        return self.bits + 2

    def opencv_dictionary(self) -> cv2.aruco.Dictionary:
        """Returns the `cv2.aruco` dictionary."""
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))

    def check_id(self, marker_id: int) -> None:
        """Raises `ValueError` when the family has no such id."""
        if not 0 <= marker_id < self.count:
            raise ValueError(f"id is {marker_id}: {self.name} has the ids 0 to {self.count - 1}")

    def cell_image(self, marker_id: int, margin: int = 1) -> NDArray[np.uint8]:
        """Returns the official upright image, one pixel a cell.

        Args:
            marker_id: which marker.
            margin: white cells around the black square.

        Returns:
            (cells + 2 margin, cells + 2 margin) of 0 and 255.
        """
        self.check_id(marker_id)
        image = cv2.aruco.generateImageMarker(self.opencv_dictionary(), marker_id, self.cells)
        if self.is_apriltag:
            image = np.rot90(image, 2)
        return np.pad(image, margin, constant_values=255)


@cache
def family(name: str) -> Family:
    """Returns the family of that name.

    Accepts canonical names and the usual aliases in any case: `36h11`, `tag36h11`,
    `DICT_APRILTAG_36h11`, `4x4_50`, `DICT_4X4_50`, `aruco_4x4_50`.

    Raises:
        ValueError: no family has that name; the nearest one is named.
    """
    by_alias: dict[str, str] = {}
    for dictionary in _dictionary_names():
        short = dictionary.removeprefix("DICT_").lower()
        for alias in (short, f"dict_{short}", f"aruco_{short}"):
            by_alias[alias] = dictionary
    for tag, dictionary in _APRILTAG.items():
        for alias in (tag, tag.removeprefix("tag")):
            by_alias[alias] = dictionary
    dictionary_name = by_alias.get(name.strip().lower())
    if dictionary_name is None:
        canonical = [n for n in _dictionary_names() if n not in _APRILTAG.values()]
        hint = nearest(name, [*canonical, *_APRILTAG])
        raise ValueError(f"marker family is {name!r}: unknown; {hint}")
    entry = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary_name))
    tags = {d: t for t, d in _APRILTAG.items()}
    return Family(
        name=tags.get(dictionary_name, dictionary_name),
        dictionary=dictionary_name,
        bits=entry.markerSize,
        count=len(entry.bytesList),
        max_correction=entry.maxCorrectionBits,
    )
