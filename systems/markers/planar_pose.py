"""Both poses of a single marker, in closed form and refined, all markers of a picture at once.

A planar square has two poses that explain its corners nearly equally well. They come from the
homography's derivative at the marker's centre: T. Collins, A. Bartoli, "Infinitesimal plane-based
pose estimation", IJCV 109 (2014); the derivation here is for a square of corners. Each is then a
local minimum of the reprojection error (`systems.markers.pnp`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.compiled import compiled, in_rows
from systems.markers.layout import marker_corners
from systems.markers.pnp import minimise, normal_equations
from systems.small_matrices import solve_positive, turn

Array = NDArray[np.float64]

SAME_POSE = 0.02  # rad; minima nearer to each other than this are one
_ITERATIONS, _TOLERANCE = 40, 1e-8  # see `pnp.refine`


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
    H = np.empty((len(corners), 3, 3))
    for quadrangle, homography in zip(in_rows(corners, 4, 2), H, strict=True):
        _homography(quadrangle, homography)
    return H


@compiled("void(f8[:,::1], f8[:,::1])")
def _homography(corners: Array, H: Array) -> None:
    # Heckbert's mapping of the square (0, 0), (1, 0), (1, 1), (0, 1), then a change of variables.
    d1x, d1y = corners[2, 0] - corners[1, 0], corners[2, 1] - corners[1, 1]
    d2x, d2y = corners[0, 0] - corners[1, 0], corners[0, 1] - corners[1, 1]
    sx = corners[3, 0] - corners[2, 0] + corners[1, 0] - corners[0, 0]
    sy = corners[3, 1] - corners[2, 1] + corners[1, 1] - corners[0, 1]
    determinant = d1x * d2y - d1y * d2x
    g, h = (sx * d2y - sy * d2x) / determinant, (d1x * sy - d1y * sx) / determinant
    # (u, v) in [-1, 1] -> ((u + 1) / 2, (v + 1) / 2)
    scale = g / 2 + h / 2 + 1
    H[2, 0], H[2, 1], H[2, 2] = g / 2 / scale, h / 2 / scale, 1.0
    for i in range(2):
        u = (corners[2, i] - corners[3, i] + g * corners[2, i]) / 2
        v = (corners[0, i] - corners[3, i] + h * corners[0, i]) / 2
        H[i, 0], H[i, 1], H[i, 2] = u / scale, v / scale, (u + v + corners[3, i]) / scale


@compiled()
def _two_rotations(H: Array, R: Array) -> None:
    """Writes the two rotations (2, 3, 3) of the plane with homography H (3, 3).

    Columns: the plane's normal, its first axis, its second axis: x, y and z of a marker.
    """
    cx, cy = H[0, 2], H[1, 2]  # the centre
    # Rv turns the optical axis to the direction of the centre.
    length = math.sqrt(cx * cx + cy * cy + 1)
    x, y, z = cx / length, cy / length, 1 / length
    Rv00, Rv01, Rv11 = 1 - x * x / (1 + z), -x * y / (1 + z), 1 - y * y / (1 + z)
    # A = B^-1 J of the 2 x 2 matrices J = H - centre H_3, B = Rv - centre Rv_3.
    J00, J01 = H[0, 0] - cx * H[2, 0], H[0, 1] - cx * H[2, 1]
    J10, J11 = H[1, 0] - cy * H[2, 0], H[1, 1] - cy * H[2, 1]
    B00, B01, B10, B11 = Rv00 + cx * x, Rv01 + cx * y, Rv01 + cy * x, Rv11 + cy * y
    determinant = B00 * B11 - B01 * B10
    A00, A01 = (B11 * J00 - B01 * J10) / determinant, (B11 * J01 - B01 * J11) / determinant
    A10, A11 = (B00 * J10 - B10 * J00) / determinant, (B00 * J11 - B10 * J01) / determinant
    # The largest singular value of A is the inverse distance.
    a, b, c = A00 * A00 + A01 * A01, A10 * A10 + A11 * A11, A00 * A10 + A01 * A11
    scale = math.sqrt((a + b + math.sqrt((a - b) ** 2 + 4 * c * c)) / 2)
    A00, A01, A10, A11 = A00 / scale, A01 / scale, A10 / scale, A11 / scale
    # The missing third row, but for its sign.
    first = math.sqrt(max(1 - A00 * A00 - A10 * A10, 0.0))
    second = math.sqrt(max(1 - A01 * A01 - A11 * A11, 0.0))
    if A00 * A01 + A10 * A11 > 0:
        second = -second
    for k in range(2):
        # Gram and Schmidt: rounding has left the columns not quite orthonormal.
        ux, uy, uz = A00, A10, first
        vx, vy, vz = A01, A11, second
        norm = math.sqrt(ux * ux + uy * uy + uz * uz)
        ux, uy, uz = ux / norm, uy / norm, uz / norm
        along = ux * vx + uy * vy + uz * vz
        vx, vy, vz = vx - along * ux, vy - along * uy, vz - along * uz
        norm = math.sqrt(vx * vx + vy * vy + vz * vz)
        vx, vy, vz = vx / norm, vy / norm, vz / norm
        wx, wy, wz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for j, (ex, ey, ez) in enumerate(((wx, wy, wz), (ux, uy, uz), (vx, vy, vz))):
            R[k, 0, j] = Rv00 * ex + Rv01 * ey + x * ez
            R[k, 1, j] = Rv01 * ex + Rv11 * ey + y * ez
            R[k, 2, j] = -x * ex - y * ey + z * ez
        first, second = -first, -second


@compiled("void(f8[:,::1], f8[:,::1], f8[:,::1], f8[::1])")
def _translation(R: Array, points: Array, rays: Array, p: Array) -> None:
    """Writes the position (3,) that fits rays (m, 2) best, linearly, for a given rotation."""
    # x (arm_z + p_z) = arm_x + p_x, and the same in y: two rows [1 0 -x], [0 1 -y] a point.
    N = np.zeros((3, 3))
    p[0], p[1], p[2] = 0.0, 0.0, 0.0
    for k in range(len(points)):
        x, y = rays[k, 0], rays[k, 1]
        a, b, c = points[k, 0], points[k, 1], points[k, 2]
        arm_z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c
        right_x = arm_z * x - (R[0, 0] * a + R[0, 1] * b + R[0, 2] * c)
        right_y = arm_z * y - (R[1, 0] * a + R[1, 1] * b + R[1, 2] * c)
        p[0] += right_x
        p[1] += right_y
        p[2] -= x * right_x + y * right_y
        N[0, 0] += 1.0
        N[1, 1] += 1.0
        N[2, 0] -= x
        N[2, 1] -= y
        N[2, 2] += x * x + y * y
    if not solve_positive(N, p):
        p[0], p[1], p[2] = 0.0, 0.0, 0.0


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
    seen = in_rows(_points(sizes), 4, 3), in_rows(rays, 4, 2), in_rows(by_ray, 4, 2, 2)
    good, R, p = np.empty(n, bool), np.empty((n, 2, 3, 3)), np.empty((n, 2, 3))
    _closed_forms(*seen[:2], good, R, p)
    product = minimise(
        R.reshape(-1, 3, 3), p.reshape(-1, 3), *seen, _ITERATIONS, _TOLERANCE, math.inf
    ).reshape(n, 2, 7, 7)
    second_is_minimum = np.empty(n, bool)
    _settle(R, p, product, *seen, second_is_minimum)
    return PlanarPoses(R, p, product[..., 6, 6], product[..., :6, :6], good & second_is_minimum)


@compiled(
    "void(f8[:,:,:,::1], f8[:,:,::1], f8[:,:,:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,:,:,::1],"
    " b1[::1])"
)
def _settle(
    R: Array,
    p: Array,
    product: Array,
    points: Array,
    rays: Array,
    by_ray: Array,
    second_is_minimum: NDArray[np.bool_],
) -> None:
    """Puts the better pose first, and its mirror image second where both are one minimum.

    Args:
        R: (n, 2, 3, 3), changed.
        p: (n, 2, 3), changed.
        product: (n, 2, 7, 7) as `minimise` returns it, changed.
        points: (n, 4, 3).
        rays: (n, 4, 2).
        by_ray: (n, 4, 2, 2).
        second_is_minimum: (n,) written.
    """
    sight = np.empty(3)
    for n in range(len(R)):
        if product[n, 1, 6, 6] < product[n, 0, 6, 6]:
            for i in range(7):
                for j in range(7):
                    a, b = product[n, 0, i, j], product[n, 1, i, j]
                    product[n, 0, i, j], product[n, 1, i, j] = b, a
            for i in range(3):
                p[n, 0, i], p[n, 1, i] = p[n, 1, i], p[n, 0, i]
                for j in range(3):
                    R[n, 0, i, j], R[n, 1, i, j] = R[n, 1, i, j], R[n, 0, i, j]
        cosine, square = -0.5, 0.0
        for i in range(3):
            square += p[n, 0, i] * p[n, 0, i]
            for j in range(3):
                cosine += R[n, 0, i, j] * R[n, 1, i, j] / 2
        second_is_minimum[n] = math.acos(min(max(cosine, -1.0), 1.0)) >= SAME_POSE
        if second_is_minimum[n] or math.isinf(product[n, 0, 6, 6]):
            continue
        for i in range(3):
            sight[i] = -p[n, 0, i] / math.sqrt(square)
        _mirror(R[n, 0], sight, R[n, 1])
        _translation(R[n, 1], points[n], rays[n], p[n, 1])
        normal_equations(R[n, 1], p[n, 1], points[n], rays[n], by_ray[n], product[n, 1])


def closed_form(rays: Array, sizes: Array) -> tuple[NDArray[np.bool_], Array, Array]:
    """Returns both poses of each marker as the homography gives them, not refined.

    Args:
        rays: (n, 4, 2) x/z, y/z of the corners, in the design's order.
        sizes: (n,) sides of the black squares, m.

    Returns:
        (n,) which markers have poses at all, and for those m: (m, 2, 3, 3) `R_CM` and (m, 2, 3)
        `p_CM`, m.
    """
    n = len(rays)
    good, R, p = np.empty(n, bool), np.empty((n, 2, 3, 3)), np.empty((n, 2, 3))
    _closed_forms(in_rows(_points(sizes), 4, 3), in_rows(rays, 4, 2), good, R, p)
    return (good, R, p) if good.all() else (good, R[good], p[good])


@compiled("void(f8[:,:,::1], f8[:,:,::1], b1[::1], f8[:,:,:,::1], f8[:,:,::1])")
def _closed_forms(points: Array, rays: Array, good: NDArray[np.bool_], R: Array, p: Array) -> None:
    """Writes which markers have poses, and those; the identity for the others."""
    for n in range(len(rays)):
        good[n] = _two_poses(points[n], rays[n], R[n], p[n])
        if not good[n]:
            R[n], p[n] = 0.0, 0.0
            R[n, :, 0, 0], R[n, :, 1, 1], R[n, :, 2, 2] = 1.0, 1.0, 1.0


@compiled()
def _two_poses(points: Array, corners: Array, R: Array, p: Array) -> bool:
    """Writes both poses of a marker by its homography; False, with R and p spoilt, without any."""
    H = np.empty((3, 3))
    if not _faces_us(corners):
        return False
    _homography(corners, H)
    for i in range(3):
        for j in range(3):
            if not math.isfinite(H[i, j]):
                return False
    _two_rotations(H, R)
    for k in range(2):
        _translation(R[k], points, corners, p[k])
    return True


@compiled()
def _faces_us(corners: Array) -> bool:
    """Whether corners (4, 2) are those of a convex marker seen from the front.

    Then they go clockwise in the picture, where y points down.
    """
    for i in range(4):
        j, k = (i + 1) % 4, (i + 3) % 4
        ahead_x, ahead_y = corners[j, 0] - corners[i, 0], corners[j, 1] - corners[i, 1]
        behind_x, behind_y = corners[k, 0] - corners[i, 0], corners[k, 1] - corners[i, 1]
        if not ahead_x * behind_y - ahead_y * behind_x > 0:
            return False
    return True


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
    image = np.empty((len(R), 3, 3))
    _mirror_all(in_rows(R, 3, 3), in_rows(sight, 3), image)
    return image


@compiled("void(f8[:,:,::1], f8[:,::1], f8[:,:,::1])")
def _mirror_all(R: Array, sight: Array, image: Array) -> None:
    for n in range(len(R)):
        _mirror(R[n], sight[n], image[n])


@compiled()
def _mirror(R: Array, sight: Array, image: Array) -> None:
    w, square, cosine = np.empty(3), 0.0, 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        w[i] = R[j, 0] * sight[k] - R[k, 0] * sight[j]
        square += w[i] * w[i]
        cosine += R[i, 0] * sight[i]
    sine = math.sqrt(square)
    for i in range(3):
        w[i] *= 2 * math.atan2(sine, cosine) / max(sine, 1e-12)
    turn(w, R, image)


def angle_between(R1: Array, R2: Array) -> Array:
    """Returns (n,) the angle of the rotation from one to the other, rad."""
    cosine = ((R1 * R2).sum(axis=(-1, -2)) - 1) / 2
    return np.arccos(np.clip(cosine, -1, 1))
