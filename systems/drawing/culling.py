"""What a camera cannot see at all is left out before any of it is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import FrameId

from systems.cameras import PinholeCamera
from systems.drawing.solids import border_rays

Array = NDArray[np.float64]


@lru_cache(maxsize=64)
def pyramid(camera: PinholeCamera) -> Array:
    """Returns the inward unit normals (5, 3) of the camera's plane and of what bounds its view."""
    rays = border_rays(camera)
    (left, top), (right, bottom) = rays.min(axis=0), rays.max(axis=0)
    sides = [[1.0, 0.0, -left], [-1.0, 0.0, right], [0.0, 1.0, -top], [0.0, -1.0, bottom]]
    normals = np.array([[0.0, 0.0, 1.0], *sides])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


class BoundingBalls:
    """Balls around things that are fixed to frames.

    Args:
        frames: (n,) whose they are.
        points: (n,) arrays (k, 3) m in those frames, whose hulls hold the things.
    """

    def __init__(self, frames: Sequence[FrameId], points: Sequence[Array]) -> None:
        self.frames = tuple(frames)
        centres = [(p.min(axis=0) + p.max(axis=0)) / 2 for p in points]
        self._centres = np.array(centres).reshape(-1, 3)
        self._radii = np.array(
            [np.linalg.norm(p - c, axis=1).max() for p, c in zip(points, centres, strict=True)]
        )
        self._members: dict[FrameId, list[int]] = {}
        for k, frame in enumerate(frames):
            self._members.setdefault(frame, []).append(k)

    def in_view(self, camera: PinholeCamera, poses: dict[FrameId, Array]) -> list[int]:
        """Returns which of them a camera may see, in their order.

        Args:
            camera: calibrated camera.
            poses: (3, 4) rotation and translation (m) of each frame in the optical frame.
        """
        seen: list[int] = []
        for frame, members in self._members.items():
            X_CF = poses[frame]
            centres = self._centres[members] @ X_CF[:, :3].T + X_CF[:, 3]
            inside = (centres @ pyramid(camera).T >= -self._radii[members, None]).all(axis=1)
            seen += [members[k] for k in np.flatnonzero(inside)]
        return sorted(seen)
