"""Where tags and cameras are, roughly: a start for the adjustment that flipped tags do not spoil.

A square seen from the front has two poses that explain its corners nearly alike, so a chain of
single poses goes astray with the first flip. Here two tags that were seen together give the pose of
one in the other four times in each picture; over many pictures the right one comes again and the
wrong ones scatter. Each pair of tags votes, the surest pairs make a tree from the anchor to all
tags, and then cameras and tags vote on each other in turn.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from systems.mapping.scene import Scene
from systems.mapping.sightings import Sightings
from systems.markers.layout import marker_corners
from systems.markers.planar_pose import closed_form
from systems.markers.pnp import refine, squared_errors
from systems.validation import require

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_VOTERS = 16  # sightings that vote, the largest ones
_SAME_TURN = 15.0  # degrees; poses that differ by less, and
_SAME_PLACE = 0.15  # of the distance by less than this part, mean the same
_ROUNDS = 3
_STEPS = 2  # from the homography's poses to the corners'
_WORSE = 2.0  # px^2; a tag's pose that leaves so much more than its other one counts half
_AT_ONCE = 64  # groups whose votes are counted at a time: bounds the memory


@dataclass(frozen=True, eq=False)
class Start:
    """A scene to start from.

    Attributes:
        scene: identity poses where nothing is known.
        tags: (tags,) which are connected to the anchor.
        frames: (frames,) in which one of those was seen.
        sightings: those that have poses, and are of connected tags.
    """

    scene: Scene
    tags: NDArray[np.bool_]
    frames: NDArray[np.bool_]
    sightings: Sightings


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses, in arrays of one leading shape.

    Attributes:
        R: (..., 3, 3).
        p: (..., 3) m.
    """

    R: Array
    p: Array

    def __getitem__(self, index: Any) -> Poses:
        return Poses(self.R[index], self.p[index])

    def __matmul__(self, other: Poses) -> Poses:
        return Poses(self.R @ other.R, (self.R @ other.p[..., None])[..., 0] + self.p)

    def inverse(self) -> Poses:
        """Returns them the other way."""
        R = self.R.swapaxes(-1, -2)
        return Poses(R, -(R @ self.p[..., None])[..., 0])


def find_start(sightings: Sightings, *, known: Mapping[int, RigidTransform]) -> Start:
    """Finds cameras and tags roughly.

    Args:
        sightings: of tags in frames.
        known: number to pose of the tags whose pose is known (the anchor, or several).

    Raises:
        ValueError: no known tag was seen as a square is seen from its front.
    """
    good, R, p = closed_form(sightings.rays, sightings.sizes[sightings.tag])
    require(
        bool(np.isin(sightings.tag[good], list(known)).any()),
        "corners",
        "those of no square seen from its front",
        "in the order top-left, top-right, bottom-right, bottom-left",
    )
    seen = sightings.select(good)
    poses, trust = _refined(R, p, seen)
    side = _sides(seen)
    tags = _identities(seen.tags)
    anchors = np.array(list(known), np.intp)
    for k, X_WT in known.items():
        tags.R[k], tags.p[k] = X_WT.rotation().matrix(), X_WT.translation()
    fixed = tags[anchors]
    connected = _chain(seen, poses, trust, side, tags, anchors)
    mine = connected[seen.tag]
    seen, poses, trust, side = seen.select(mine), poses[mine], trust[mine], side[mine]
    cameras = _identities(seen.frames)
    for _ in range(_ROUNDS):
        X_CW = poses @ tags.inverse()[seen.tag][:, None]
        _vote_into(cameras, X_CW, trust, seen.frame, side, _depths(poses))
        candidates = cameras.inverse()[seen.frame][:, None] @ poses
        _vote_into(tags, candidates, trust, seen.tag, side, _depths(poses))
        tags.R[anchors], tags.p[anchors] = fixed.R, fixed.p
    frames = np.bincount(seen.frame, minlength=seen.frames) > 0
    return Start(Scene(cameras.R, cameras.p, tags.R, tags.p), connected, frames, seen)


def relocate(scene: Scene, sightings: Sightings, frames: Indices, limit: float) -> Scene:
    """Puts cameras where most of their sightings agree, by each tag's own poses; tags stay.

    Args:
        scene: adjusted.
        sightings: in it.
        frames: whose cameras to look at.
        limit: a sighting agrees whose 8 residuals are no longer together, px.
    """
    R_CW, p_CW = scene.R_CW.copy(), scene.p_CW.copy()
    bounds = np.searchsorted(sightings.frame, [frames, frames + 1]).T
    for frame, (first, end) in zip(frames, bounds, strict=True):
        s = sightings.select(np.isin(np.arange(len(sightings)), np.arange(first, end)))
        good, R, p = closed_form(s.rays, s.sizes[s.tag])
        found, _ = _refined(R, p, s.select(good))
        tags = Poses(scene.R_WT[s.tag], scene.p_WT[s.tag])
        X_CW = found @ tags[good].inverse()[:, None]
        choices = Poses(X_CW.R.reshape(-1, 3, 3), X_CW.p.reshape(-1, 3))
        corners = marker_corners(1.0) * s.sizes[s.tag][:, None, None]
        corners = corners @ tags.R.swapaxes(1, 2) + tags.p[:, None]
        error = squared_errors(choices.R[:, None], choices.p[:, None], corners, s.rays, s.by_ray)
        # A tag's own pose, carried over to others, errs more than a common one will.
        agree = (error < (4 * limit) ** 2).sum(axis=1)
        for k in np.argsort(-agree, kind="stable")[:2]:
            near = error[k] < (4 * limit) ** 2
            if not near.any():  # a tag alone, misread: no pose has it square
                break
            refined = refine(
                choices.R[[k]],
                choices.p[[k]],
                corners[near].reshape(-1, 3),
                s.rays[near].reshape(-1, 2),
                s.by_ray[near].reshape(-1, 2, 2),
            )
            after = squared_errors(refined.R, refined.p, corners, s.rays, s.by_ray)
            before = squared_errors(R_CW[[frame]], p_CW[[frame]], corners, s.rays, s.by_ray)
            if (after < limit**2).sum() > (before < limit**2).sum():
                R_CW[frame], p_CW[frame] = refined.R[0], refined.p[0]
    return Scene(R_CW, p_CW, scene.R_WT, scene.p_WT)


def _refined(R: Array, p: Array, seen: Sightings) -> tuple[Poses, Array]:
    """Returns both poses of each sighting after two steps, and how far each is to be trusted."""
    points = marker_corners(1.0) * seen.sizes[seen.tag][:, None, None]
    found = refine(
        R.reshape(-1, 3, 3), p.reshape(-1, 3), points, seen.rays, seen.by_ray, iterations=_STEPS
    )
    error = found.squared_error.reshape(-1, 2)
    worse = error - error.min(axis=1, keepdims=True)
    poses = Poses(found.R.reshape(-1, 2, 3, 3), found.p.reshape(-1, 2, 3))
    return poses, 1 / (1 + np.where(np.isfinite(worse), worse, np.inf) / _WORSE)


def _identities(n: int) -> Poses:
    return Poses(np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)))


def _sides(seen: Sightings) -> Array:
    """Returns (m,) the least side of each sighting, in rays."""
    edges = seen.rays - seen.rays[:, [1, 2, 3, 0]]
    return np.asarray(np.hypot(edges[..., 0], edges[..., 1]).min(axis=1))


def _depths(poses: Poses) -> Array:
    return np.asarray(np.linalg.norm(poses.p[:, 0], axis=1))


def _chain(
    seen: Sightings, poses: Poses, trust: Array, side: Array, tags: Poses, anchors: Indices
) -> NDArray[np.bool_]:
    """Places the tags that pairs connect to the anchors; returns which those are."""
    connected = np.zeros(seen.tags, bool)
    connected[anchors] = True
    first, second = _pairs(seen.frame)
    a, b = seen.tag[first], seen.tag[second]
    swap = a > b
    first, second = np.where(swap, second, first), np.where(swap, first, second)
    key = np.minimum(a, b) * seen.tags + np.maximum(a, b)
    keys, group = np.unique(key, return_inverse=True)
    relative = poses[first][:, :, None].inverse() @ poses[second][:, None, :]
    relative = Poses(relative.R.reshape(-1, 4, 3, 3), relative.p.reshape(-1, 4, 3))
    both = (trust[first][:, :, None] * trust[second][:, None, :]).reshape(-1, 4)
    reach = (_depths(poses)[first] + _depths(poses)[second]) / 2
    found, support = _vote(
        relative, both, group, len(keys), np.minimum(side[first], side[second]), reach
    )
    low, high = keys // seen.tags, keys % seen.tags
    while True:  # Prim's tree: the surest pair that leads to a new tag
        useful = connected[low] != connected[high]
        if not useful.any():
            return connected
        k = int(np.argmax(np.where(useful, support, -1)))
        if connected[low[k]]:
            old, new, X = low[k], high[k], found[[k]]
        else:
            old, new, X = high[k], low[k], found[[k]].inverse()
        placed = tags[[old]] @ X
        tags.R[new], tags.p[new] = placed.R[0], placed.p[0]
        connected[new] = True


def _pairs(frame: Indices) -> tuple[Indices, Indices]:
    """Returns the pairs (i, j) of sightings in the same frame."""
    starts = np.flatnonzero(np.diff(frame, prepend=-1))
    counts = np.diff(np.append(starts, len(frame)))
    firsts, seconds = [np.zeros(0, np.intp)], [np.zeros(0, np.intp)]
    for start, count in zip(starts, counts, strict=True):
        i, j = np.triu_indices(count, 1)
        firsts.append(start + i)
        seconds.append(start + j)
    return np.concatenate(firsts), np.concatenate(seconds)


def _vote_into(
    target: Poses, X: Poses, trust: Array, index: Indices, side: Array, reach: Array
) -> None:
    """Writes what the candidates X (m, c) of each index agree on."""
    keys, group = np.unique(index, return_inverse=True)
    found, _ = _vote(X, trust, group, len(keys), side, reach)
    target.R[keys], target.p[keys] = found.R, found.p


def _vote(
    X: Poses, trust: Array, group: Indices, groups: int, side: Array, reach: Array
) -> tuple[Poses, Array]:
    """Returns for each group the pose that most of its members have a candidate near.

    Args:
        X: (m, c) candidates: m members of c each.
        trust: (m, c) of each candidate, at most 1.
        group: (m,) which group each member is of.
        groups: how many there are.
        side: (m,) how large the member appears: the largest ones vote.
        reach: (m,) distance that an error of angle acts over, m.

    Returns:
        The poses (groups), means of those that agree; and how many members do, with a part for
        how well.
    """
    order = np.lexsort((-side, group))
    starts = np.searchsorted(group[order], np.arange(groups))
    rank = np.arange(len(order)) - starts[group[order]]
    kept = order[rank < _VOTERS]
    slots = np.full((groups, _VOTERS), -1)
    slots[group[kept], rank[rank < _VOTERS]] = kept
    R, p, support = np.empty((groups, 3, 3)), np.empty((groups, 3)), np.empty(groups)
    for start in range(0, groups, _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        mean, support[part] = _vote_padded(X, trust, slots[part], reach)
        R[part], p[part] = mean.R, mean.p
    return Poses(R, p), support


def _vote_padded(X: Poses, trust: Array, slots: Indices, reach: Array) -> tuple[Poses, Array]:
    g, v = slots.shape
    c = X.p.shape[1]
    there = (slots >= 0).repeat(c, axis=1)  # (g, v c)
    R = X.R[slots].reshape(g, v * c, 9)
    p = X.p[slots].reshape(g, v * c, 3)
    far = _SAME_PLACE * reach[slots].repeat(c, axis=1)
    cosine = (R @ R.swapaxes(1, 2) - 1) / 2
    squares = (p * p).sum(axis=2)
    apart = squares[:, :, None] + squares[:, None, :] - 2 * p @ p.swapaxes(1, 2)
    limit = np.minimum(far[:, :, None], far[:, None, :])
    turn = (1 - cosine) / (1 - np.cos(np.radians(_SAME_TURN)))
    closeness = 1 - (turn + np.maximum(apart, 0) / (limit * limit)) / 2
    near = (turn < 1) & (apart < limit * limit) & there[:, :, None] & there[:, None, :]
    weights = trust[slots].reshape(g, v * c)
    closeness = np.where(near, closeness, 0.0) * weights[:, None, :]
    # A member counts once, with its nearest candidate.
    count = closeness.reshape(g, v * c, v, c).max(axis=3).sum(axis=2)
    best = np.argmax(count * weights, axis=1)
    rows = np.arange(g)
    weight = closeness[rows, best]
    weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
    mean = _nearest_rotations((weight[:, None] @ R)[:, 0].reshape(g, 3, 3))
    return Poses(mean, (weight[:, None] @ p)[:, 0]), count[rows, best]


def _nearest_rotations(M: Array) -> Array:
    """Returns the rotations nearest to matrices (n, 3, 3)."""
    U, _, Vt = np.linalg.svd(M)
    U[..., 2] *= np.linalg.det(U @ Vt)[:, None]
    return np.asarray(U @ Vt)
