"""What a replay leaves, and how good it was."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagrams.metrics import PoseLog
from systems.controllers.replay_supervisor import STATUSES
from systems.markers.layout import MarkerMap
from systems.planners.route import Route

Array = NDArray[np.float64]

_WINDOW = 1.0  # m along the route, within which the next place is looked for
_MOVED = 0.005  # m
_MOVES = STATUSES.index("slowing")  # from this status on the robot drives
# A robot that begins beside the route has joined it when it believes to be this near, or has come
# this far, m.
_JOINED, _JOIN_WITHIN = 0.01, 2.0


@dataclass(frozen=True, eq=False)
class ReplayLog:
    """A replay.

    Attributes:
        poses: truth and estimate over time.
        verdict: (n, 6) of the supervisor at the same times (see `ReplaySupervisor`).
        two_tag_fraction: share of the pictures that showed two tags or more.
        route: that was followed.
        tags: as they are.
        arrived: whether the robot came to the end.
    """

    poses: PoseLog
    verdict: Array
    two_tag_fraction: float
    route: Route
    tags: MarkerMap
    arrived: bool

    @property
    def status(self) -> NDArray[np.intp]:
        """(n,) index of the supervisor's status."""
        return np.asarray(np.where(np.isfinite(self.verdict[:, 0]), self.verdict[:, 1], 0), np.intp)

    def on_the_way(self) -> slice:
        """Returns the samples from the first in which the robot moves to the last it drives in."""
        path = self.poses.estimate if self.poses.truth is None else self.poses.truth
        drives = np.flatnonzero(self.status >= _MOVES)
        known = np.flatnonzero(self.poses.known)
        if len(drives) == 0 or len(known) == 0:
            return slice(0, 0)
        start = max(int(drives[0]), int(known[0]))
        away = np.hypot(*(path[start:, :2] - path[start, :2]).T) > _MOVED
        if not away.any():
            return slice(0, 0)
        return slice(max(start + int(np.argmax(away)) - 1, 0), int(drives[-1]) + 1)

    def cross_track(self, poses: Array) -> tuple[Array, Array]:
        """Returns how far poses (k, 3), one after the other, are off the route.

        Returns:
            (k,) way along the route to the place beside each, from the first, laps included, m; and
            (k,) distance from it, m, positive to the left.
        """
        run, offsets = np.empty(len(poses)), np.empty(len(poses))
        near: float | None = None
        for k, pose in enumerate(poses):
            place = self.route.closest(pose, near=near, window=_WINDOW)
            time = place.time
            if near is not None and self.route.closed:
                time += round((near - time) / self.route.duration) * self.route.duration
            near = time
            run[k] = self.route.run_at(time)
            offsets[k] = math.copysign(place.distance, place.offset)
        return run - (run[0] if len(run) else 0.0), offsets


def replay_metrics(log: ReplayLog) -> dict[str, Any]:
    """Returns the metrics of the way: by the truth, where there is one, else by the estimate.

    `cross_track_*` are over the way from where the robot has joined the route, evenly in time;
    `estimate_cross_track_rmse_m` is what the controller saw of it. `joined_after_m` is the way
    before: a robot may begin beside the route. `lap_time_s` is the time from the first motion to
    the end of the last lap, by the number of laps on the route.
    """
    way = log.on_the_way()
    t, truth = log.poses.t[way], log.poses.truth
    names = ("cross_track_rmse_m", "cross_track_max_m", "estimate_cross_track_rmse_m",
             "joined_after_m", "lap_time_s", "nearest_tag_m")  # fmt: skip
    metrics: dict[str, Any] = dict.fromkeys(names)
    metrics["route_length_m"] = log.route.length
    metrics["two_tag_fraction"] = log.two_tag_fraction
    if len(t):
        run, seen = log.cross_track(log.poses.estimate[way])
        joined = int(np.argmax((np.abs(seen) < _JOINED) | (run > _JOIN_WITHIN)))
        metrics["joined_after_m"] = float(run[joined])
        metrics["estimate_cross_track_rmse_m"] = float(np.sqrt((seen[joined:] ** 2).mean()))
        if truth is not None:
            run, off = log.cross_track(truth[way])
            off = off[joined:]
            metrics["cross_track_rmse_m"] = float(np.sqrt((off**2).mean()))
            metrics["cross_track_max_m"] = float(np.abs(off).max())
            metrics["nearest_tag_m"] = _nearest(truth[way], log.tags)
        laps = max(round(float(run[-1]) / log.route.length), 1) if log.route.closed else 1
        metrics["lap_time_s"] = float(t[-1] - t[0]) / laps if log.arrived else None
    for name in ("blind", "slowing", "blocked", "lost", "doubtful", "relocalised"):
        metrics[f"{name}_s"] = _time_in(log, name)
    return metrics


def _time_in(log: ReplayLog, status: str) -> float:
    """Returns how long the robot was in a status, s."""
    dt = np.diff(log.poses.t, prepend=log.poses.t[:1])
    return float(dt[log.status == STATUSES.index(status)].sum())


def _nearest(poses: Array, tags: MarkerMap) -> float | None:
    if len(tags) == 0:
        return None
    places = np.array([tag.X_WM.translation()[:2] for tag in tags])
    return float(np.hypot(*(poses[:, None, :2] - places).transpose(2, 0, 1)).min())
