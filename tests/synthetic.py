"""Pictures of markers whose pixels and corners are exact, for tests and benchmarks of detectors.

A pixel's value is the integral of the scene over its square (a pixel centre lies at integers, as
OpenCV counts), computed in closed form by Green's theorem: there is no supersampling, so no grid
to be aligned with. Blur, noise and rounding come after. Nothing here shares code with the detector.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from systems.markers.family import Family

Array = NDArray[np.float64]
Warp = Callable[[Array], Array]

_PIECES = 40  # straight pieces that a line is cut into where the picture is warped


@dataclass(frozen=True, eq=False)
class Sheet:
    """A printed marker in the picture.

    Attributes:
        family: its family.
        id: its number.
        H: (3, 3) from the marker's plane to pixels. The black square of the upright official
            image is [-1/2, 1/2]^2 there, x to the right, y down.
        margin: width of the white rim, in cells.
    """

    family: Family
    id: int
    H: Array
    margin: float = 1.0

    def corners(self) -> Array:
        """The corners of the black square: (4, 2) px, from the top-left one clockwise."""
        return _transform(self.H, np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]))

    def rim(self) -> Array:
        """The corners of the paper: (4, 2) px."""
        grow = 1 + 2 * self.margin / self.family.cells
        return _transform(
            self.H, grow * np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        )

    def ink(self) -> Array:
        """The outlines of the runs of black cells in each row: (n, 4, 2) px."""
        black = self.family.cell_image(self.id, margin=0) == 0
        steps = np.diff(np.pad(black, ((0, 0), (1, 1))).astype(int), axis=1)
        (row, first), (_, last) = np.nonzero(steps == 1), np.nonzero(steps == -1)
        x = np.stack([first, last, last, first], axis=-1)
        y = np.stack([row, row, row + 1, row + 1], axis=-1)
        return _transform(self.H, np.stack([x, y], axis=-1) / self.family.cells - 0.5)


def posed_homography(
    *,
    centre: tuple[float, float],
    side: float,
    turn: float = 0.0,
    tilt: float = 0.0,
    tilt_axis: float = 0.0,
    focal_length: float = 600.0,
) -> Array:
    """The homography of a marker seen by a pinhole camera that looks straight at its centre.

    Args:
        centre: pixel of the marker's centre.
        side: length that its sides would have without tilt, px.
        turn: rotation in its own plane, rad, clockwise as seen.
        tilt: angle between its normal and the line of sight, rad.
        tilt_axis: direction in the picture of the axis that it is tilted about, rad.
        focal_length: of the camera, px; the shorter, the stronger the perspective.
    """
    spin, _ = cv2.Rodrigues(np.array([0.0, 0.0, turn]))
    lean, _ = cv2.Rodrigues(tilt * np.array([np.cos(tilt_axis), np.sin(tilt_axis), 0.0]))
    R = lean @ spin
    distance = focal_length / side
    pose = np.column_stack([R[:, 0], R[:, 1], [0.0, 0.0, distance]])
    K = np.array([[focal_length, 0, centre[0]], [0, focal_length, centre[1]], [0, 0, 1.0]])
    return K @ pose


def random_homography(
    rng: np.random.Generator,
    *,
    centre: tuple[float, float],
    side: tuple[float, float],
    max_tilt: float = np.deg2rad(60.0),
) -> Array:
    """A marker at any turn, any tilt up to `max_tilt` (rad) about any axis, at any sub-pixel place.

    Args:
        rng: where the numbers come from.
        centre: pixel that its centre is within half a pixel of.
        side: range of the length of its sides before tilting, px.
        max_tilt: rad.
    """
    x, y = np.array(centre) + rng.uniform(-0.5, 0.5, 2)
    return posed_homography(
        centre=(x, y),
        side=rng.uniform(*side),
        turn=rng.uniform(0, 2 * np.pi),
        tilt=rng.uniform(0, max_tilt),
        tilt_axis=rng.uniform(0, 2 * np.pi),
    )


def random_sheets(
    rng: np.random.Generator,
    family: Family,
    *,
    shape: tuple[int, int] = (480, 640),
    pitch: int = 160,
    side: tuple[float, float] = (30.0, 70.0),
    max_tilt: float = np.deg2rad(60.0),
) -> list[Sheet]:
    """Sheets in a grid of that pitch (px), each turned, tilted and sized at random, ids in turn."""
    places = [
        (x, y)
        for y in range(pitch // 2, shape[0] - pitch // 2 + 1, pitch)
        for x in range(pitch // 2, shape[1] - pitch // 2 + 1, pitch)
    ]
    return [
        Sheet(family, i, random_homography(rng, centre=place, side=side, max_tilt=max_tilt))
        for i, place in enumerate(places)
    ]


def draw(
    shape: tuple[int, int],
    sheets: Sequence[Sheet],
    *,
    black: float = 30.0,
    white: float = 220.0,
    ground: float | Array = 130.0,
    light: Array | None = None,
    blur: float = 0.0,
    warp: Warp | None = None,
) -> Array:
    """Draws sheets that do not overlap; every pixel is the exact mean over its square.

    Args:
        shape: (height, width) of the picture.
        sheets: what is in it.
        black: grey level of the ink.
        white: grey level of the paper.
        ground: grey level behind the sheets, a number or a picture.
        light: (height, width) factor on every pixel, None for even light.
        blur: standard deviation of a Gaussian blur, px.
        warp: what the lens does: takes pixels of the ideal picture (n, 2) to those of the real one.

    Returns:
        (height, width) grey levels, not rounded.
    """
    picture = np.array(np.broadcast_to(ground, shape), float)
    for sheet in sheets:
        paper = coverage(shape, sheet.rim()[None], warp)
        ink = coverage(shape, sheet.ink(), warp)
        picture += (white - picture) * paper - (white - black) * ink
    if light is not None:
        picture = picture * light
    if blur > 0:
        picture = cv2.GaussianBlur(picture, (0, 0), blur, borderType=cv2.BORDER_REPLICATE)
    return picture


def expose(
    picture: Array, *, noise: float = 0.0, rng: np.random.Generator | None = None
) -> NDArray[np.uint8]:
    """Adds Gaussian noise of that standard deviation (grey levels) and rounds to uint8."""
    if noise > 0:
        assert rng is not None
        picture = picture + rng.normal(0.0, noise, picture.shape)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def jagged(
    shape: tuple[int, int],
    sheets: Sequence[Sheet],
    *,
    black: float = 30.0,
    white: float = 220.0,
    ground: float = 130.0,
) -> NDArray[np.uint8]:
    """Draws sheets without anti-aliasing: a pixel shows what is at its centre."""
    height, width = shape
    picture = np.full(shape, float(ground))
    for sheet in sheets:
        cells = sheet.family.cells
        (left, top), (right, bottom) = sheet.rim().min(axis=0), sheet.rim().max(axis=0)
        columns = slice(max(0, int(left)), min(width, int(right) + 2))
        rows = slice(max(0, int(top)), min(height, int(bottom) + 2))
        y, x = np.mgrid[rows, columns].astype(float)
        place = (_transform(np.linalg.inv(sheet.H), np.stack([x, y], axis=-1)) + 0.5) * cells
        part = picture[rows, columns]
        part[((place > -sheet.margin) & (place < cells + sheet.margin)).all(axis=-1)] = white
        inside = ((place >= 0) & (place < cells)).all(axis=-1)
        column, row = place[inside].astype(int).T
        code = sheet.family.cell_image(sheet.id, margin=0)
        part[inside] = np.where(code[row, column] == 0, black, white)
    return picture.astype(np.uint8)


def coverage(shape: tuple[int, int], polygons: Array, warp: Warp | None = None) -> Array:
    """How much of each pixel's square the polygons cover, exactly.

    Args:
        shape: (height, width).
        polygons: (n, m, 2) px, not overlapping, clockwise as seen in the picture.
        warp: applied to points on the outlines.

    Returns:
        (height, width) in [0, 1].
    """
    height, width = shape
    start = polygons
    end = np.roll(polygons, -1, axis=1)
    if warp is not None:
        along = np.linspace(0.0, 1.0, _PIECES + 1)[:, None, None, None]
        points = warp((start + along * (end - start)).reshape(-1, 2)).reshape(-1, *start.shape)
        start, end = points[:-1], points[1:]
    # From here on, pixel (0, 0) is the square [0, 1]^2.
    p = start.reshape(-1, 2) + 0.5
    q = end.reshape(-1, 2) + 0.5
    # By Green's theorem the area is a sum over the outline; cut where it crosses the pixel grid,
    # every piece belongs to one pixel and to all those right of it.
    mean = np.zeros((height, width + 1))
    for a, b in zip(p, q, strict=True):
        cuts = [np.array([0.0, 1.0])]
        for axis, size in ((0, width), (1, height)):
            low, high = sorted((a[axis], b[axis]))
            lines = np.arange(max(0, np.ceil(low)), min(size, np.floor(high)) + 1)
            if b[axis] != a[axis]:
                cuts.append((lines - a[axis]) / (b[axis] - a[axis]))
        t = np.sort(np.concatenate(cuts).clip(0.0, 1.0))
        points = a + t[:, None] * (b - a)
        middle = (points[1:] + points[:-1]) / 2
        rise = np.diff(points[:, 1])
        row = np.floor(middle[:, 1]).astype(int)
        inside = (row >= 0) & (row < height) & (rise != 0)
        row, rise, x = row[inside], rise[inside], middle[inside, 0].clip(0, width)
        column = np.minimum(np.floor(x).astype(int), width - 1)
        right = rise * (x - column)
        np.add.at(mean, (row, column), rise - right)
        np.add.at(mean, (row, column + 1), right)
    # Clockwise with y down: the outline runs up on the left side, so the sum comes out negative.
    return -np.cumsum(mean[:, :width], axis=1)


class CornerErrors(NamedTuple):
    """How far found corners lie from the true ones, over all corners.

    Attributes:
        found: share of the markers that were found.
        std: standard deviation of x and y, px.
        shift: the larger of the mean errors in x and in y, px.
        grow: mean error away from the marker's centre, px; negative where squares come out small.
        worst: largest error in x or y, px.
    """

    found: float
    std: float
    shift: float
    grow: float
    worst: float


def corner_errors(pictures: Iterable[tuple[Array, Array, Array]]) -> CornerErrors:
    """Compares found corners with true ones.

    Args:
        pictures: for each picture the ids found (n,), their corners (n, 4, 2), and the true corners
            by id (m, 4, 2): marker i of the picture has the id i.
    """
    errors, outward, true_count = [], [], 0
    for ids, corners, truth in pictures:
        assert len(set(ids.tolist())) == len(ids), "an id was found twice"
        true = truth[ids]
        errors.append(corners - true)
        spoke = true - true.mean(axis=1, keepdims=True)
        spoke /= np.linalg.norm(spoke, axis=-1, keepdims=True)
        outward.append(((corners - true) * spoke).sum(axis=-1))
        true_count += len(truth)
    error = np.concatenate(errors)
    return CornerErrors(
        found=len(error) / true_count,
        std=float(error.std(axis=(0, 1)).mean()),
        shift=float(np.abs(error.mean(axis=(0, 1))).max()),
        grow=float(np.concatenate(outward).mean()),
        worst=float(np.abs(error).max()),
    )


def _transform(H: Array, points: Array) -> Array:
    homogeneous = points @ H[:, :2].T + H[:, 2]
    return homogeneous[..., :2] / homogeneous[..., 2:]
