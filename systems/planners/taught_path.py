"""The path that a robot was led along, from a trajectory: evenly spaced, without rests, one lap."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from systems.angles import wrap
from systems.planners.polyline import length_of, points_along
from systems.validation import require

Array = NDArray[np.float64]

STEP = 0.05  # m, between the points
MIN_LENGTH = 1.5  # m
_REST = 0.02  # m; what moves less stands, but for noise
_JUMP = 0.5  # m between two samples
_CLOSING = 0.5  # m; a path that comes back so near its beginning is closed
_AWAY = 1.5  # m, to be gone before it can come back
_SAME_WAY = math.radians(60.0)
_WEIGHTS = np.array([1.0, 2.0, 3.0, 2.0, 1.0]) / 9.0


@dataclass(frozen=True, eq=False)
class TaughtPath:
    """A path.

    Attributes:
        points: (k, 2) m, about `STEP` apart; of a closed one the first does not come again.
        closed: whether it leads back to its beginning.
        cut: what was driven beyond the closed lap and is left out, m.
    """

    points: Array
    closed: bool
    cut: float = 0.0

    @property
    def polyline(self) -> Array:
        """The points, and the first one again if closed."""
        return np.vstack([self.points, self.points[:1]]) if self.closed else self.points

    @property
    def length(self) -> float:
        """Length, m."""
        return length_of(self.polyline)

    def nearest(self, positions: Array) -> tuple[Array, Array, Array]:
        """Returns the nearest place of the path to each position (n, 2).

        Returns:
            (n, 2) the place, (n, 2) the direction of the path there, (n,) the way gone there, m.
        """
        line = self.polyline
        a, along = line[:-1], np.diff(line, axis=0)
        steps = np.hypot(*along.T)
        run = np.concatenate([[0.0], np.cumsum(steps)])
        off = positions[:, None] - a
        share = np.clip((off * along).sum(axis=2) / np.maximum(steps, 1e-9) ** 2, 0.0, 1.0)
        squared = ((off - share[..., None] * along) ** 2).sum(axis=2)
        k = np.argmin(squared, axis=1)
        u = share[np.arange(len(k)), k]
        place = a[k] + u[:, None] * along[k]
        return place, along[k] / np.maximum(steps[k], 1e-9)[:, None], run[k] + u * steps[k]


def taught_path(t: Array, poses: Array, closed: bool | None = None) -> TaughtPath:
    """Returns the path of a trajectory, without what noise adds to it within a few points.

    Args:
        t: (n,) s, ascending.
        poses: (n, 3) [x (m), y (m), theta (rad)].
        closed: whether it is to be closed; None finds out.

    Raises:
        ValueError: too short, with a jump, driven backwards, or asked to be closed and not.
    """
    kept = [0]
    for k, pose in enumerate(poses):
        if np.hypot(*(pose[:2] - poses[kept[-1], :2])) >= _REST:
            kept.append(k)
    t, poses = t[kept], poses[kept]
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    length = float(steps.sum())
    if length < MIN_LENGTH:
        raise ValueError(
            f"the taught path is {length:.2f} m long: must be {MIN_LENGTH:g} m or more"
        )
    if steps.max() > _JUMP:
        k = int(np.argmax(steps))
        raise ValueError(
            f"the taught path jumps by {steps[k]:.2f} m from t = {t[k]:.2f} s to {t[k + 1]:.2f} s: "
            f"must be {_JUMP:g} m or less"
        )
    ahead = np.arctan2(*np.diff(poses[:, :2], axis=0).T[::-1])
    backwards = float(steps[np.cos(ahead - poses[:-1, 2]) < 0].sum())
    if backwards > 0.1 * length:
        raise ValueError(
            f"the taught path is driven backwards for {backwards:.2f} m of {length:.2f} m"
        )
    end = _lap(poses, steps) if closed is not False else None
    require(
        not (closed and end is None),
        "the taught path's end",
        f"{np.hypot(*(poses[-1, :2] - poses[0, :2])):.2f} m from its beginning",
        f"within {_CLOSING:g} m of it, in the same direction, to be closed",
    )
    cut = 0.0
    if end is not None:
        cut = float(steps[end:].sum())
        poses = poses[: end + 1]
    line = poses[:, :2]
    if end is not None:
        line = _closed(line)
    line = _smooth(_even(line, end is not None), end is not None)
    # Noise has made the way longer: once more in equal steps.
    line = np.vstack([line, line[:1]]) if end is not None else line
    return TaughtPath(_even(line, end is not None), end is not None, cut)


def _even(line: Array, closed: bool) -> Array:
    """Returns points (k, 2) at equal steps along a line; of a closed one without its end."""
    count = round(length_of(line) / STEP)
    share = np.arange(count if closed else count + 1) / count
    return points_along(line, length_of(line) * share)


def _smooth(points: Array, closed: bool) -> Array:
    """Returns points averaged with their neighbours; what is finer than that is noise."""
    reach = len(_WEIGHTS) // 2
    around = (
        np.vstack([points[-reach:], points, points[:reach]])
        if closed  # beyond an open end lies what it is the middle of
        else np.vstack([
            2 * points[0] - points[reach:0:-1], points, 2 * points[-1] - points[-2:-2 - reach:-1]
        ])
    )  # fmt: skip
    columns = [np.convolve(around[:, k], _WEIGHTS, "valid") for k in (0, 1)]
    return np.stack(columns, axis=1)


def _lap(poses: Array, steps: Array) -> int | None:
    """Returns the sample at which the path first comes back to its beginning, or None."""
    run = np.concatenate([[0.0], np.cumsum(steps)])
    off = np.hypot(*(poses[:, :2] - poses[0, :2]).T)
    turned = np.abs(wrap(poses[:, 2] - poses[0, 2]))
    back = (run > _AWAY) & (off < _CLOSING) & (turned < _SAME_WAY)
    if not back.any():
        return None
    first = int(np.argmax(back))
    gone = np.flatnonzero(~back[first:])
    last = first + (int(gone[0]) if len(gone) else len(back) - first)
    return first + int(np.argmin(off[first:last]))


def _closed(line: Array) -> Array:
    """Returns a line whose end is its beginning: the gap is spread over its last half metre.

    The drift of a map between the first and the last look at a place shows as a step across.
    """
    steps = np.hypot(*np.diff(line, axis=0).T)
    left = np.concatenate([np.cumsum(steps[::-1])[::-1], [0.0]])
    along = line[1] - line[0]
    along = along / np.hypot(*along)
    gap = line[0] - line[-1]
    across = gap - (gap @ along) * along
    share = np.clip(1 - left / 0.5, 0.0, 1.0)
    moved = line + (share**2 * (3 - 2 * share))[:, None] * across
    # What lies beyond the beginning is driven twice.
    while len(moved) > 2 and (moved[-1] - line[0]) @ along >= 0:
        moved = moved[:-1]
    return np.vstack([moved, line[:1]])
