"""Reading a marker's cells: do they show the code that they are said to show, and how clearly?

Engines decode while they search, from corners that are half a pixel off, and OpenCV does not say
how many bits it corrected. Here the centre of every cell, of the code, of the black border and of
one ring of the white margin, is sampled through the homography of the refined corners, and compared
with the family's image. Light that changes over the marker is allowed for as AprilTag 3 does it
(Wang and Olson, "AprilTag 2: efficient and robust fiducial detection", IROS 2016): one plane is
fitted to the grey levels of the border, one to those of the margin, and the threshold runs midway.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from systems.cameras import PinholeCamera
from systems.markers.family import Family

Array = NDArray[np.float64]


_SHARPENING = 0.25  # of a cell's difference from its four neighbours is added, as by AprilTag 3
_SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
_LEAST = 1.0  # grey level that a cell must differ from the threshold by


class Reading(NamedTuple):
    """How n markers agree with the codes of their ids.

    Attributes:
        hamming: (n,) int64, code cells that are on the wrong side of the threshold.
        decision_margin: (n,) how far the code's white cells lie above the threshold or its black
            ones below, in the mean, whichever is less; grey levels. AprilTag 3's decision margin,
            but for the sharpening that it does first.
        rim_errors: (n,) int64, cells of the border that are not dark or of the margin that are not
            light.
    """

    hamming: NDArray[np.int64]
    decision_margin: Array
    rim_errors: NDArray[np.int64]


class CodeReader:
    """Reads markers of one family; reuse it, the family's codes are laid out once.

    Args:
        family: the family.
    """

    def __init__(self, *, family: Family) -> None:
        side = family.cells + 2
        row, column = (axis.ravel() for axis in np.mgrid[:side, :side])
        ring = np.minimum(np.minimum(row, column), side - 1 - np.maximum(row, column))
        u = (column - 0.5) / family.cells
        v = (row - 0.5) / family.cells
        self._cells = np.stack([u, v, np.ones_like(u)], axis=-1)
        to_threshold = np.zeros((len(ring), len(ring)))  # from samples
        for which in (0, 1):
            fit = np.linalg.pinv(self._cells[ring == which])
            to_threshold[ring == which] += (self._cells @ fit).T / 2
        near = np.abs(row[:, None] - row) + np.abs(column[:, None] - column) == 1
        sharpen = np.eye(len(ring)) + _SHARPENING * (np.diag(near.sum(axis=1)) - near)
        self._to_above = ((np.eye(len(ring)) - to_threshold) @ sharpen.T).astype(np.float32)
        white = np.stack([family.cell_image(i).ravel() for i in range(family.count)]) > 0
        self._sign = np.where(white, 1, -1).astype(np.float32)
        code = ring > 1
        self._code_or_rim = np.stack([code, ~code], axis=-1).astype(np.float32)
        self._code = code.astype(np.float32)
        self._white = white[:, code].sum(axis=1)  # every code has white cells and black ones
        self._black = (~white[:, code]).sum(axis=1)
        self.rim_cells = int((~code).sum())

    def read(
        self,
        image: NDArray[np.uint8],
        ids: NDArray[np.int64],
        corners: Array,
        camera: PinholeCamera | None = None,
    ) -> Reading:
        """Compares markers with their codes.

        Args:
            image: (height, width) grey.
            ids: (n,) of the family.
            corners: (n, 4, 2) px, top-left, top-right, bottom-right, bottom-left.
            camera: the lens, where it distorts.

        Returns:
            The reading. Where cells have no place in the picture (three corners in a line, or a
            lens model that cannot be inverted), they are wrong.
        """
        xy = self._places(corners, camera).astype(np.float32)
        samples = cv2.remap(image, xy, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        above = samples.astype(np.float32) @ self._to_above
        agreement = above * self._sign[ids]
        wrong = (agreement < _LEAST).astype(np.float32) @ self._code_or_rim
        # Over the code's cells: white plus black, and white minus black.
        total, difference = agreement @ self._code, above @ self._code
        margin = np.minimum(
            (total + difference) / self._white[ids], (total - difference) / self._black[ids]
        )
        hamming, rim_errors = wrong.astype(np.int64).T
        return Reading(hamming, margin / 2, rim_errors)

    def _places(self, corners: Array, camera: PinholeCamera | None) -> Array:
        """Returns the cells' centres in the picture, (n, cells, 2) px."""
        H = [cv2.getPerspectiveTransform(_SQUARE, c) for c in corners.astype(np.float32)]
        homogeneous = self._cells @ np.array(H).reshape(-1, 3, 3).swapaxes(1,2)
        return homogeneous[..., :2]/homogeneous[..., 2:]
