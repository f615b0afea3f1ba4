"""The real recordings: where they lie, and the tags that are listed beside the photographs."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FOLDER = Path(
    os.environ.get("TAGTRAIL_DATA", Path(__file__).resolve().parents[2] / "shared" / "data")
)


def listed_tags(path: Path) -> list[tuple[int, Array]]:
    """Returns id and corners (4, 2) px of the tags that a photograph's text file lists.

    They are AprilTag 3's without edge refinement, a pixel or so rough and in an order of their own;
    it counts pixels from the first one's corner.
    """
    tags = []
    for line in path.read_text().splitlines():
        numbers = [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?", line)]
        if numbers:
            tags.append((int(numbers[0]), np.reshape(numbers[1:9], (4, 2)) - 0.5))
    return tags


def right_and_other(
    ids: Iterable[int], corners: Iterable[Array], listed: list[tuple[int, Array]]
) -> tuple[int, int]:
    """Returns how many listed tags were found, id and place right, and how many others were.

    Args:
        ids: of what was found.
        corners: (4, 2) px of each.
        listed: as `listed_tags` gives them.
    """
    left = list(range(len(listed)))
    right = other = 0
    for marker_id, quad in zip(ids, corners, strict=True):
        centre = np.mean(quad, axis=0)
        near = [
            k
            for k in left
            if listed[k][0] == marker_id
            and np.linalg.norm(listed[k][1].mean(axis=0) - centre) < 2.0
        ]
        if near:
            left.remove(near[0])
        right += bool(near)
        other += not near
    return right, other
