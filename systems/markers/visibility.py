"""Which markers a camera sees, by their true poses, and where in its picture."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from systems.cameras import PinholeCamera
from systems.compiled import compiled, in_rows, packed
from systems.markers.corner_noise import narrow_side_of
from systems.markers.layout import marker_corners
from systems.plumb_bob import distort
from systems.raycasting import SOLID_ARRAYS, SolidArrays, Solids, occlude
from systems.validation import require, require_non_negative

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# A solid this close before a marker is the board that carries it, and hides nothing: metres, or
# part of the distance from the camera, whichever is more.
_BOARD = 1e-3
_BOARD_PART = 0.005
# Corners, centre, and corners again, to become those of the white margin.
_OUTLINE = np.concatenate([marker_corners(1.0), np.zeros((1, 3)), marker_corners(1.0)])


@dataclass
class ProjectorParameters:
    """When a marker is found, and how well.

    The defaults of `min_side_px` and `max_incidence` are where OpenCV and AprilTag 3 began to miss
    about half of the markers of families DICT_4X4_50 and tag36h11 in synthetic pictures (blur
    0.6 px, noise 2 grey levels): at a narrow side of 10 to 14 px, whatever the tilt, and beyond 80
    degrees of tilt at 80 px.

    Attributes:
        pixel_noise: standard deviation of each corner coordinate of a large marker, px.
        pixel_noise_by_side: more noise of small ones, px^2 (see `systems.markers.corner_noise`).
        min_side_px: the narrow side below which a marker is not found, px (see
            `narrow_side`).
        max_incidence: angle between the marker's normal and the line of sight beyond which it is
            not found, rad, below pi/2.
        max_range: distance beyond which it is not found, m.
        miss_probability: part of the visible markers that is missed at random.
        white_margin: how much of the white rim must be in the picture, cells.
        border_px: how far inside the picture the rim must stay, px.
    """

    pixel_noise: float = 0.3
    pixel_noise_by_side: float = 0.0
    min_side_px: float = 12.0
    max_incidence: float = 1.4
    max_range: float = math.inf
    miss_probability: float = 0.0
    white_margin: float = 1.0
    border_px: float = 0.0

    def __post_init__(self) -> None:
        require_non_negative(
            pixel_noise=self.pixel_noise,
            pixel_noise_by_side=self.pixel_noise_by_side,
            min_side_px=self.min_side_px,
            white_margin=self.white_margin,
            border_px=self.border_px,
        )
        require(self.max_range > 0, "max_range", self.max_range, "greater than 0")
        require(
            0 < self.max_incidence < np.pi / 2,
            "max_incidence",
            self.max_incidence,
            "between 0 and pi/2 (rad)",
        )
        require(
            0 <= self.miss_probability <= 1, "miss_probability", self.miss_probability, "0 to 1"
        )


@dataclass(frozen=True, eq=False)
class VisibleMarkers:
    """The markers that can be seen, without noise.

    Attributes:
        index: (m,) which of the markers.
        corners: (m, 4, 2) px, as the distorted picture shows them.
        side: (m,) narrow side, px.
        incidence: (m,) angle between the marker's normal and the line of sight, rad.
    """

    index: NDArray[np.intp]
    corners: Array
    side: Array
    incidence: Array


def visible_markers(
    *,
    camera: PinholeCamera,
    X_WC: RigidTransform,
    X_WM: Array,
    sizes: Array,
    cells: int,
    parameters: ProjectorParameters,
    solids: Solids | Callable[[], Solids] | None = None,
) -> VisibleMarkers:
    """Projects the markers that a detector could find.

    A marker is visible when the camera is on its printed side, within the range and the incidence;
    its corners and its white margin are before the camera and in the picture; its narrow side is
    large enough; and no solid hides its corners or its centre.

    Args:
        camera: intrinsics.
        X_WC: pose of the optical frame.
        X_WM: (n, 3, 4) rotations and translations (m) of the markers.
        sizes: (n,) sides of the black squares, m.
        cells: cells along a side of the black square.
        parameters: limits.
        solids: what may stand before the markers, or what gives it: asked only when there is one
            to hide, for in most pictures of many robots there is none.
    """
    n, p = len(sizes), parameters
    limits = np.array(
        (
            camera.width, camera.height, camera.fold_radius, math.cos(p.max_incidence),
            p.max_range, p.min_side_px, p.border_px, 1 + 2 * p.white_margin / cells,
        )
    )  # fmt: skip
    index, pixels, points = np.empty(n, np.intp), np.empty((n, 4, 2)), np.empty((n, 5, 3))
    side, distance, cosine = np.empty(n), np.empty(n), np.empty(n)
    pose = in_rows(X_WC.GetAsMatrix34(), 4)
    m = _find(
        pose, in_rows(X_WM, 3, 4), packed(sizes), _OUTLINE, *camera.matrices, limits,
        index, pixels, points, side, distance, cosine,
    )  # fmt: skip
    index, pixels, side, cosine = index[:m], pixels[:m], side[:m], cosine[:m]
    if m and solids is not None:
        hidden = np.empty(m, bool)
        standing = solids() if callable(solids) else solids
        _hide(standing.arrays, pose, points[:m], distance[:m], hidden)
        seen = ~hidden
        index, pixels, side, cosine = index[seen], pixels[seen], side[seen], cosine[seen]
    return VisibleMarkers(index, pixels, side, np.arccos(cosine))


@compiled(
    "i8(f8[:,::1], f8[:,:,::1], f8[::1], f8[:,::1], f8[:,::1], f8[::1], f8[::1],"
    " i8[::1], f8[:,:,::1], f8[:,:,::1], f8[::1], f8[::1], f8[::1])"
)
def _find(
    X_WC: Array,
    X_WM: Array,
    sizes: Array,
    outline: Array,
    K: Array,
    D: Array,
    limits: Array,
    index: Index,
    pixels: Array,
    points: Array,
    side: Array,
    distance: Array,
    cosine: Array,
) -> int:
    """Projects the markers that can be seen if nothing hides them, and returns how many they are.

    Args:
        X_WC: (3, 4).
        X_WM: (n, 3, 4).
        sizes: (n,) m.
        outline: (9, 3) corners, centre, corners of the margin; of a marker and a margin of size 1.
        K: (3, 3) px.
        D: (5,).
        limits: width (px), height (px), radius of the distortion's fold, cosine of the incidence,
            range (m), narrow side (px), border (px), size of the margin.
        index: (n,) the first of them written, as of all that follow: which markers.
        pixels: (n, 4, 2) corners, px.
        points: (n, 5, 3) corners and centre, m.
        side: (n,) narrow side, px.
        distance: (n,) from the camera, m.
        cosine: (n,) of the incidence.
    """
    width, height, fold, least_cosine = limits[0], limits[1], limits[2], limits[3]
    max_range, min_side, border = limits[4], limits[5], limits[6]
    low = border - 0.5  # the picture's edge: pixels count from their centres
    from_camera, p_W = np.empty(3), np.empty(3)
    m = 0
    for n in range(len(sizes)):
        toward, square = 0.0, 0.0
        for i in range(3):
            line = X_WC[i, 3] - X_WM[n, i, 3]
            toward += line * X_WM[n, i, 0]
            square += line * line
        far = math.sqrt(square)
        if not (toward > far * least_cosine and far <= max_range):
            continue
        inside = True
        for q in range(len(outline)):
            size = sizes[n] if q < 5 else sizes[n] * limits[7]
            for i in range(3):
                p_W[i] = X_WM[n, i, 3]
                for j in range(3):
                    p_W[i] += X_WM[n, i, j] * outline[q, j] * size
                from_camera[i] = p_W[i] - X_WC[i, 3]
            x, y, z = 0.0, 0.0, 0.0
            for i in range(3):
                x += X_WC[i, 0] * from_camera[i]
                y += X_WC[i, 1] * from_camera[i]
                z += X_WC[i, 2] * from_camera[i]
            if not (z > 0 and math.hypot(x, y) < fold * z):
                inside = False
                break
            bent_x, bent_y, _, _, _ = distort(x / z, y / z, D)
            u, v = K[0, 0] * bent_x + K[0, 2], K[1, 1] * bent_y + K[1, 2]
            if u < low or v < low or u > width - 1 - low or v > height - 1 - low:
                inside = False
                break
            if q < 5:
                points[m, q, 0], points[m, q, 1], points[m, q, 2] = p_W[0], p_W[1], p_W[2]
            if q < 4:
                pixels[m, q, 0], pixels[m, q, 1] = u, v
        if not inside:
            continue
        side[m] = narrow_side_of(pixels[m])
        if side[m] >= min_side:
            index[m], distance[m], cosine[m] = n, far, min(toward / far, 1.0)
            m += 1
    return m


@compiled(f"void({SOLID_ARRAYS}, f8[:,::1], f8[:,:,::1], f8[::1], b1[::1])")
def _hide(
    solids: SolidArrays, X_WC: Array, points: Array, distance: Array, hidden: NDArray[np.bool_]
) -> None:
    """Writes of which markers a solid hides a corner or the centre; arguments as of `_find`."""
    origin, tolerance, some = np.empty((1, 3)), np.empty(1), np.empty(5, np.bool_)
    for i in range(3):
        origin[0, i] = X_WC[i, 3]
    for n in range(len(points)):
        tolerance[0] = max(_BOARD, _BOARD_PART * distance[n])
        occlude(solids, origin, points[n], tolerance, some)
        hidden[n] = some.any()
