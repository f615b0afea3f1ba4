"""Flat marker boards: the edges between the cells, drawn as the straight lines that they are."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from systems.cameras import PinholeCamera
from systems.drawing.coverage import Edges
from systems.drawing.layers import NEAREST, Drawing, Layer, box_of, projected_edges
from systems.markers.family import Family

Array = NDArray[np.float64]


class Sheet(NamedTuple):
    """The edges of a printed marker, in the plane of its face.

    Attributes:
        start: (n, 2) y and z in the marker's frame, in sides of the black square.
        end: (n, 2)
        paper: (n,) weights of all that is paper; see `systems.drawing.coverage`.
        ink: (n,) weights of all that is ink.
        rim: (n,) whether the edge bounds the sheet.
    """

    start: Array
    end: Array
    paper: Array
    ink: Array
    rim: NDArray[np.bool_]


@lru_cache(maxsize=1024)
def marker_sheet(family: Family, marker_id: int, margin: int = 1) -> Sheet:
    """Returns the edges of a marker on its white paper.

    Args:
        family: the marker's family.
        marker_id: its id.
        margin: white cells around the black square.
    """
    image = np.pad(family.cell_image(marker_id, margin).astype(int), 1, constant_values=-1)
    white, black = (image == 255).astype(float), (image == 0).astype(float)
    n = len(image) - 2
    line = (np.arange(n + 1) - n / 2) / family.cells
    starts, ends, steps = [], [], []
    # Down the lines between columns the right hand is the cell on the left; along the lines
    # between rows, walked to the right, it is the cell below.
    row, column = (index.ravel() for index in np.mgrid[0:n, 0 : n + 1])
    starts.append(np.stack([line[column], -line[row]], axis=1))
    ends.append(np.stack([line[column], -line[row + 1]], axis=1))
    steps.append([part[row + 1, column] - part[row + 1, column + 1] for part in (white, black)])
    column, row = row, column
    starts.append(np.stack([line[column], -line[row]], axis=1))
    ends.append(np.stack([line[column + 1], -line[row]], axis=1))
    steps.append([part[row + 1, column + 1] - part[row, column + 1] for part in (white, black)])
    paper, ink = np.concatenate(steps, axis=1)
    used = (paper != 0) | (ink != 0)
    rim = (paper + ink)[used] != 0
    sheet = Sheet(
        np.concatenate(starts)[used], np.concatenate(ends)[used], paper[used], ink[used], rim
    )
    for array in sheet:
        array.setflags(write=False)
    return sheet


def on_the_face(places: Array, size: float, X_CM: Array) -> Array:
    """Returns places of a sheet in the optical frame: (n, 3) m."""
    return size * (places @ X_CM[:, 1:3].T) + X_CM[:, 3]


def draw_board(
    camera: PinholeCamera, X_CM: Array, size: float, sheet: Sheet, paper: float, ink: float
) -> Drawing | None:
    """Draws a flat marker board.

    Args:
        camera: calibrated camera.
        X_CM: (3, 4) rotation and translation (m) of the marker in the optical frame.
        size: side of the black square, m.
        sheet: the printed marker.
        paper: grey level of the paper, as it is lit.
        ink: grey level of the ink.

    Returns:
        The drawing; None when the camera cannot see the printed face or the board is not wholly
        before it.
    """
    normal = X_CM[:, 0]
    height = float(normal @ X_CM[:, 3])
    if height >= 0:
        return None
    start, end = (on_the_face(places, size, X_CM) for places in (sheet.start, sheet.end))
    rim = start[sheet.rim]
    if rim[:, 2].min() < NEAREST:
        return None
    if camera.distorted and np.hypot(*(rim[:, :2] / rim[:, 2:]).T).max() > camera.fold_radius:
        return None
    light = projected_edges(camera, start, end, paper * sheet.paper + ink * sheet.ink)
    box = box_of(camera, light)
    if box.empty:
        return None
    pieces = len(light.weight) // len(start)
    rims = np.repeat(sheet.rim, pieces)
    cover = np.repeat(sheet.paper + sheet.ink, pieces)[rims]
    return Drawing(
        (Layer(box, Edges(light.start[rims], light.end[rims], cover), (light,)),),
        points=rim,
        normals=np.array([normal, -normal]),
        heights=np.array([height, -height]),
    )
