"""Sub-pixel corners of square markers: lines fitted to the profiles across the four edges.

Engines find corners to half a pixel or worse, and with a bias: OpenCV's contours run along the
outermost dark pixels, so its squares come out small. Here every edge is crossed by scan lines, the
place of the step from ink to paper is measured on each, a line is fitted to the places, and
neighbouring lines are intersected. All edges of all markers go through each step together.

A step is placed by the moment-preserving rule (Tabatabai and Mitchell, "Edge location to subpixel
values in digital imagery", PAMI 1984): the area under the profile, between the levels at its ends,
says where an ideal step would be. Whatever blurs the step evenly to both sides, the pixel's own
square included, leaves the area as it is, so the place has no bias. Where the window ends before
the blur does, the profile is antisymmetric about the true edge, and the rule still has its fixed
point there.

Points are complex numbers x + iy, px, counted from the centre of the first pixel.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from systems.cameras import PinholeCamera

Array = NDArray[np.float64]
Points = NDArray[np.complex128]
Grey = NDArray[np.uint8]

_NEXT, _PREVIOUS = np.array([1, 2, 3, 0]), np.array([3, 0, 1, 2])

# The search for the step.
_SEARCH_LINES = 12
_SEARCH_SHARE = 0.9  # of an edge, away from its corners
_SEARCH_SAMPLES = 13
_SEARCH_RANGE = 3.0  # px either side
_SEARCH_CELLS = (0.4, 1.3)  # it grows to the first share of a cell, and is never above the second
_FARTHEST = 8.0  # px that a search goes, or a corner is moved
_LEAST_WEIGHT = 1e-6  # where nothing rises, quotients come out as zero

# The measurement. Seven samples over 1.5 px either side are half a pixel apart: at a whole
# fraction of a pixel the bilinear samples of an axis-parallel edge add up to its exact area.
_LINES = 64
_SAMPLES = 7
_SHARP = 0.6  # px, the least standard deviation that a step has: pixel square and interpolation
_WINDOW = 2.5  # half the window, in standard deviations of the step
_CLEAR = 1.7  # as many are kept away from the next edges, one cell further in and out
_NARROWEST = 1.0  # px
_TOLERANCE = 0.1  # of half the window: scan lines this close to their line all count alike
_CORNER = 1.0  # px beyond half the window that are left out at either end of an edge
_MOST_LEFT_OUT = 0.5  # of half an edge, however short


def refine_corners(
    image: Grey, corners: Array, cells: int, camera: PinholeCamera | None = None
) -> Array:
    """Moves the corners of dark squares on light paper to where their edges really meet.

    Samples are taken within one cell of each edge, so a white margin of one cell is enough. An
    edge that cannot be measured (hidden, outside the picture, without contrast) stays about where
    the start has it. The start may be wrong by 2 px, on markers of less than 30 px by 1 px.

    Args:
        image: (height, width) grey.
        corners: (n, 4, 2) px, clockwise as seen in the picture.
        cells: cells along a side of the black square, border included.
        camera: the lens. Where it distorts, lines are straight in the ideal picture only: they
            are fitted there, and the corners distorted again.

    Returns:
        (n, 4, 2) px, in the picture as it is; finite wherever `corners` is.
    """
    if len(corners) == 0:
        return corners
    lens = camera if camera is not None and camera.distorted else None
    start = _complex(corners)
    with np.errstate(all="ignore"):
        edges = _edges(start if lens is None else _complex(to_ideal(corners, lens)), cells)
        found = _intersections(_measure(image, edges, *_search(image, edges, lens), lens))
        if lens is not None:
            found = _complex(to_picture(_pairs(found), lens))
        np.copyto(found, start, where=~(np.abs(found - start) < _FARTHEST))  # NaN too
    return _pairs(found)


def to_ideal(pixels: Array, camera: PinholeCamera) -> Array:
    """Takes pixels (..., 2) to where they would be without distortion; NaN if there is no place."""
    return camera.undistort(pixels) * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]


def to_picture(pixels: Array, camera: PinholeCamera) -> Array:
    """Takes pixels (..., 2) of the ideal picture to the distorted one."""
    rays = np.ones((*pixels.shape[:-1], 3))
    rays[..., :2] = (pixels - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]
    return camera.project(rays)


def _complex(pairs: Array) -> Points:
    return np.ascontiguousarray(pairs, float).view(np.complex128)[..., 0]


def _pairs(points: Points) -> Array:
    return points[..., None].view(np.float64)


class _Edges(NamedTuple):
    """The edges of n markers, (4n,) each; edge 4m + i of marker m starts at its corner i."""

    middle: Points
    half: Points  # from the middle to the end
    length: Array  # of half, px
    normal: Points  # outward, of length 1
    cell: Array  # the least width of the cells beside it, px


def _edges(corners: Points, cells: int) -> _Edges:
    half = (corners.take(_NEXT, axis=1) - corners) / 2
    length = np.abs(half)
    turn = (half.conj() * half.take(_NEXT, axis=1)).imag  # length times the next corner's distance
    cell = np.minimum(turn, turn.take(_PREVIOUS, axis=1)) * (2 / cells) / length
    normal = half * (-1j / length)
    middle = corners + half
    return _Edges(middle.ravel(), half.ravel(), length.ravel(), normal.ravel(), cell.ravel())


def _search(image: Grey, edges: _Edges, lens: PinholeCamera | None) -> tuple[Points, Array]:
    """Finds the edges roughly: lines through the squared rise of grey level across them.

    Only rises count: the steps next to an edge, from a white code cell to the border inward and
    from the paper to what lies behind it outward, are falls.

    Returns:
        The lines, (2, 4n): a point in the middle and the vector from there to the end of what was
        scanned; and the standard deviation of each one's step, (4n,) px.
    """
    narrow, wide = _SEARCH_CELLS
    reach = np.minimum(np.maximum(narrow * edges.cell, _SEARCH_RANGE), _FARTHEST)
    reach = np.minimum(reach, wide * edges.cell)
    frame = np.array([edges.middle, edges.half * _SEARCH_SHARE, edges.normal * reach])
    profiles = _profiles(image, frame, _SEARCH_PLACES, lens)
    rise = profiles[1:] - profiles[:-1]
    np.maximum(rise, 0.0, out=rise)
    rise *= rise
    moments = (_ACROSS @ rise.reshape(len(rise), -1)).reshape(3, _SEARCH_LINES, -1)
    # So that no scan line counts more than the others together, however bright its rise.
    moments /= moments[0] + (_SEARCH_MEAN @ moments[0] + _LEAST_WEIGHT)
    weight, first, second = moments
    second -= first * first / (weight + _LEAST_WEIGHT)
    weight, first, second = _SEARCH_ALONG @ moments
    blur = np.sqrt(2 * second[0] / weight[0]) * reach  # 2: a squared Gaussian is narrower
    return frame[:2] + _solve(weight, first[:2]) * frame[2], blur


def _measure(
    image: Grey, edges: _Edges, lines: Points, blur: Array, lens: PinholeCamera | None
) -> Points:
    """Measures edges that are known to a fraction of a pixel.

    Args:
        image: (height, width) grey.
        edges: where they started.
        lines: (2, 4n), as `_search` gives them, and returned like that.
        blur: (4n,) standard deviations of the steps, px.
        lens: of a distorted picture.
    """
    blur = np.fmax(blur, _SHARP)
    reach = np.maximum(np.minimum(edges.cell - _CLEAR * blur, _WINDOW * blur), _NARROWEST)
    share = 1 - np.minimum((_CORNER + reach) / edges.length, _MOST_LEFT_OUT)
    frame = np.array([lines[0], lines[1] * (share / _SEARCH_SHARE), edges.normal * reach])
    profiles = _profiles(image, frame, _PLACES, lens)
    sums = (_AREA_AND_CONTRAST @ profiles.reshape(_SAMPLES, -1)).reshape(2, _LINES, -1)
    area, contrast = sums
    mean = np.maximum(_MEAN @ contrast, 1.0)
    place = area / mean
    solution = _PLAIN_FIT @ place
    residual = np.abs(place - _LINE @ solution)
    if residual.max() > _TOLERANCE:
        # Once more with outliers weighted down, and without the scan lines that meet no step:
        # hidden ones, and those beyond the rim, where the picture goes on as its last pixel.
        ratio = residual / (3 * (_MEAN @ residual) + _TOLERANCE / 2)
        ratio *= ratio
        ratio *= ratio
        weight = (contrast > 0.5 * mean) / (1 + ratio)
        solution = _solve(_ALONG @ weight, _ALONG[:2] @ (weight * place))
    trusted = np.maximum(*np.abs(solution)) < 1  # inside the window that was looked at
    return frame[:2] + solution * (frame[2] * trusted)


def _profiles(
    image: Grey, frame: Points, places: NDArray[np.float32], lens: PinholeCamera | None
) -> NDArray[np.float32]:
    """Samples scan lines across edges.

    Args:
        image: (height, width) grey.
        frame: (3, 4n) a point of each edge, a vector along it and one across.
        places: (samples, lines, 3) of the samples in such a frame (see `_places`).
        lens: of a distorted picture.

    Returns:
        (samples, lines, 4n) grey levels.
    """
    # One product lays out all the maps; its columns are x and y in turn.
    xy = places.reshape(-1, 3) @ frame.astype(np.complex64).view(np.float32)
    # Their shape has no meaning, but OpenCV takes no more than 32767 rows or columns.
    xy = xy.reshape(frame.shape[1], -1, 2)
    if lens is not None:
        xy = to_picture(xy.astype(np.float64), lens).astype(np.float32)
    samples = cv2.remap(image, xy, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return samples.astype(np.float32).reshape(*places.shape[:2], -1)


def _solve(weights: Array, values: Array) -> Array:
    """Fits value = offset + slope u by weighted least squares.

    Args:
        weights: (3, edges) sums of the weights times u to the powers 0, 1, 2.
        values: (2, edges) sums of the weighted values times u to the powers 0, 1.

    Returns:
        (2, edges) offset and slope; zero where nothing has weight.
    """
    determinant = weights[0] * weights[2] - weights[1] * weights[1] + _LEAST_WEIGHT
    return (weights[2::-2] * values - weights[1] * values[::-1]) / determinant


def _intersections(lines: Points) -> Points:
    """Returns the corners, (n, 4): where each edge's line meets the one before it."""
    point, direction = lines.reshape(2, -1, 4)
    along = direction.take(_PREVIOUS, axis=1).conj()
    apart = point.take(_PREVIOUS, axis=1) - point
    return point + direction * ((along * apart).imag / (along * direction).imag)


def _powers(u: Array) -> NDArray[np.float32]:
    """Returns (3, len(u)): u to the powers 0, 1, 2."""
    return np.stack([np.ones_like(u), u, u * u]).astype(np.float32)


def _places(samples: int, lines: int) -> NDArray[np.float32]:
    """Returns (samples, lines, 3): factors of an edge's middle, half and normal."""
    across, along = np.meshgrid(
        np.linspace(-1, 1, samples), np.linspace(-1, 1, lines), indexing="ij"
    )
    return np.stack([np.ones_like(along), along, across], axis=-1).astype(np.float32)


def _area_and_contrast(samples: int) -> NDArray[np.float32]:
    """Returns (2, samples): functionals of a profile over [-1, 1] that rises from ink to paper.

    The first is the area between the middle of its end levels and the profile, by the trapezoidal
    rule: the contrast times the place of the step. The second is the contrast.
    """
    ends = np.zeros(samples)
    ends[[0, -1]] = 1.0
    trapezoids = (1 - ends / 2) * 2 / (samples - 1)
    return np.stack([ends - trapezoids, ends * np.linspace(-1, 1, samples)]).astype(np.float32)


_SEARCH_ALONG = _powers(np.linspace(-1, 1, _SEARCH_LINES))
_SEARCH_PLACES = _places(_SEARCH_SAMPLES, _SEARCH_LINES)
_ACROSS = _powers((1 - 1 / (_SEARCH_SAMPLES - 1)) * np.linspace(-1, 1, _SEARCH_SAMPLES - 1))
_SEARCH_MEAN = _SEARCH_ALONG[0] / _SEARCH_LINES
_ALONG = _powers(np.linspace(-1, 1, _LINES))
_PLACES = _places(_SAMPLES, _LINES)
_MEAN = _ALONG[0] / _LINES
_LINE = np.ascontiguousarray(_ALONG[:2].T)
_PLAIN_FIT = np.linalg.pinv(_LINE)
_AREA_AND_CONTRAST = _area_and_contrast(_SAMPLES)
