"""Sightings out of detections as anyone recorded them; what cannot be used is counted."""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.cameras import PinholeCamera
from systems.mapping.sightings import Sightings
from systems.messages import Detections
from systems.validation import require_positive

Array = NDArray[np.float64]

REASONS = ("bad_stamp", "repeated_id", "bad_corners", "too_small", "rare_tag")


@dataclass(frozen=True, eq=False)
class Gathered:
    """The sightings of a recording.

    Attributes:
        sightings: of tags in frames; frames without any are left out.
        ids: (tags,) the tags' ids, ascending.
        stamps: (frames,) s, ascending.
        dropped: sightings (of `bad_stamp`: frames) that were left out, by reason (see `REASONS`).
    """

    sightings: Sightings
    ids: NDArray[np.int64]
    stamps: Array
    dropped: dict[str, int]

    def sightings_of(self) -> NDArray[np.int64]:
        """Returns (tags,) how often each was seen."""
        return np.bincount(self.sightings.tag, minlength=len(self.ids))


def gather(
    detections: Iterable[Detections],
    *,
    camera: PinholeCamera,
    size: float,
    sizes: dict[int, float] | None = None,
    min_side: float = 12.0,
    min_frames: int = 3,
) -> Gathered:
    """Makes sightings of detections.

    Args:
        detections: in the order in which they were recorded. Frames whose stamps do not ascend with
            those of most others have a `bad_stamp`; of a tag that a frame shows twice none can be
            told to be the real one (`repeated_id`).
        camera: that took the pictures.
        size: side of the black square of tags, m.
        sizes: of those by id that have another one.
        min_side: tags whose shortest side is shorter are `too_small`, px.
        min_frames: a tag seen in fewer frames is a `rare_tag`: a false detection, or nothing worth
            a place in a map.

    Raises:
        ValueError: a size, or a size's id, out of range.
    """
    require_positive(size=size, min_frames=min_frames)
    dropped = dict.fromkeys(REASONS, 0)
    stamps: list[float] = []
    frame: list[NDArray[np.int64]] = []
    ids: list[NDArray[np.int64]] = []
    corners: list[Array] = []
    require_positive(**{f"size of tag {i}": s for i, s in (sizes or {}).items()})
    frames_found = list(detections)
    ascending = _ascending([found.stamp for found in frames_found])
    dropped["bad_stamp"] = len(frames_found) - len(ascending)
    for found in (frames_found[k] for k in ascending):
        once = _once(found.ids)
        finite = np.asarray(np.isfinite(found.corners).all(axis=(1, 2)))
        large = _shortest_side(found.corners) >= min_side
        dropped["repeated_id"] += int((~once).sum())
        dropped["bad_corners"] += int((once & ~finite).sum())
        dropped["too_small"] += int((once & finite & ~large).sum())
        good = once & finite & large
        if good.any():
            frame.append(np.full(good.sum(), len(stamps)))
            ids.append(found.ids[good])
            corners.append(found.corners[good])
            stamps.append(found.stamp)
    if not frame:
        frame, ids, corners = [np.zeros(0, int)], [np.zeros(0, np.int64)], [np.zeros((0, 4, 2))]
    all_ids, all_frames = np.concatenate(ids), np.concatenate(frame)
    rays, by_ray = camera.rays(np.concatenate(corners))
    has_rays = np.isfinite(rays).all(axis=(1, 2))
    dropped["bad_corners"] += int((~has_rays).sum())
    _, tag, count = np.unique(all_ids, return_inverse=True, return_counts=True)
    often = count[tag] >= min_frames
    dropped["rare_tag"] += int((has_rays & ~often).sum())
    good = has_rays & often
    frames, frame_number = np.unique(all_frames[good], return_inverse=True)
    known, tag_number = np.unique(all_ids[good], return_inverse=True)
    own = sizes or {}
    sightings = Sightings(
        frame_number,
        tag_number,
        rays[good],
        by_ray[good],
        np.array([own.get(int(i), size) for i in known], float),
        len(frames),
    )
    return Gathered(sightings, known, np.array(stamps)[frames], dropped)


def _ascending(stamps: Sequence[float]) -> list[int]:
    """Returns the numbers of a longest ascending part of the stamps, the earliest of several.

    So that one stamp far ahead costs a frame, not all that come after it.
    """
    # From the end: the largest stamp that a run of each length may begin with.
    lengths = np.zeros(len(stamps), int)
    begins: list[float] = []  # negative stamps, ascending
    for k in range(len(stamps) - 1, -1, -1):
        if not math.isfinite(stamps[k]):
            continue
        place = bisect.bisect_left(begins, -stamps[k])
        begins[place : place + 1] = [-stamps[k]]
        lengths[k] = place + 1
    chosen: list[int] = []
    left, last = len(begins), -math.inf
    for k, stamp in enumerate(stamps):
        if lengths[k] == left > 0 and stamp > last:
            chosen.append(k)
            left, last = left - 1, stamp
    return chosen


def _once(ids: NDArray[np.int64]) -> NDArray[np.bool_]:
    _, which, count = np.unique(ids, return_inverse=True, return_counts=True)
    return np.asarray(count[which] == 1)


def _shortest_side(corners: Array) -> Array:
    edges = corners - corners[:, [1, 2, 3, 0]]
    return np.asarray(np.hypot(edges[..., 0], edges[..., 1]).min(axis=1, initial=np.inf))
