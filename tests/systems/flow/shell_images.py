"""Exact pictures of a perforated shell: every ray of a pixel meets the sphere where it does."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RotationMatrix

from systems.cameras import PinholeCamera
from systems.flow.shell import ShellViewParameters, looking_down

CAMERA = PinholeCamera.from_focal_length(640, 480, 481.0)
PITCH = 0.002  # m, from hole to hole
HOLE = 0.0005  # m, radius

# Stains: wave vectors (rad/m) and phases of a smooth brightness over the steel.
_RANDOM = np.random.default_rng(5)
_WAVES = _RANDOM.normal(size=(12, 3)) * 600.0
_PHASES = _RANDOM.uniform(0, 2 * np.pi, 12)


def rotation(vector: np.ndarray) -> RotationMatrix:
    """exp of a rotation vector, by Drake's angle and axis."""
    angle = float(np.linalg.norm(vector))
    return RotationMatrix(AngleAxis(angle, vector / angle)) if angle else RotationMatrix()


def picture(
    R_RS: RotationMatrix,
    *,
    camera: PinholeCamera = CAMERA,
    parameters: ShellViewParameters | None = None,
    noise: float = 0.0,
    seed: int = 0,
    stains: float = 6.0,
    supersampling: int = 4,
) -> NDArray[np.uint8]:
    """Draws what a camera over the shell sees.

    Args:
        R_RS: axes of the body in those of the shell R; the x axis of R is where longitude and
            latitude are 0, and the grid of holes follows them.
        camera: undistorted.
        parameters: the shell and the camera's place.
        noise: standard deviation, grey levels.
        seed: of the noise.
        stains: amplitude of the smooth brightness, grey levels.
        supersampling: rays along a pixel's side.
    """
    p = parameters or ShellViewParameters()
    X_RC = RigidTransform(R_RS, np.zeros(3)) @ looking_down(p)
    # The steel is smooth enough for one ray a pixel; the edges of the holes are not.
    steel = 150.0 + stains * stain(surface(camera, X_RC, p.radius, 1))
    k = supersampling
    fine = hole(surface(camera, X_RC, p.radius, k), p.radius)
    share = fine.reshape(camera.height, k, camera.width, k).mean(axis=(1, 3))
    image = share * 30.0 + (1 - share) * steel.reshape(share.shape)
    if noise:
        image += noise * np.random.default_rng(seed).standard_normal(image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def surface(camera: PinholeCamera, X_RC: RigidTransform, radius: float, k: int) -> np.ndarray:
    """Where the rays of k x k points of each pixel meet the shell: (rows columns, 3) m, in R."""
    x = ((np.arange(camera.width * k) + 0.5) / k - 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    y = ((np.arange(camera.height * k) + 0.5) / k - 0.5 - camera.K[1, 2]) / camera.K[1, 1]
    R, o = X_RC.rotation().matrix(), X_RC.translation()
    rays = x[None, :, None] * R[:, 0] + (y[:, None, None] * R[:, 1] + R[:, 2])
    a = x[None, :] ** 2 + y[:, None] ** 2 + 1
    b = rays @ o
    c = o @ o - radius**2
    rays *= ((-b - np.sqrt(b * b - a * c)) / a)[..., None]
    rays += o
    return rays.reshape(-1, 3)


def hole(points: np.ndarray, radius: float) -> np.ndarray:
    """Whether points (n, 3) of the shell, in R, are holes: on a grid along longitude, latitude."""
    along = radius * np.arctan2(points[:, 1], points[:, 0])
    across = radius * np.arcsin(points[:, 2] / radius)
    offset = [q - PITCH * np.rint(q / PITCH) for q in (along, across)]
    return offset[0] ** 2 + offset[1] ** 2 < HOLE**2


def stain(points: np.ndarray) -> np.ndarray:
    """Smooth brightness of the steel at points (n, 3), in R, of standard deviation 1."""
    return np.cos(points @ _WAVES.T + _PHASES).sum(axis=1) / np.sqrt(6.0)


def on_the_equator(along: float = 0.0, roll: float = 0.0) -> RotationMatrix:
    """Axes of a body on the equator that heads along it, `along` metres per radius further."""
    # z out (x of R), x along the growing longitude (y of R), y to the pole.
    heading = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return (
        RotationMatrix.MakeZRotation(along)
        @ RotationMatrix(heading)
        @ (RotationMatrix.MakeZRotation(roll))
    )
