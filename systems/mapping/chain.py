"""The unoptimised map: poses chained from tag to tag, each taken for what it says.

The naive chain goes from frame to frame. A camera is placed by a tag whose pose is known, and every
new tag in the frame by the camera: `X_WC = X_WT X_CT^-1`, `X_WT' = X_WC X_CT'`. The anchor is the
first tag that is known, and is preferred wherever it is seen; else the tag that appears largest is
taken. Frames are gone through from the first one that shows the anchor to the end, then from there
back to the beginning. Nothing comes back to a tag that has its place, so errors add up along the
way, and a pose that is the wrong one of a square's two swings all that is chained to it.

The gated chain is as careful as a chain can be. It uses no ambiguous pose. The tag comes next that
appears largest together with those that have their places, in whatever frame, and is placed by the
mean of its best sightings; cameras are placed by the corners of all such tags together, which do
not flip.

Source: Martins do Lago Reis, da Silva Ramos, "AprilTag-based Trajectory Tracking for the LIMOS
Robot", sections 3.2 and 4.1-4.2, is the naive chain, with the better one of the two poses. The gate
is PhotonVision's: "ambiguity" is the reprojection error of the better pose by that of the other
one. Its manual advises against poses above 0.2; with corners of 0.3 px that leaves a tag in forty
without a place, and 0.3 none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from systems.mapping.scene import Scene
from systems.mapping.sightings import Sightings
from systems.markers.layout import marker_corners
from systems.markers.planar_pose import PlanarPoses, planar_poses
from systems.markers.pnp import refine
from systems.validation import require

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

GATE = 0.3  # ambiguity above which the gated chain trusts no pose


@dataclass(frozen=True, eq=False)
class Chain:
    """A scene as it was chained.

    Attributes:
        scene: identity poses where nothing is known.
        tags: (tags,) which have a pose.
        frames: (frames,) whose cameras have one.
    """

    scene: Scene
    tags: NDArray[np.bool_]
    frames: NDArray[np.bool_]


class _Links:
    """Sightings with their poses, and what has been chained so far."""

    def __init__(self, sightings: Sightings, anchor: int, X_W_anchor: RigidTransform) -> None:
        s = sightings
        require(0 <= anchor < s.tags, "anchor", anchor, f"the number of a tag, 0 to {s.tags - 1}")
        self.sightings, self.anchor = s, anchor
        self.poses: PlanarPoses = planar_poses(s.rays, s.by_ray, s.sizes[s.tag])
        self.usable = np.isfinite(self.poses.squared_error[:, 0])
        edges = s.rays - s.rays[:, [1, 2, 3, 0]]
        self.side = np.hypot(edges[..., 0], edges[..., 1]).min(axis=1)
        self.bounds = np.searchsorted(s.frame, np.arange(s.frames + 1))
        self.tags, self.frames = np.zeros(s.tags, bool), np.zeros(s.frames, bool)
        self.R_WT, self.p_WT = np.tile(np.eye(3), (s.tags, 1, 1)), np.zeros((s.tags, 3))
        self.R_CW, self.p_CW = np.tile(np.eye(3), (s.frames, 1, 1)), np.zeros((s.frames, 3))
        self.tags[anchor] = True
        self.R_WT[anchor] = X_W_anchor.rotation().matrix()
        self.p_WT[anchor] = X_W_anchor.translation()

    def seen(self, frame: int) -> Indices:
        """Returns the usable sightings of a frame."""
        seen = np.arange(self.bounds[frame], self.bounds[frame + 1])
        return seen[self.usable[seen]]

    def through(self, sighting: int, which: int = 0) -> tuple[Array, Array]:
        """Returns `R_CW` and `p_CW` (m) of a sighting's camera, by one of its tag's two poses."""
        tag = self.sightings.tag[sighting]
        R = self.poses.R[sighting, which] @ self.R_WT[tag].T
        return R, self.poses.p[sighting, which] - R @ self.p_WT[tag]

    def place_camera(self, frame: int, R_CW: Array, p_CW: Array) -> None:
        """Gives a frame's camera its pose."""
        self.R_CW[frame], self.p_CW[frame], self.frames[frame] = R_CW, p_CW, True

    def place_tag(self, sightings: Indices, weights: Array) -> None:
        """Places a tag by the cameras of some of its sightings: the mean of what they say."""
        s = self.sightings
        frames, tag = s.frame[sightings], s.tag[sightings[0]]
        R_WC = self.R_CW[frames].swapaxes(1, 2)
        from_camera = self.poses.p[sightings, 0] - self.p_CW[frames]
        R_WT = np.tensordot(weights / weights.sum(), R_WC @ self.poses.R[sightings, 0], 1)
        self.R_WT[tag] = nearest_rotation(R_WT)
        self.p_WT[tag] = weights @ (R_WC @ from_camera[..., None])[..., 0] / weights.sum()
        self.tags[tag] = True

    def chain(self) -> Chain:
        """Returns what has been chained."""
        scene = Scene(self.R_CW, self.p_CW, self.R_WT, self.p_WT)
        return Chain(scene, self.tags, self.frames)


def naive_chain(sightings: Sightings, *, anchor: int, X_W_anchor: RigidTransform) -> Chain:
    """Chains poses frame by frame, the better one of each tag's two.

    Args:
        sightings: of tags in frames.
        anchor: number of the tag whose pose is known.
        X_W_anchor: its pose.

    Raises:
        ValueError: the anchor is none of the tags.
    """
    links = _Links(sightings, anchor, X_W_anchor)
    s = sightings
    with_anchor = s.frame[links.usable & (s.tag == anchor)]
    first = int(with_anchor[0]) if len(with_anchor) else s.frames
    for frame in (*range(first, s.frames), *range(first - 1, -1, -1)):
        seen = links.seen(frame)
        known = links.tags[s.tag[seen]]
        if not known.any():
            continue
        candidates = seen[known]
        preferred = np.where(s.tag[candidates] == anchor, np.inf, links.side[candidates])
        links.place_camera(frame, *links.through(candidates[np.argmax(preferred)]))
        for sighting in seen[~known]:
            links.place_tag(np.array([sighting]), np.ones(1))
    return links.chain()


def gated_chain(
    sightings: Sightings,
    *,
    anchor: int,
    X_W_anchor: RigidTransform,
    max_ambiguity: float = GATE,
    pictures: int = 8,
) -> Chain:
    """Chains the surest poses first, and no ambiguous ones.

    Args:
        sightings: of tags in frames.
        anchor: number of the tag whose pose is known.
        X_W_anchor: its pose.
        max_ambiguity: no tag is placed by a pose that is more ambiguous than this; see `ambiguity`.
        pictures: a tag is placed by the mean of so many of its sightings, the best ones.

    Raises:
        ValueError: the anchor is none of the tags, the gate is negative, or there is no picture.
    """
    require(max_ambiguity >= 0, "max_ambiguity", max_ambiguity, "0 or greater")
    require(pictures >= 1, "pictures", pictures, "1 or more")
    links = _Links(sightings, anchor, X_W_anchor)
    s = sightings
    sure = links.usable & (ambiguity(links.poses.squared_error) <= max_ambiguity)
    area = np.where(links.usable, links.side**2, 0.0)  # to which a pose's information is in ratio
    while True:
        known = links.tags[s.tag]
        of_frame = np.bincount(s.frame, np.where(known, area, 0.0), minlength=s.frames)[s.frame]
        ready = sure & ~known & (of_frame > 0)
        if not ready.any():
            break
        variance = np.full(len(s), np.inf)
        variance[ready] = 1 / area[ready] + 1 / of_frame[ready]
        same = np.flatnonzero(s.tag == s.tag[np.argmin(variance)])
        best = same[np.argsort(variance[same], kind="stable")[:pictures]]
        best = best[np.isfinite(variance[best])]
        for sighting in best:
            _place_by_all(links, int(s.frame[sighting]))
        links.place_tag(best, variance[best] ** -2.0)
    for frame in range(s.frames):
        _place_by_all(links, frame)
    return links.chain()


def _place_by_all(links: _Links, frame: int) -> None:
    """Places a frame's camera by the corners of all tags in it that have their places, if any."""
    s = links.sightings
    seen = links.seen(frame)
    known = seen[links.tags[s.tag[seen]]]
    if len(known) == 0:
        return
    largest = int(known[np.argmax(links.side[known])])
    starts = [links.through(largest, which) for which in range(2)]
    tags = s.tag[known]
    corners = marker_corners(1.0) * s.sizes[tags][:, None, None]
    corners = corners @ links.R_WT[tags].swapaxes(1, 2) + links.p_WT[tags][:, None]
    given = (corners.reshape(-1, 3), s.rays[known].reshape(-1, 2))
    found = refine(
        np.stack([R for R, _ in starts]),
        np.stack([p for _, p in starts]),
        *(np.stack([v, v]) for v in (*given, s.by_ray[known].reshape(-1, 2, 2))),
    )
    best = int(np.argmin(found.squared_error))
    if np.isfinite(found.squared_error[best]):
        links.place_camera(frame, found.R[best], found.p[best])


def nearest_rotation(M: Array) -> Array:
    """Returns the rotation nearest to a matrix (3, 3) that is a mean of rotations."""
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def ambiguity(squared_error: Array) -> Array:
    """Returns (n,) how nearly a square's other pose explains the corners as well: 0 sure, 1 not.

    Args:
        squared_error: (n, 2) of both poses, the better one first (`PlanarPoses`), px^2.
    """
    better, other = squared_error.T
    with np.errstate(invalid="ignore"):  # neither pose: not a number, which is replaced
        ratio = np.sqrt(better / np.maximum(other, 1e-300))
    return np.where(np.isinf(better), np.inf, ratio)
