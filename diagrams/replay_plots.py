"""The figure of a replay. Truth, estimate and route differ in line style, not only in colour."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from diagrams.replay_log import ReplayLog
from systems.controllers.replay_supervisor import STATUSES
from systems.markers.layout import MarkerMap

Array = NDArray[np.float64]

_TRUTH: dict[str, Any] = {"color": "black", "linestyle": "-", "linewidth": 1.4}
_ESTIMATE: dict[str, Any] = {"color": "tab:red", "linestyle": "--", "linewidth": 1.4}
_ROUTE: dict[str, Any] = {"color": "tab:blue", "linestyle": ":", "linewidth": 1.8}


def plot_replay(path: Path, log: ReplayLog, *, known: MarkerMap) -> None:
    """Writes the figure: plan view, distance from the route, speed, and what was let do when.

    Args:
        path: of the PNG.
        log: the replay.
        known: the tags as the robot knows them.
    """
    figure = Figure(figsize=(13.0, 6.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = cast(NDArray[Any], figure.subfigures(1, 2, width_ratios=[1.0, 1.1]))
    draw_plan(left.subplots(), log, known)
    draw_way(right.subplots(3, 1), log)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def draw_plan(ax: Axes, log: ReplayLog, known: MarkerMap) -> None:
    """Draws route, paths and tags from above."""
    draw_tags(ax, log.tags, known)
    run = np.linspace(0.0, log.route.length, 600)
    x, y, _ = log.route.poses_at(log.route.time_at(run)).T
    ax.plot(x, y, label="route", zorder=3, **_ROUTE)
    if log.poses.truth is not None:
        ax.plot(*log.poses.truth[:, :2].T, label="truth", **_TRUTH)
    ax.plot(*log.poses.estimate[log.poses.known][:, :2].T, label="estimate", **_ESTIMATE)
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    ax.legend(loc="center", fontsize=8, frameon=False)


def draw_tags(ax: Axes, true: MarkerMap, known: MarkerMap) -> None:
    """Draws tags as they are (bars, with their ids) and where the map has them (crosses)."""
    for tag in true:
        p = tag.X_WM.translation()[:2]
        R = tag.X_WM.rotation().matrix()
        across, normal = R[:2, 1] * tag.size / 2, R[:2, 0]
        ax.plot(*np.transpose([p - across, p + across]), color="black", linewidth=3)
        ax.annotate(
            str(tag.id), p - 0.13 * normal, ha="center", va="center", fontsize=7, color="0.3"
        )
    places = np.array([tag.X_WM.translation()[:2] for tag in known]).reshape(-1, 2)
    ax.plot(*places.T, "x", color="tab:red", markersize=5, label="tag in the map")
    ax.plot([], [], color="black", linewidth=3, label="tag (id)")


def draw_way(axes: Array, log: ReplayLog) -> None:
    """Draws the distance from the route over the way, and speed and status over time."""
    way = log.on_the_way()
    if way.stop > way.start:
        if log.poses.truth is not None:
            run, off = log.cross_track(log.poses.truth[way])
            axes[0].plot(run, 100 * off, label="truth", **_TRUTH)
        run, off = log.cross_track(log.poses.estimate[way])
        axes[0].plot(run, 100 * off, label="estimate", **_ESTIMATE)
        axes[0].legend(loc="upper right", fontsize=8, ncol=2)
    axes[0].axhline(0.0, color="0.6", linewidth=0.8)
    axes[0].set_xlabel("way along the route [m]")
    axes[0].set_ylabel("left of the route [cm]")
    t = log.poses.t
    path = log.poses.estimate if log.poses.truth is None else log.poses.truth
    if len(t) > 1:
        n = min(10, len(t) - 1)  # samples, over which the speed is a mean
        way = np.hypot(*(path[n:, :2] - path[:-n, :2]).T)
        style = _ESTIMATE if log.poses.truth is None else _TRUTH
        axes[1].plot((t[n:] + t[:-n]) / 2, way / np.maximum(t[n:] - t[:-n], 1e-9), **style)
    axes[1].set_ylabel("speed [m/s]")
    seen = [k for k in range(len(STATUSES)) if (log.status == k).any()]
    place = {k: row for row, k in enumerate(seen)}
    axes[2].step(t, [place[k] for k in log.status.tolist()], where="post", color="black")
    axes[2].set_yticks(range(len(seen)), [STATUSES[k].replace("_", " ") for k in seen])
    axes[2].set_ylim(-0.5, len(seen) - 0.5)
    for ax in axes[1:]:
        ax.set_xlabel("time [s]")
    for ax in axes:
        ax.grid(alpha=0.3)
