"""Reading a marker's cells: do they show the code that they are said to show, and how clearly?

Engines decode while they search, from corners that are half a pixel off, and OpenCV does not say
how many bits it corrected. Here the centre of every cell, of the code, of the black border and of
one ring of the white margin, is sampled through the homography of the refined corners, and compared
with the family's image. Thresholding and sharpening are AprilTag 3's (Wang and Olson, "AprilTag 2:
efficient and robust fiducial detection", IROS 2016): one plane is fitted to the grey levels of the
border, one to those of the margin, so that light may change over the marker, the threshold runs
midway, and a cell's difference from its neighbours is added against blur. We differ in that the
border and the margin are judged too, and that they are known to the sharpening.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from systems.cameras import PinholeCamera
from systems.markers.corner_refinement import to_ideal, to_picture
from systems.markers.family import Family

Array = NDArray[np.float64]

_SHARPENING = 0.25  # of a cell's difference from its four neighbours is added
_LEAST = 1.0  # grey level that a cell must differ from the threshold by
_UNIT_SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)


class Reading(NamedTuple):
    """How n markers agree with the codes of their ids.

    Attributes:
        hamming: (n,) int64, code cells that are on the wrong side of the threshold.
        decision_margin: (n,) how far the code's white cells lie above the threshold or its black
            ones below, in the mean, whichever is less; grey levels, sharpened.
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
        code = ring > 1
        centres = np.stack([column - 0.5, row - 0.5, np.full(side**2, family.cells)])
        self._centres = centres / family.cells
        # Threshold and sharpening are linear: from the samples of all cells to their heights above
        # the threshold it is one matrix.
        threshold = np.zeros((side**2, side**2))
        for which in (ring == 0, ring == 1):
            threshold[:, which] += self._centres.T @ np.linalg.pinv(self._centres[:, which].T) / 2
        near = np.abs(row[:, None] - row) + np.abs(column[:, None] - column) == 1
        sharpen = np.eye(side**2) + _SHARPENING * (np.diag(near.sum(axis=1)) - near)
        self._to_height = (sharpen @ (np.eye(side**2) - threshold)).T.astype(np.float32)
        white = np.stack([family.cell_image(i).ravel() > 0 for i in range(family.count)])
        self._sign = np.where(white, 1, -1).astype(np.float32)
        self._white = white[:, code].sum(axis=1)  # every code has white cells and black ones
        self._black = (~white[:, code]).sum(axis=1)
        self._code = code.astype(np.float32)
        self._code_and_rim = np.stack([code, ~code], axis=-1).astype(np.float32)
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
            ids: (n,) of the family, n > 0.
            corners: (n, 4, 2) px, top-left, top-right, bottom-right, bottom-left.
            camera: the lens, where it distorts.

        Returns:
            The reading. Where the lens model cannot be inverted, all cells are wrong.
        """
        x, y = self._places(corners, camera).astype(np.float32).swapaxes(0, 1)
        samples = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        height = samples.astype(np.float32) @ self._to_height
        agreement = height * self._sign[ids]
        wrong = (agreement < _LEAST).astype(np.float32)
        hamming, rim_errors = (wrong @ self._code_and_rim).astype(np.int64).T
        # Summed over the code's cells: white and black, and white less black.
        both, difference = agreement @ self._code, height @ self._code
        margin = np.minimum(
            (both + difference) / self._white[ids], (both - difference) / self._black[ids]
        )
        return Reading(hamming, margin / 2, rim_errors)

    def _places(self, corners: Array, camera: PinholeCamera | None) -> Array:
        """Returns the centres of the cells in the picture, (n, 2, cells) px."""
        lens = camera if camera is not None and camera.distorted else None
        with np.errstate(all="ignore"):
            if lens is not None:
                corners = to_ideal(corners, lens)
            H = [cv2.getPerspectiveTransform(_UNIT_SQUARE, c) for c in corners.astype(np.float32)]
            homogeneous = (np.concatenate(H) @ self._centres).reshape(len(H), 3, -1)
            places = homogeneous[:, :2] / homogeneous[:, 2:]
            if lens is not None:
                places = to_picture(places.swapaxes(1, 2), lens).swapaxes(1, 2)
        return places
