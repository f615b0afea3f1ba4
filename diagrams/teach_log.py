"""What a teaching run leaves: frames, truth, the chained maps, and how good those are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from diagrams.metrics import path_length
from systems.angles import spatial_pose
from systems.cameras import PinholeCamera
from systems.mapping.chain import Chain, gated_chain, naive_chain
from systems.mapping.gathering import Gathered, gather
from systems.mapping.tag_frames import TagFrame
from systems.markers.layout import MarkerMap

Array = NDArray[np.float64]

CHAINS = {"naive": naive_chain, "gated": gated_chain}
_MOVING = 0.5  # of the mean speed on the way; what is slower is starting and stopping


@dataclass(frozen=True, eq=False)
class Chained:
    """A chain with the names of its tags and the times of its frames.

    Attributes:
        chain: what was chained.
        ids: (tags,) of its tags.
        stamps: (frames,) of its frames, s.
    """

    chain: Chain
    ids: NDArray[np.int64]
    stamps: Array

    def tags(self) -> dict[int, RigidTransform]:
        """Returns `X_WT` by id of the tags that have their place."""
        scene = self.chain.scene
        return {
            int(tag): RigidTransform(RotationMatrix(scene.R_WT[k]), scene.p_WT[k])
            for k, tag in enumerate(self.ids)
            if self.chain.tags[k]
        }

    def cameras(self) -> list[tuple[float, RigidTransform]]:
        """Returns time (s) and `X_WC` of the frames that have theirs."""
        scene = self.chain.scene
        return [
            (
                float(self.stamps[k]),
                RigidTransform(RotationMatrix(scene.R_CW[k]), scene.p_CW[k]).inverse(),
            )
            for k in np.flatnonzero(self.chain.frames)
        ]


@dataclass(frozen=True, eq=False)
class TeachLog:
    """A teaching run.

    Attributes:
        frames: what the camera saw, picture by picture.
        t: (n,) s, of the logs below.
        truth: (n, 3) planar pose of base_link; None when nobody knows it.
        odometry: (n, 3) the same by the wheels, in `odom`.
        markers: the tags as they are.
        anchor: id of the tag whose pose is known.
        X_BC: pose of the optical frame in base_link.
    """

    frames: list[TagFrame]
    t: Array
    truth: Array | None
    odometry: Array
    markers: MarkerMap
    anchor: int
    X_BC: RigidTransform

    def gathered(self, camera: PinholeCamera) -> Gathered:
        """Returns the sightings of the tags that the world has."""
        sizes = {marker.id: marker.size for marker in self.markers}
        detections = (
            frame.detections.select(
                np.array([int(i) in self.markers for i in frame.detections.ids], bool)
            )
            for frame in self.frames
        )
        return gather(detections, camera=camera, size=self.markers.size, sizes=sizes)

    def chained(self, camera: PinholeCamera) -> dict[str, Chained]:
        """Returns the chains by name, those that there are: the anchor must have been seen."""
        found = self.gathered(camera)
        number = np.flatnonzero(found.ids == self.anchor)
        if len(number) == 0:
            return {}
        X_W_anchor = self.markers.markers[self.anchor].X_WM
        return {
            name: Chained(
                chain(found.sightings, anchor=int(number[0]), X_W_anchor=X_W_anchor),
                found.ids,
                found.stamps,
            )
            for name, chain in CHAINS.items()
        }

    def true_base(self, stamps: Array) -> Array:
        """Returns (n, 3) the true poses of base_link at times within the log (s)."""
        assert self.truth is not None
        turned = np.unwrap(self.truth[:, 2])
        columns = (self.truth[:, 0], self.truth[:, 1], turned)
        return np.stack([np.interp(stamps, self.t, column) for column in columns], axis=1)

    def true_cameras(self, stamps: Array) -> list[RigidTransform]:
        """Returns `X_WC` as it was at times within the log (s)."""
        return [spatial_pose(pose) @ self.X_BC for pose in self.true_base(stamps)]


def chain_errors(chained: Chained, log: TeachLog) -> tuple[dict[int, float], Array]:
    """Returns how far tags and cameras of a chain are from where they are, m.

    Returns:
        By id, of the tags that have their place, without the anchor; and (n,) of the cameras that
        have theirs, in their order.
    """
    tags = {
        tag: float(np.linalg.norm(X_WT.translation() - log.markers.markers[tag].X_WM.translation()))
        for tag, X_WT in chained.tags().items()
        if tag != log.anchor
    }
    cameras = chained.cameras()
    true = log.true_cameras(np.array([t for t, _ in cameras]))
    errors = [
        np.linalg.norm(X.translation() - X_true.translation())
        for (_, X), X_true in zip(cameras, true, strict=True)
    ]
    return tags, np.array(errors, float)


def counted(log: TeachLog) -> dict[str, Any]:
    """Returns counters and statistics of what was seen."""
    frames = log.frames
    low = sum(frame.low_observability for frame in frames)
    seen = {int(i) for frame in frames for i in frame.ids}
    in_view = [log.anchor in frame.ids for frame in frames]
    return {
        "frames": len(frames),
        "low_observability_frames": low,
        "two_tag_fraction": (len(frames) - low) / len(frames) if frames else None,
        "tags_in_view_mean": float(np.mean([len(f) for f in frames])) if frames else None,
        "tags_seen": len(seen),
        "tags_total": len(log.markers),
        "anchor_frames": int(sum(in_view)),
        "anchor_seen_at_start": bool(in_view and in_view[0]),
        "anchor_seen_at_end": bool(in_view and in_view[-1]),
    }


def driven(log: TeachLog) -> dict[str, Any]:
    """Returns the statistics of the way, by the truth where there is one, else by the wheels."""
    path = log.odometry if log.truth is None else log.truth
    length = path_length(path[:, :2])
    steps = np.hypot(*np.diff(path[:, :2], axis=0).T) / np.maximum(np.diff(log.t), 1e-9)
    fast = steps[steps > _MOVING * np.median(steps[steps > 1e-3])] if (steps > 1e-3).any() else []
    nearest = None
    if log.truth is not None:
        places = np.array([marker.X_WM.translation()[:2] for marker in log.markers])
        away = path[:, None, :2] - places
        nearest = float(np.hypot(away[..., 0], away[..., 1]).min())
    return {
        "path_length_m": length,
        "mean_speed": float(np.mean(fast)) if len(fast) else None,
        "speed_deviation": float(np.std(fast)) if len(fast) else None,
        "nearest_tag_m": nearest,
    }


def chain_metrics(log: TeachLog, chains: dict[str, Chained]) -> dict[str, Any]:
    """Returns how far the chained maps and trajectories are from the truth, m."""
    metrics: dict[str, Any] = {}
    for name in CHAINS:
        keys = ("tags_placed", "tag_error_mean_m", "tag_error_max_m", "trajectory_error_mean_m")
        values: list[Any] = [None] * len(keys)
        if name in chains:
            values[0] = int(chains[name].chain.tags.sum())
            if log.truth is not None:
                tags, cameras = chain_errors(chains[name], log)
                if tags:
                    values[1:3] = [float(np.mean(list(tags.values()))), max(tags.values())]
                values[3] = float(cameras.mean()) if len(cameras) else None
        metrics |= {f"{name}_{key}": value for key, value in zip(keys, values, strict=True)}
    return metrics
