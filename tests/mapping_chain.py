"""What one does without optimisation: tags chained from the anchor, ambiguous poses left out.

Each frame's camera comes from the corners of all known tags in it, started from the largest
unambiguous one, and every unambiguous tag that it sees is placed by it; a tag's pose is the mean
over all frames so far.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from systems.mapping.scene import Scene
from systems.mapping.sightings import Sightings
from systems.markers.layout import marker_corners
from systems.markers.planar_pose import planar_poses
from systems.markers.pnp import refine

Array = NDArray[np.float64]

# The second pose's reprojection error by the first one's, at least. Of 1.2, 1.5, 2 and 3 this is
# the best for the chain.
GATE = 1.2


def chained(sightings: Sightings, *, anchor: int, R_WA: Array, p_WA: Array) -> Array:
    """Returns `p_WT` of the tags, (tags, 3) m; NaN for those that are never reached."""
    s = sightings
    poses = planar_poses(s.rays, s.by_ray, s.sizes[s.tag])
    rms = poses.reprojection_rms()
    clear = (rms[:, 1] > GATE * rms[:, 0]) & np.isfinite(poses.R[:, 0]).all(axis=(1, 2))
    side = np.linalg.norm(s.rays - s.rays[:, [1, 2, 3, 0]], axis=2).min(axis=1)
    total_R, total_p = np.zeros((s.tags, 3, 3)), np.zeros((s.tags, 3))
    count = np.zeros(s.tags)
    total_R[anchor], total_p[anchor], count[anchor] = R_WA, p_WA, 1
    first = int(s.frame[clear & (s.tag == anchor)].min())
    for frame in (first + np.arange(s.frames)) % s.frames:  # the drive starts in view of the anchor
        seen = np.flatnonzero((s.frame == frame) & clear)
        known = seen[count[s.tag[seen]] > 0]
        if len(known) == 0:
            continue
        U, _, Vt = np.linalg.svd(total_R[s.tag[known]])
        R_WT, p_WT = U @ Vt, total_p[s.tag[known]] / count[s.tag[known], None]
        k = int(np.argmax(side[known]))
        R_CW = poses.R[known[k], 0] @ R_WT[k].T
        p_CW = poses.p[known[k], 0] - R_CW @ p_WT[k]
        corners = marker_corners(1.0) * s.sizes[s.tag[known], None, None]
        corners = corners @ R_WT.swapaxes(1, 2) + p_WT[:, None]
        found = refine(
            R_CW[None],
            p_CW[None],
            corners.reshape(-1, 3),
            s.rays[known].reshape(-1, 2),
            s.by_ray[known].reshape(-1, 2, 2),
        )
        R_WC = found.R[0].T
        p_WC = -R_WC @ found.p[0]
        for j in seen:
            tag = s.tag[j]
            if tag != anchor:
                total_R[tag] += R_WC @ poses.R[j, 0]
                total_p[tag] += p_WC + R_WC @ poses.p[j, 0]
                count[tag] += 1
    with np.errstate(invalid="ignore"):
        return total_p / count[:, None]


def tag_errors(p_WT: Array, truth: Scene, anchor: int) -> Array:
    """Returns (tags - 1,) how far tags are from where they are in truth, m."""
    return np.delete(np.linalg.norm(p_WT - truth.p_WT, axis=1), anchor)
