"""A route: where the robot is to be, which way it is to look and how fast, at equal steps of time.

The file is JSON:

    {"frame": "map", "closed": true, "t": [0.0, 0.05], "x": [...], "y": [...], "theta": [...],
     "v": [...], "omega": [...], "limits": {"max_speed": 0.5}}

A closed route begins anew one step after its last sample; an open one ends with it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from systems.angles import wrap
from systems.validation import nearest, require

Array = NDArray[np.float64]

_COLUMNS = ("t", "x", "y", "theta", "v", "omega")
_EQUAL = 1e-3  # of a step, by which the steps of time may differ
_JUMP = 0.05  # m by which a sample may lie off where its speed leads, beyond a fifth of the step


class Place(NamedTuple):
    """A place of a route beside a position.

    Attributes:
        time: on the route, s; of a closed one in [0, duration).
        offset: of the position to the left of the route, m.
        distance: from the position to the place, m; more than the offset beside an open end.
    """

    time: float
    offset: float
    distance: float


@dataclass(frozen=True, eq=False)
class Route:
    """A route at equal steps of time.

    Attributes:
        t: (n,) s, from 0.
        x: (n,) m.
        y: (n,) m.
        theta: (n,) heading, rad; unwrapped: neighbours differ by less than pi.
        v: (n,) speed, m/s.
        omega: (n,) turn rate, rad/s.
        closed: whether it begins anew one step after the last sample.
        frame: that x, y and theta are told in.
        limits: name to number of what it was made to keep to; for whoever reads it.

    Raises:
        ValueError: columns of different lengths, numbers that are not finite, steps of time that
            differ, or a pose that its speed does not lead to.
    """

    t: Array
    x: Array
    y: Array
    theta: Array
    v: Array
    omega: Array
    closed: bool = False
    frame: str = "map"
    limits: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.t)
        require(n >= 4, "number of samples", n, "4 or more")
        for name in _COLUMNS:
            column = np.array(getattr(self, name), float)
            require(column.shape == (n,), f"length of {name}", len(column), f"{n}, as that of t")
            for k in np.flatnonzero(~np.isfinite(column)):
                raise ValueError(f"{name}[{k}] is {column[k]}: must be finite")
            object.__setattr__(self, name, column)
        steps = np.diff(self.t)
        require(self.t[0] == 0, "t[0]", float(self.t[0]), "0")
        require(self.step > 0, f"t[{n - 1}]", float(self.t[-1]), "greater than t[0]")
        for k in np.flatnonzero(np.abs(steps - self.step) > _EQUAL * self.step) + 1:
            raise ValueError(f"t[{k}] is {self.t[k]:g}: must be {self.step:.4g} s after t[{k - 1}]")
        object.__setattr__(self, "theta", np.unwrap(self.theta))
        self._check_motion()
        for name in _COLUMNS:
            getattr(self, name).setflags(write=False)

    def _check_motion(self) -> None:
        """Refuses a route whose samples lie elsewhere than its speeds lead."""
        p, v, _ = self._nodes
        along = np.diff(p[:, :2], axis=0)
        gone = self.step * (v[1:, :2] + v[:-1, :2]) / 2
        off = np.hypot(*(along - gone).T) - 0.2 * np.hypot(*gone.T)
        if (off > _JUMP).any():
            k = int(np.argmax(off > _JUMP))
            raise ValueError(
                f"from t = {self.step * k:.2f} s to {self.step * (k + 1):.2f} s the route goes "
                f"{np.hypot(*along[k]):.3g} m, where its speed and heading make "
                f"{np.hypot(*gone[k]):.3g} m in their direction"
            )

    def __len__(self) -> int:
        return len(self.t)

    @cached_property
    def step(self) -> float:
        """Time from one sample to the next, s."""
        return float((self.t[-1] - self.t[0]) / (len(self.t) - 1))

    @property
    def duration(self) -> float:
        """Time of one lap, or from the first sample to the last, s."""
        return self.step * (len(self.t) - (not self.closed))

    @property
    def length(self) -> float:
        """Length of the way, m."""
        return float(self._run[-1])

    @cached_property
    def _nodes(self) -> tuple[Array, Array, Array]:
        """Samples, the first one again at the end of a closed route: poses, their rates, v omega.

        A lap may turn the heading by whole turns: it goes on with the last sample's.
        """
        poses = np.column_stack([self.x, self.y, self.theta])
        speeds = np.column_stack([self.v, self.omega])
        if self.closed:
            again = poses[:1].copy()
            again[0, 2] = self.theta[-1] + wrap(float(self.theta[0] - self.theta[-1]))
            poses, speeds = np.vstack([poses, again]), np.vstack([speeds, speeds[:1]])
        v, theta = speeds[:, 0], poses[:, 2]
        return poses, np.column_stack([v * np.cos(theta), v * np.sin(theta), speeds[:, 1]]), speeds

    @cached_property
    def _run(self) -> Array:
        """Way gone at the nodes, m; by Simpson's rule on the curve between them."""
        p, v, _ = self._nodes
        middle = 1.5 * np.diff(p[:, :2], axis=0) / self.step - (v[1:, :2] + v[:-1, :2]) / 4
        speeds = (
            np.hypot(*v[:-1, :2].T) + 4 * np.hypot(*middle.T) + np.hypot(*v[1:, :2].T)
        ) * self.step / 6  # fmt: skip
        return np.concatenate([[0.0], np.cumsum(speeds)])

    def _locate(self, time: Any) -> tuple[NDArray[np.intp], Array]:
        t = np.asarray(time, float) / self.step
        last = len(self._run) - 1
        t = np.mod(t, last) if self.closed else np.clip(t, 0.0, last)
        k = np.minimum(t.astype(np.intp), last - 1)
        return k, t - k

    def poses_at(self, time: Any) -> Array:
        """Returns the poses (..., 3) [x, y, theta] at times (...) s; laps of a closed route go on.

        Between samples lies the cubic that has their poses and velocities. Before the beginning and
        after the end of an open route stands its first or last pose. theta is wrapped.
        """
        k, u = self._locate(time)
        u = u[..., None]
        p, v, _ = self._nodes
        pose = (
            p[k] * (1 + 2 * u) * (1 - u) ** 2 + p[k + 1] * u**2 * (3 - 2 * u)
            + self.step * (v[k] * u * (1 - u) ** 2 - v[k + 1] * u**2 * (1 - u))
        )  # fmt: skip
        pose[..., 2] = wrap(pose[..., 2])
        return pose

    def speeds_at(self, time: Any) -> Array:
        """Returns [v (m/s), omega (rad/s)] at times (...): (..., 2).

        Before the beginning and after the end of an open route they are 0.
        """
        k, u = self._locate(time)
        _, _, speeds = self._nodes
        found = speeds[k] + u[..., None] * (speeds[k + 1] - speeds[k])
        if not self.closed:
            t = np.asarray(time, float)
            found = np.where(((t < 0) | (t >= self.duration))[..., None], 0.0, found)
        return np.asarray(found)

    def curvature_at(self, time: Any) -> Array:
        """Returns the curvature omega / v (...) at times (...), 1/m; 0 where the route rests."""
        v, omega = np.moveaxis(self.speeds_at(time), -1, 0)
        return np.asarray(np.where(np.abs(v) > 1e-6, omega / np.where(v == 0, 1.0, v), 0.0))

    def run_at(self, time: Any) -> Array:
        """Returns the way gone (...) m at times (...) s; a closed route's goes on with the laps."""
        t = np.asarray(time, float)
        laps = np.floor(t / self.duration) if self.closed else 0.0
        k, u = self._locate(t)
        return np.asarray(laps * self.length + self._run[k] + u * (self._run[k + 1] - self._run[k]))

    def time_at(self, run: Any) -> Array:
        """Returns the times (...) s at which ways (...) m are gone: the inverse of `run_at`."""
        s = np.asarray(run, float)
        laps = np.floor(s / self.length) if self.closed else np.zeros_like(s)
        nodes = self.step * np.arange(len(self._run))
        return np.asarray(
            laps * self.duration + np.interp(s - laps * self.length, self._run, nodes)
        )

    def closest(
        self, position: Array, near: float | None = None, window: float = math.inf
    ) -> Place:
        """Returns the place that is closest to a position.

        Args:
            position: (2,) m, or a pose, of which the first two count.
            near: time about which to look, s; None looks everywhere.
            window: how far to look from there along the route, m.
        """
        p, _, _ = self._nodes
        last = len(self._run) - 1
        first, count = 0, last
        if near is not None and math.isfinite(window):
            run = float(self.run_at(near))
            low, high = self.time_at(np.array([run - window, run + window])) / self.step
            first, count = math.floor(low), max(math.ceil(high) - math.floor(low), 1)
            if not self.closed:
                first = min(max(first, 0), last - 1)
            count = min(count, last if self.closed else last - first)
        k = first + np.arange(count)
        if self.closed:
            k = k % last
        a, along = p[k, :2], p[k + 1, :2] - p[k, :2]
        squared = np.maximum((along * along).sum(axis=1), 1e-18)
        u = np.clip(((position[:2] - a) * along).sum(axis=1) / squared, 0.0, 1.0)
        off = a + u[:, None] * along - position[:2]
        best = int(np.argmin((off * off).sum(axis=1)))
        return self._polished(position, (k[best] + float(u[best])) * self.step)

    def _polished(self, position: Array, time: float) -> Place:
        """Takes a place of the chords to the curve: one step of Newton's method."""
        v, omega = self.speeds_at(time).tolist()
        x, y, theta = self.poses_at(time).tolist()
        c, s = math.cos(theta), math.sin(theta)
        dx, dy = float(position[0]) - x, float(position[1]) - y
        rate = v - omega * (c * dy - s * dx)  # by which what is ahead falls with time
        if rate > 0.2 * v > 0:
            time += min(max((c * dx + s * dy) / rate, -self.step), self.step)
        time = time % self.duration if self.closed else min(max(time, 0.0), self.duration)
        x, y, theta = self.poses_at(time).tolist()
        dx, dy = float(position[0]) - x, float(position[1]) - y
        offset = math.cos(theta) * dy - math.sin(theta) * dx
        return Place(time, offset, math.hypot(dx, dy))

    def to_json(self) -> dict[str, Any]:
        """Returns the file's content."""
        columns = {name: np.round(getattr(self, name), 9).tolist() for name in _COLUMNS}
        return {
            "frame": self.frame, "closed": self.closed, **columns, "limits": dict(self.limits),
        }  # fmt: skip

    def save(self, path: Path) -> None:
        """Writes the route as JSON, a line for each key."""
        lines = (f"{json.dumps(k)}: {json.dumps(value)}" for k, value in self.to_json().items())
        path.write_text("{" + ",\n ".join(lines) + "}\n")


def load_route(path: Path) -> Route:
    """Reads a route.

    Raises:
        ValueError: the file is missing or not JSON, or its content is refused; the message names
            the file.
    """
    try:
        content = json.loads(path.read_text())
    except OSError as error:
        raise ValueError(f"route {path}: {error.strerror}") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"route {path} is not JSON: {error}") from error
    try:
        return route_from_json(content)
    except ValueError as error:
        raise ValueError(f"route {path}: {error}") from error


def route_from_json(content: Any) -> Route:
    """Returns the route that a file's content describes.

    Raises:
        ValueError: a key that is unknown or missing, a value of the wrong type, or samples that are
            no route (see `Route`).
    """
    needed, optional = {*_COLUMNS, "closed"}, {"frame", "limits"}
    require(isinstance(content, dict), "the route", content, f"an object with {sorted(needed)}")
    for key in content:
        if key not in needed | optional:
            raise ValueError(f"unknown key {key!r}: {nearest(key, needed | optional)}")
    for key in sorted(needed - set(content)):
        raise ValueError(f"lacks the key {key!r}")
    require(isinstance(content["closed"], bool), "closed", content["closed"], "true or false")
    frame, limits = content.get("frame", "map"), content.get("limits", {})
    require(isinstance(frame, str), "frame", frame, "a name")
    require(isinstance(limits, dict), "limits", limits, "an object of numbers")
    for name, value in limits.items():
        require(_is_number(value), f"limits.{name}", value, "a number")
    columns = {}
    for name in _COLUMNS:
        column = content[name]
        require(isinstance(column, list), name, column, "a list of numbers")
        bad = [k for k, value in enumerate(column) if not _is_number(value)]
        if bad:
            raise ValueError(f"{name}[{bad[0]}] is {column[bad[0]]!r}: must be a number")
        columns[name] = np.array(column, float)
    return Route(**columns, closed=content["closed"], frame=frame, limits=limits)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
