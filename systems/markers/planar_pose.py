"""Both poses of a single marker, in closed form and refined, all markers of a picture at once.

A planar square has two poses that explain its corners nearly equally well. They come from the
homography's derivative at the marker's centre: T. Collins, A. Bartoli, "Infinitesimal plane-based
pose estimation", IJCV 109 (2014); the derivation here is for a square of corners. Each is then a
local minimum of the reprojection error (`systems.markers.pnp`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.markers.layout import marker_corners
from systems.markers.pnp import PnpSolution, refine, rotation_from_vector

Array = NDArray[np.float64]

SAME_POSE = 0.02  # rad; minima nearer to each other than this are one
_NEXT, _AFTER = [1, 2, 0], [2, 0, 1]  # the other two axes of each, in cyclic order


@dataclass(frozen=True, eq=False)
class PlanarPoses:
    """Two poses of each of n markers in the optical frame, the better one first.

    Attributes:
        R: (n, 2, 3, 3) `R_CM`.
        p: (n, 2, 3) `p_CM`, m.
        squared_error: (n, 2) sum of squared corner residuals, px^2; inf where there is no pose.
        information: (n, 2, 6, 6) of the tangent (rotation first, in C), for noise of 1 px.
        second_is_minimum: (n,) whether the second pose is a minimum of its own. Seen nearly from
            the front the two minima merge; the second is then the mirror image of the first about
            the line of sight, and its error says whether the corners exclude it.
    """

    R: Array
    p: Array
    squared_error: Array
    information: Array
    second_is_minimum: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.R)

    def reprojection_rms(self) -> Array:
        """Returns (n, 2) the root mean square distance of the corners from their image, px."""
        return np.sqrt(self.squared_error / 4)


def homography_of_square(corners: Array) -> Array:
    """Returns the homographies that take the unit square to quadrangles, in closed form.

    Args:
        corners: (n, 4, 2) images of (-1, 1), (1, 1), (1, -1), (-1, -1).

    Returns:
        (n, 3, 3), lower right entry 1; not finite when three corners lie on a line.
    """
    # Heckbert's mapping of the square (0, 0), (1, 0), (1, 1), (0, 1), then a change of variables.
    c0, c1, c2, c3 = (corners[:, i] for i in (3, 2, 1, 0))
    d1, d2 = c1 - c2, c3 - c2
    s = c0 - c1 + c2 - c3
    determinant = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    g = (s[:, 0] * d2[:, 1] - s[:, 1] * d2[:, 0]) / determinant
    h = (d1[:, 0] * s[:, 1] - d1[:, 1] * s[:, 0]) / determinant
    H = np.empty((len(corners), 3, 3))
    H[:, :2, 0] = c1 - c0 + g[:, None] * c1
    H[:, :2, 1] = c3 - c0 + h[:, None] * c3
    H[:, :2, 2] = c0
    H[:, 2, 0], H[:, 2, 1], H[:, 2, 2] = g, h, 1.0
    # (u, v) in [-1, 1] -> ((u + 1) / 2, (v + 1) / 2)
    H = H @ np.array([[0.5, 0.0, 0.5], [0.0, 0.5, 0.5], [0.0, 0.0, 1.0]])
    return H / H[:, 2:, 2:]


def _two_rotations(H: Array) -> Array:
    """Returns the two rotations (n, 2, 3, 3) of planes with homographies (n, 3, 3).

    Columns: the plane's first axis, its second axis, its normal.
    """
    centre = H[:, :2, 2]
    J = H[:, :2, :2] - centre[:, :, None] * H[:, 2:, :2]
    # Rv turns the optical axis to the direction of the centre.
    direction = np.concatenate([centre, np.ones((len(H), 1))], axis=1)
    direction /= np.sqrt((direction * direction).sum(axis=1, keepdims=True))
    x, y, z = direction.T
    Rv = np.empty((len(H), 3, 3))
    Rv[:, 0, 0] = 1 - x * x / (1 + z)
    Rv[:, 0, 1] = Rv[:, 1, 0] = -x * y / (1 + z)
    Rv[:, 1, 1] = 1 - y * y / (1 + z)
    Rv[:, :, 2] = direction
    Rv[:, 2, 0], Rv[:, 2, 1] = -x, -y
    B = Rv[:, :2, :2] - centre[:, :, None] * Rv[:, 2:, :2]
    A = np.linalg.solve(B, J)
    # The largest singular value of A is the inverse distance.
    AAt = A @ A.swapaxes(1, 2)
    a, b, c = AAt[:, 0, 0], AAt[:, 1, 1], AAt[:, 0, 1]
    scale = np.sqrt((a + b + np.sqrt((a - b) ** 2 + 4 * c * c)) / 2)
    top = A / scale[:, None, None]
    rest = np.maximum(1 - (top * top).sum(axis=1), 0.0)  # squares of the missing third row
    product = -(top[:, :, 0] * top[:, :, 1]).sum(axis=1)
    first, second = np.sqrt(rest).T
    second = np.where(product < 0, -second, second)
    columns = np.empty((len(H), 2, 3, 3))
    columns[:, :, :2, :2] = top[:, None]
    columns[:, 0, 2, 0], columns[:, 0, 2, 1] = first, second
    columns[:, 1, 2, :2] = -columns[:, 0, 2, :2]
    # Gram and Schmidt: rounding has left the columns not quite orthonormal.
    e1, e2, e3 = (columns[..., i] for i in range(3))
    e1 /= np.sqrt((e1 * e1).sum(axis=-1, keepdims=True))
    e2 -= (e2 * e1).sum(axis=-1, keepdims=True) * e1
    e2 /= np.sqrt((e2 * e2).sum(axis=-1, keepdims=True))
    e3[...] = e1[..., _NEXT] * e2[..., _AFTER] - e1[..., _AFTER] * e2[..., _NEXT]  # e1 x e2
    return Rv[:, None] @ columns


def _translations(R: Array, points: Array, rays: Array) -> Array:
    """Returns the positions (b, 3) that fit rays (b, m, 2) best, linearly, for given rotations."""
    arm = points @ R.swapaxes(-1, -2)
    # x (arm_z + p_z) = arm_x + p_x, and the same in y: two rows [1 0 -x], [0 1 -y] a point.
    m = rays.shape[1]
    right = arm[..., 2:] * rays - arm[..., :2]
    N = np.zeros((len(R), 3, 3))
    N[:, 0, 0] = N[:, 1, 1] = m
    N[:, :2, 2] = N[:, 2, :2] = -rays.sum(axis=1)
    N[:, 2, 2] = (rays * rays).sum(axis=(1, 2))
    v = np.concatenate([right.sum(axis=1), -(rays * right).sum(axis=(1, 2))[:, None]], axis=1)
    return np.linalg.solve(N, v[..., None])[..., 0]


def planar_poses(rays: Array, by_ray: Array, sizes: Array) -> PlanarPoses:
    """Solves both poses of each marker.

    Args:
        rays: (n, 4, 2) x/z, y/z of the corners, in the design's order.
        by_ray: (n, 4, 2, 2) derivative of the pixels by the rays (`PinholeCamera.rays`), px.
        sizes: (n,) sides of the black squares, m.

    Returns:
        The poses, each a local minimum of the reprojection error, the better one first. A marker
        whose corners admit no pose (not convex, not finite) has infinite errors and the identity
        as pose; never NaN.
    """
    n = len(rays)
    poses = PlanarPoses(
        R=np.tile(np.eye(3), (n, 2, 1, 1)),
        p=np.zeros((n, 2, 3)),
        squared_error=np.full((n, 2), np.inf),
        information=np.zeros((n, 2, 6, 6)),
        second_is_minimum=np.zeros(n, bool),
    )
    good, R, p = closed_form(rays, sizes)
    if not good.any():
        return poses
    points, rays, by_ray = _points(sizes[good]), rays[good], by_ray[good]
    twice = (v.repeat(2, axis=0) for v in (points, rays, by_ray))
    minima = refine(R.reshape(-1, 3, 3), p.reshape(-1, 3), *twice)
    R, p, error, information = _better_first(minima)
    merged = angle_between(R[:, 0], R[:, 1]) < SAME_POSE
    if merged.any():
        p_first = p[merged, 0]
        mirror = mirrored(R[merged, 0], -p_first / np.linalg.norm(p_first, axis=1, keepdims=True))
        seen = points[merged], rays[merged], by_ray[merged]
        image = refine(mirror, _translations(mirror, *seen[:2]), *seen, iterations=0)
        R[merged, 1], p[merged, 1] = image.R, image.p
        error[merged, 1], information[merged, 1] = image.squared_error, image.information
    poses.R[good], poses.p[good] = R, p
    poses.squared_error[good], poses.information[good] = error, information
    poses.second_is_minimum[good] = ~merged
    return poses


def closed_form(rays: Array, sizes: Array) -> tuple[NDArray[np.bool_], Array, Array]:
    """Returns both poses of each marker as the homography gives them, not refined.

    Args:
        rays: (n, 4, 2) x/z, y/z of the corners, in the design's order.
        sizes: (n,) sides of the black squares, m.

    Returns:
        (n,) which markers have poses at all, and for those m: (m, 2, 3, 3) `R_CM` and (m, 2, 3)
        `p_CM`, m.
    """
    with np.errstate(all="ignore"):
        H = homography_of_square(rays)
        good = np.asarray(np.isfinite(H).all(axis=(1, 2)))
        good &= (_twice_signed_areas(rays) > 0).all(axis=1)
    if not good.any():
        return good, np.zeros((0, 2, 3, 3)), np.zeros((0, 2, 3))
    # The homography's plane has axes (right, up); a marker's are y and z, its normal is x.
    R = _two_rotations(H[good])[..., [2, 0, 1]]
    p = _translations(
        R.reshape(-1, 3, 3), _points(sizes[good]).repeat(2, axis=0), rays[good].repeat(2, axis=0)
    )
    return good, R, p.reshape(-1, 2, 3)


def _points(sizes: Array) -> Array:
    """Returns (n, 4, 3) corners of markers in their own frames, m."""
    return marker_corners(1.0) * sizes[:, None, None]


def mirrored(R: Array, sight: Array) -> Array:
    """Returns markers' rotations with the normal (x) mirrored about the line of sight.

    A rotation by twice the tilt, about the axis at right angles to both.

    Args:
        R: (n, 3, 3) of markers in any frame.
        sight: (n, 3) directions to the viewer in that frame, of length 1.
    """
    normal = R[:, :, 0]
    axis = np.cross(normal, sight)
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    tilt = np.arctan2(sine, (normal * sight).sum(axis=1, keepdims=True))
    return rotation_from_vector(axis / np.maximum(sine, 1e-12) * 2 * tilt) @ R


def angle_between(R1: Array, R2: Array) -> Array:
    """Returns (n,) the angle of the rotation from one to the other, rad."""
    cosine = ((R1 * R2).sum(axis=(-1, -2)) - 1) / 2
    return np.arccos(np.clip(cosine, -1, 1))


def _better_first(solution: PnpSolution) -> tuple[Array, Array, Array, Array]:
    error = solution.squared_error.reshape(-1, 2)
    order = np.argsort(error, axis=1, kind="stable")
    rows = np.arange(len(error))[:, None]
    return (
        solution.R.reshape(-1, 2, 3, 3)[rows, order],
        solution.p.reshape(-1, 2, 3)[rows, order],
        error[rows, order],
        solution.information.reshape(-1, 2, 6, 6)[rows, order],
    )


def _twice_signed_areas(corners: Array) -> Array:
    """Returns (n, 4) the signed area at each corner.

    All are positive for a convex marker seen from the front: clockwise in the picture, where y
    points down.
    """
    ahead = corners[:, [1, 2, 3, 0]] - corners
    behind = -ahead[:, [3, 0, 1, 2]]
    return ahead[..., 0] * behind[..., 1] - ahead[..., 1] * behind[..., 0]
