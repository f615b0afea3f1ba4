"""A map of tags from a recording: start, adjustment, outliers out, and whether to trust it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from systems.mapping.adjustment import Adjustment, adjust, robust_cost, settle_tags
from systems.mapping.gathering import Gathered
from systems.mapping.scene import Motion, Scene, corner_errors
from systems.mapping.sightings import Sightings
from systems.mapping.start import Start, find_start, relocate
from systems.markers.planar_pose import angle_between, mirrored
from systems.validation import require, require_positive

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_NOISE_AT_FIRST = 0.5  # px, until the recording shows its own
_MEDIAN = 7.344  # of a chi-square with 8 degrees of freedom
_MAX_CHI2 = 3.0
_FLIP_ROUNDS = 3
_SAME = 0.1  # rad; poses of a tag that are nearer to each other are one
_OUTLIER = 10.0  # times the noise; the root of a sighting's 8 squared residuals together


@dataclass
class MappingParameters:
    """What is trusted.

    Attributes:
        pixel_noise: standard deviation of a corner's coordinate, px; 0 takes what the recording
            itself shows.
        max_rms: corners of a map that can be trusted leave no more, RMS, px.
        min_used: nor less than this part of the corners.
        flip_margin: a tag whose other pose is less worse than this, in chi-square, may be flipped.
    """

    pixel_noise: float = 0.0
    max_rms: float = 1.5
    min_used: float = 0.9
    flip_margin: float = 20.0

    def __post_init__(self) -> None:
        require_positive(max_rms=self.max_rms, flip_margin=self.flip_margin)
        require(0 < self.min_used <= 1, "min_used", self.min_used, "above 0, at most 1")


@dataclass(frozen=True, eq=False)
class TagMap:
    """Tags and camera as a recording has them.

    Attributes:
        ids: (tags,) of the tags, connected to the anchor, ascending.
        stamps: (frames,) of the frames, s.
        adjustment: their poses, with covariances for the noise of `pixel_noise`.
        sightings: that were used.
        all_sightings: of those tags, used or not.
        held: numbers of the tags whose poses were given.
        pixel_noise: of a corner's coordinate, px; as given, or as found.
        used: part of the corners of those tags that were used.
        unconnected: ids of tags that no picture, through others, connects to the anchor.
        suspects: reason to what cannot be trusted, one line each; empty for a sound map.
    """

    ids: NDArray[np.int64]
    stamps: Array
    adjustment: Adjustment
    sightings: Sightings
    all_sightings: Sightings
    held: Indices
    pixel_noise: float
    used: float
    unconnected: list[int]
    suspects: dict[str, str] = field(default_factory=dict)

    def rms(self) -> float:
        """Returns the root mean square distance of corners from where the map has them, px."""
        squared = self.adjustment.squared
        return float(np.sqrt(squared.sum() / max(4 * len(squared), 1))) * self.pixel_noise

    def chi2_per_dof(self) -> float:
        """Returns the squared residuals by degrees of freedom; 1 if the noise is as stated."""
        return _chi2(self.adjustment) / max(
            _degrees(self.sightings, self.adjustment, len(self.held)), 1
        )


def build_map(
    gathered: Gathered,
    *,
    anchor: int | None = None,
    X_W_anchor: RigidTransform | None = None,
    known: Mapping[int, RigidTransform] | None = None,
    motion: Motion | None = None,
    parameters: MappingParameters | None = None,
) -> TagMap:
    """Finds where tags and camera were.

    Args:
        gathered: the sightings.
        anchor: id of the tag whose pose is given; None takes the one seen most often.
        X_W_anchor: its pose in the map; the identity if left out.
        known: instead of an anchor, id to pose in the map of all tags that are known; those of them
            that were seen stay where they are.
        motion: odometry of the camera between frames.
        parameters: what is trusted.

    Returns:
        The map; what makes it untrustworthy is in `suspects`.

    Raises:
        ValueError: nothing was seen, or the anchor never, or none of the known tags.
    """
    p = parameters or MappingParameters()
    counts = gathered.sightings_of()
    require(len(counts) > 0, "recording", "without a tag seen often enough", "of tags")
    if known is None:
        if anchor is None:
            anchor = int(gathered.ids[np.argmax(counts)])
        seen = ", ".join(map(str, gathered.ids))
        require(anchor in gathered.ids, "anchor", anchor, f"one of the tags that were seen: {seen}")
        known = {anchor: X_W_anchor or RigidTransform()}
    else:
        require(anchor is None, "anchor", anchor, "left out where known tags are given")
        seen, given = ", ".join(map(str, gathered.ids)), ", ".join(map(str, sorted(known)))
        some = bool(np.isin(gathered.ids, list(known)).any())
        require(some, "known tags", given, f"in part among the tags that were seen: {seen}")
    numbers = {int(i): k for k, i in enumerate(gathered.ids)}
    placed = {numbers[i]: X_WT for i, X_WT in known.items() if i in numbers}
    start = find_start(gathered.sightings, known=placed)
    unconnected = gathered.ids[~start.tags].tolist()
    ids, stamps = gathered.ids[start.tags], gathered.stamps[start.frames]
    scene, sightings = _compact(start)
    if motion is not None:
        motion = motion.over(np.flatnonzero(start.frames))
    held = np.flatnonzero(np.isin(ids, list(known)))
    noise = p.pixel_noise or _NOISE_AT_FIRST

    def adjusted(scene: Scene, sightings: Sightings, tolerance: float = 1e-3) -> Adjustment:
        last = tolerance < 1e-3
        return adjust(
            scene,
            sightings,
            anchor=held,
            pixel_noise=noise,
            motion=motion,
            tolerance=tolerance,
            covariances=last,
        )

    result = adjusted(scene, sightings)
    for _ in range(_FLIP_ROUNDS):
        other, gain = other_poses(result.scene, sightings, held, noise)
        flipped = gain > 0
        if not flipped.any():
            break
        result = adjusted(_with_tags(result.scene, other, flipped), sightings)
    if not p.pixel_noise:
        noise *= _noise_factor(result, sightings, len(held))
    everything = sightings
    for tolerance in (1e-3, 1e-7):  # what a bad start has spoiled may fit after all
        limit = _OUTLIER * noise
        doubtful = np.unique(everything.frame[~_within(result.scene, everything, limit)])
        scene = relocate(result.scene, everything, doubtful, limit)
        sightings = everything.select(_within(scene, everything, limit))
        result = adjusted(scene, sightings, tolerance)
    _, gain = other_poses(result.scene, sightings, held, noise)
    used = len(sightings) / len(everything)
    tag_map = TagMap(ids, stamps, result, sightings, everything, held, noise, used, unconnected)
    return replace(tag_map, suspects=_suspects(tag_map, gain, p))


def _within(scene: Scene, sightings: Sightings, limit: float) -> NDArray[np.bool_]:
    r = corner_errors(scene, sightings)
    return np.asarray((r * r).sum(axis=1) < limit**2)


def _compact(start: Start) -> tuple[Scene, Sightings]:
    """Returns the scene without the tags and frames that nothing is known of."""
    scene, s = start.scene, start.sightings
    tag_number, frame_number = np.cumsum(start.tags) - 1, np.cumsum(start.frames) - 1
    frames, tags = start.frames, start.tags
    return (
        Scene(scene.R_CW[frames], scene.p_CW[frames], scene.R_WT[tags], scene.p_WT[tags]),
        Sightings(
            frame_number[s.frame],
            tag_number[s.tag],
            s.rays,
            s.by_ray,
            s.sizes[tags],
            int(frames.sum()),
        ),
    )


def _with_tags(scene: Scene, other: Scene, which: NDArray[np.bool_]) -> Scene:
    R, p = scene.R_WT.copy(), scene.p_WT.copy()
    R[which], p[which] = other.R_WT[which], other.p_WT[which]
    return replace(scene, R_WT=R, p_WT=p)


def _noise_factor(result: Adjustment, sightings: Sightings, held: int) -> float:
    """Returns the true noise by the assumed one, by the median sighting: outliers do not count."""
    m = len(sightings)
    share = max(_degrees(sightings, result, held) / (8 * m), 0.1)
    return float(np.sqrt(np.median(result.squared) / (_MEDIAN * share)))


def _degrees(sightings: Sightings, result: Adjustment, held: int) -> int:
    tags = len(np.unique(sightings.tag))
    frames = len(np.unique(sightings.frame))
    return 8 * len(sightings) + 6 * len(result.squared_motion) - 6 * (tags - held) - 6 * frames


def _chi2(result: Adjustment) -> float:
    return float(result.squared.sum() + result.squared_motion.sum())


def other_poses(
    scene: Scene, sightings: Sightings, anchor: int | Indices, pixel_noise: float
) -> tuple[Scene, Array]:
    """Looks for each tag's other pose: mirrored about the mean line of sight, then settled.

    Args:
        scene: adjusted.
        sightings: in it.
        anchor: number of the tag that is given, or numbers of several.
        pixel_noise: of a corner's coordinate, px.

    Returns:
        The scene with every tag in its other pose, and by how much that lowers the robust
        chi-square of the tag's own sightings, with all else as it is: (tags,). It is -inf for the
        anchor, and where the other pose has settled in the first one.
    """
    s = sightings
    own = robust_cost(scene, s, pixel_noise)
    sight = scene.positions()[s.frame] - scene.p_WT[s.tag]
    # Where a tag appears large its pose is told best.
    sight /= (sight * sight).sum(axis=1, keepdims=True) ** 1.5
    total = np.zeros((s.tags, 3))
    np.add.at(total, s.tag, sight)
    mean = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    R = mirrored(scene.R_WT, mean)
    other = settle_tags(replace(scene, R_WT=R), s, pixel_noise)
    gain = own - robust_cost(other, s, pixel_noise)
    gain[anchor] = -np.inf
    gain[angle_between(other.R_WT, scene.R_WT) < _SAME] = -np.inf
    return other, gain


def _suspects(tag_map: TagMap, gain: Array, p: MappingParameters) -> dict[str, str]:
    found: dict[str, str] = {}
    if tag_map.unconnected:
        names = ", ".join(map(str, tag_map.unconnected))
        found["disconnected"] = f"no picture connects the tags {names} to the others"
    doubtful = tag_map.ids[gain > -p.flip_margin]
    if len(doubtful):
        names = ", ".join(map(str, doubtful))
        found["flip"] = f"the tags {names} may be flipped: seen from too few sides"
    rms = tag_map.rms()
    if not rms <= p.max_rms:
        found["residuals"] = (
            f"corners lie {rms:.2f} px (RMS) from where the map has them, at most {p.max_rms:g}: "
            "a wrong camera file, or tags that moved or are not of that size"
        )
    if tag_map.used < p.min_used:
        found["outliers"] = (
            f"{tag_map.used:.0%} of the corners fit the map, at least {p.min_used:.0%}: a wrong "
            "camera file, or tags that moved"
        )
    if p.pixel_noise and tag_map.chi2_per_dof() > _MAX_CHI2:
        found["chi2"] = (
            f"chi-square per degree of freedom is {tag_map.chi2_per_dof():.1f} for noise of "
            f"{p.pixel_noise:g} px, at most {_MAX_CHI2:g}"
        )
    return found
