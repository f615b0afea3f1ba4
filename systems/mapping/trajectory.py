"""The camera's, or its robot's, way through a map, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from systems.mapping.mapping import TagMap
from systems.mapping.scene import corner_errors
from systems.markers.planar_pose import angle_between, planar_poses
from systems.markers.pnp import cross_matrix

Array = NDArray[np.float64]

# px: frames of single tags leave so little over that noise found in them looks too small.
_LEAST_NOISE = 0.3
_SAME = 0.1  # rad; poses nearer to each other than this are one


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of a frame B in the map's frame W.

    Attributes:
        stamps: (n,) s, ascending.
        R_WB: (n, 3, 3).
        p_WB: (n, 3) m.
        covariance: (n, 6, 6), rotation first, a small rotation vector and the position in W.
    """

    stamps: Array
    R_WB: Array
    p_WB: Array
    covariance: Array

    def __len__(self) -> int:
        return len(self.stamps)


def trajectory(
    tag_map: TagMap, *, X_BC: RigidTransform | None = None, margin: float = 20.0
) -> tuple[Trajectory, int]:
    """Returns the poses of every frame that has one, and how many frames were left out.

    A single tag has two poses; a frame that shows no other is left out unless the second is worse
    by the margin.

    Args:
        tag_map: the map, with its cameras.
        X_BC: mounting of the camera's optical frame C in B; None takes C for B.
        margin: in chi-square.
    """
    kept = ~ambiguous_frames(tag_map, margin)
    kept &= np.bincount(tag_map.sightings.frame, minlength=len(kept)) > 0
    scene, P = tag_map.adjustment.scene, tag_map.adjustment.camera_covariance
    R_WC = scene.R_CW.swapaxes(1, 2)
    X_CB = (X_BC or RigidTransform()).inverse()
    arm = R_WC @ X_CB.translation()
    # From steps of X_CW, told in C, to those of X_WB, told in W.
    J = np.zeros((len(kept), 6, 6))
    J[:, :3, :3] = J[:, 3:, 3:] = -R_WC
    J[:, 3:, :3] = -R_WC @ cross_matrix(scene.p_CW) + cross_matrix(arm) @ R_WC
    found = Trajectory(
        tag_map.stamps[kept],
        (R_WC @ X_CB.rotation().matrix())[kept],
        (scene.positions() + arm)[kept],
        (J @ P @ J.swapaxes(1, 2))[kept],
    )
    return found, int((~kept).sum())


def ambiguous_frames(tag_map: TagMap, margin: float) -> NDArray[np.bool_]:
    """Returns (frames,) which show a single tag whose other pose is not worse by the margin."""
    s = tag_map.sightings
    alone = np.bincount(s.frame, minlength=s.frames)[s.frame] == 1
    found = np.zeros(s.frames, bool)
    single = s.select(alone)
    if len(single) == 0:
        return found
    scene = tag_map.adjustment.scene
    poses = planar_poses(single.rays, single.by_ray, single.sizes[single.tag])
    R_CT = scene.R_CW[single.frame] @ scene.R_WT[single.tag]
    own = (corner_errors(scene, single) ** 2).sum(axis=1)
    apart = np.stack([angle_between(poses.R[:, k], R_CT) for k in range(2)], axis=1)
    other = np.where(apart > _SAME, poses.squared_error, np.inf).min(axis=1)
    noise = max(tag_map.pixel_noise, _LEAST_NOISE)
    found[single.frame] = other - own < margin * noise**2
    return found
