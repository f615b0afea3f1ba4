"""A camera that looks down at a spherical shell: from pixels to the surface and back.

Frame S: origin in the shell's centre, axes of the body B that carries the camera (x forward, y
left, z outward through the body). While the body drives over the shell, its camera stays where it
is in S, and the points of the shell turn about S's origin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from systems.cameras import PinholeCamera
from systems.compiled import compiled, in_rows, packed
from systems.markers.pnp import rotation_from_vector
from systems.plumb_bob import distort, find_rays
from systems.validation import require, require_positive

Array = NDArray[np.float64]

# Axes of an optical frame that looks along -z of the body, the top of its picture to the front.
R_DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass
class ShellViewParameters:
    """Where the camera is over the shell.

    Attributes:
        radius: of the shell, m.
        camera_height: of the optical centre above the surface, m.
        camera_tilt: how the camera is turned away from looking straight down, with the top of its
            picture to the front: rotation vector in B, rad.
    """

    radius: float = 0.075
    camera_height: float = 0.010
    camera_tilt: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])

    def __post_init__(self) -> None:
        require_positive(radius=self.radius, camera_height=self.camera_height)
        sound = len(self.camera_tilt) == 3 and bool(np.isfinite(self.camera_tilt).all())
        require(sound, "camera_tilt", self.camera_tilt, "three finite numbers (rad)")


def looking_down(parameters: ShellViewParameters) -> RigidTransform:
    """Returns the pose of the optical frame in S, `X_SC`."""
    R = rotation_from_vector(np.array(parameters.camera_tilt, float)) @ R_DOWN
    return RigidTransform(
        RotationMatrix(R), [0.0, 0.0, parameters.radius + parameters.camera_height]
    )


def back_project(
    camera: PinholeCamera, X_SC: RigidTransform, radius: float, pixels: Array
) -> Array:
    """Returns the points of the shell that pixels show.

    Args:
        camera: intrinsics.
        X_SC: pose of the optical frame in a frame whose origin is the shell's centre.
        radius: of the shell, m.
        pixels: (n, 2) px.

    Returns:
        (n, 3) m, in S; NaN where a pixel shows none.
    """
    points = np.empty((len(pixels), 3))
    R, p = packed(X_SC.rotation().matrix()), packed(X_SC.translation())
    meet_sphere(in_rows(camera.undistort(pixels), 2), R, p, radius, points)
    return points


@compiled("void(f8[:,::1], f8[:,::1], f8[::1], f8, f8[:,::1])")
def meet_sphere(rays: Array, R: Array, p: Array, radius: float, points: Array) -> None:
    """Writes where rays (n, 2) x/z, y/z of a camera at R, p meet a sphere about the origin."""
    square = p[0] * p[0] + p[1] * p[1] + p[2] * p[2] - radius * radius
    d = np.empty(3)
    for k in range(len(rays)):
        x, y = rays[k, 0], rays[k, 1]
        length = math.sqrt(x * x + y * y + 1)
        along = 0.0
        for i in range(3):
            d[i] = (R[i, 0] * x + R[i, 1] * y + R[i, 2]) / length
            along += d[i] * p[i]
        discriminant = along * along - square
        distance = -along - math.sqrt(discriminant) if discriminant >= 0 else math.nan
        for i in range(3):
            points[k, i] = p[i] + distance * d[i] if distance > 0 else math.nan


def project(camera: PinholeCamera, X_SC: RigidTransform, points: Array) -> Array:
    """Returns the pixels that show points of the shell.

    Args:
        camera: intrinsics.
        X_SC: pose of the optical frame in a frame whose origin is the shell's centre.
        points: (n, 3) m, on the shell, in S.

    Returns:
        (n, 2) px, NaN for points behind the camera, beyond the shell's horizon, or beyond where the
        lens' model holds; pixels may lie outside the picture.
    """
    pixels = np.empty((len(points), 2))
    R, p = packed(X_SC.rotation().matrix()), packed(X_SC.translation())
    see(in_rows(points, 3), R, p, *camera.matrices, camera.fold_radius, pixels)
    return pixels


@compiled("void(f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[::1], f8, f8[:,::1])")
def see(
    points: Array, R: Array, p: Array, K: Array, D: Array, fold_radius: float, pixels: Array
) -> None:
    """Writes the pixels (n, 2) that show points (n, 3) to a camera at R, p; NaN where none does."""
    for k in range(len(points)):
        x, y, z, above = 0.0, 0.0, 0.0, 0.0
        for i in range(3):
            line = points[k, i] - p[i]
            above -= line * points[k, i]
            x += line * R[i, 0]
            y += line * R[i, 1]
            z += line * R[i, 2]
        if above > 0 and z > 0 and math.hypot(x, y) < fold_radius * z:
            bent_x, bent_y, _, _, _ = distort(x / z, y / z, D)
            pixels[k, 0], pixels[k, 1] = K[0, 0] * bent_x + K[0, 2], K[1, 1] * bent_y + K[1, 2]
        else:
            pixels[k, 0], pixels[k, 1] = math.nan, math.nan


@compiled(
    "i8(f8[:,::1], f8[:,::1], f8, f8, f8[:,::1], f8[::1], f8, f8[:,::1], f8[::1], f8,"
    " f8[:,:,::1], f8[:,::1])"
)
def _matched(
    previous: Array,
    current: Array,
    width: float,
    height: float,
    K: Array,
    D: Array,
    fold_radius: float,
    R: Array,
    p: Array,
    radius: float,
    points: Array,
    pixels: Array,
) -> int:
    """Writes the points (2, n, 3) and the later pixels (n, 2) of matches; returns how many serve.

    Those serve of which both pixels (n, 2) are in the picture and show the shell.
    """
    n = len(previous)
    rays, by_ray, met = np.empty((n, 2)), np.empty((n, 2, 2)), np.empty((2, n, 3))
    find_rays(previous, K, D, fold_radius, rays, by_ray)
    meet_sphere(rays, R, p, radius, met[0])
    find_rays(current, K, D, fold_radius, rays, by_ray)
    meet_sphere(rays, R, p, radius, met[1])
    count = 0
    for k in range(n):
        serves = math.isfinite(met[0, k, 0]) and math.isfinite(met[1, k, 0])
        for i in range(2):
            most = (height if i else width) - 0.5
            serves = serves and -0.5 <= previous[k, i] <= most and -0.5 <= current[k, i] <= most
        if serves:
            points[:, count], pixels[count] = met[:, k], current[k]
            count += 1
    return count


class ShellView:
    """A calibrated camera at its place over a shell.

    Args:
        camera: intrinsics.
        parameters: the shell and the place.
    """

    def __init__(
        self, *, camera: PinholeCamera, parameters: ShellViewParameters | None = None
    ) -> None:
        self.camera = camera
        self.parameters = parameters or ShellViewParameters()
        self.radius = self.parameters.radius
        self.X_SC = X_SC = looking_down(self.parameters)
        self._place = packed(X_SC.rotation().matrix()), packed(X_SC.translation())

    def back_project(self, pixels: Array) -> Array:
        """Returns the points (n, 3) m of the shell, in S, that pixels (n, 2) show; NaN for none."""
        return back_project(self.camera, self.X_SC, self.radius, pixels)

    def matched(self, previous: Array, current: Array) -> tuple[Array, Array, Array]:
        """Returns the points of the shell that matches show, (n, 3) m in S in each picture.

        Of those only, of which both pixels are in the picture and show the shell.

        Args:
            previous: (m, 2) px.
            current: (m, 2) px.

        Returns:
            The points in the first and in the second picture, and the pixels (n, 2) in the second.
        """
        camera, n = self.camera, len(previous)
        points, pixels = np.empty((2, n, 3)), np.empty((n, 2))
        count = _matched(
            packed(previous), packed(current), float(camera.width), float(camera.height),
            *camera.matrices, camera.fold_radius, *self._place, self.radius, points, pixels,
        )  # fmt: skip
        return points[0, :count], points[1, :count], pixels[:count]

    def turned(self, pixels: Array, increment: Array) -> Array:
        """Returns where points are seen after the body has turned about the shell's centre.

        Args:
            pixels: (n, 2) px, before.
            increment: (3,) the body's rotation relative to the shell, `R_B1B2 = exp(increment)`,
                rad.

        Returns:
            (n, 2) px, NaN where they are no longer seen.
        """
        R_B1B2 = rotation_from_vector(increment)
        return project(self.camera, self.X_SC, self.back_project(pixels) @ R_B1B2)

    def inside(self, pixels: Array) -> NDArray[np.bool_]:
        """Returns which pixels (..., 2) are in the picture."""
        return inside(self.camera, pixels)


def inside(camera: PinholeCamera, pixels: Array) -> NDArray[np.bool_]:
    """Returns which pixels (..., 2) are in the camera's picture; NaN is not."""
    within = (pixels >= -0.5) & (pixels <= [camera.width - 0.5, camera.height - 0.5])
    return np.asarray(within[..., 0] & within[..., 1], bool)
