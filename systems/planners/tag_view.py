"""Which tags a camera on the robot has in view from places of a route."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from systems.angles import spatial_pose
from systems.cameras import PinholeCamera
from systems.markers.layout import MarkerMap
from systems.markers.visibility import ProjectorParameters, visible_markers

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TagView:
    """A camera on the robot, and what it could find.

    Attributes:
        tags: the map.
        camera: its intrinsics.
        X_BC: pose of the optical frame in base_link.
        parameters: when a tag is found.
    """

    tags: MarkerMap
    camera: PinholeCamera
    X_BC: RigidTransform
    parameters: ProjectorParameters = field(default_factory=ProjectorParameters)

    def count(self, poses: Array) -> NDArray[np.intp]:
        """Returns how many tags are in view from poses (n, 3) of base_link: (n,)."""
        X_WM = np.array([tag.X_WM.GetAsMatrix34() for tag in self.tags]).reshape(-1, 3, 4)
        sizes = np.array([tag.size for tag in self.tags])
        return np.array(
            [
                len(
                    visible_markers(
                        camera=self.camera,
                        X_WC=spatial_pose(pose) @ self.X_BC,
                        X_WM=X_WM,
                        sizes=sizes,
                        cells=self.tags.family.cells,
                        parameters=self.parameters,
                    ).index
                )
                for pose in poses
            ],
            np.intp,
        )

    def intervals(self, poses: Array, width: float, least: int, samples: int = 7) -> Array:
        """Returns how far aside each pose may be moved with enough tags in view.

        Args:
            poses: (n, 3).
            width: the most to either side, m.
            least: tags to be in view.
            samples: of the width, an odd number.

        Returns:
            (n, 2) from the right (negative) to the left, m: the stretch about the pose itself, or
            else the nearest one; NaN where there is none.
        """
        aside = np.linspace(-width, width, samples)
        left = np.column_stack([-np.sin(poses[:, 2]), np.cos(poses[:, 2]), 0 * poses[:, 2]])
        moved = poses[:, None] + aside[:, None] * left[:, None]
        enough = (self.count(moved.reshape(-1, 3)) >= least).reshape(len(poses), samples)
        found = np.full((len(poses), 2), np.nan)
        for k in np.flatnonzero(enough.any(axis=1)):
            good = np.flatnonzero(enough[k])
            middle = int(good[np.argmin(np.abs(good - samples // 2))])
            low = high = middle
            while low > 0 and enough[k, low - 1]:
                low -= 1
            while high < samples - 1 and enough[k, high + 1]:
                high += 1
            found[k] = aside[low], aside[high]
        return found
