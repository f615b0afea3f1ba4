"""Figures of a run. Truth and estimate differ in line style, so that colour is not needed."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, Polygon
from numpy.typing import NDArray

from diagrams.metrics import NEES_BOUNDS, PoseLog, nees
from diagrams.viewer import ellipse
from plants.arena import ArenaParameters
from systems.markers.layout import MarkerMap

Array = NDArray[np.float64]

_TRUTH: dict[str, Any] = {"color": "black", "linestyle": "-", "linewidth": 1.6}
_ESTIMATE: dict[str, Any] = {"color": "tab:red", "linestyle": "--", "linewidth": 1.6}
_BOUND: dict[str, Any] = {"color": "tab:blue", "linestyle": ":", "linewidth": 1.2}


def plot_navigation(
    path: Path,
    log: PoseLog,
    *,
    waypoints: Array,
    radius: float,
    markers: MarkerMap,
    arena: ArenaParameters,
) -> None:
    """Writes the figure of a navigation run: plan view, errors with their bounds, NEES.

    Args:
        path: of the PNG.
        log: truth and estimate.
        waypoints: (n, 2) m.
        radius: arrival radius, m.
        markers: of the world.
        arena: its obstacles.
    """
    figure = Figure(figsize=(12.0, 6.2), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = cast(NDArray[Any], figure.subfigures(1, 2, width_ratios=[1.0, 1.05]))
    _plan(left.subplots(), log, waypoints, radius, arena, markers)
    axes = right.subplots(4 if log.truth is not None else 3, 1, sharex=True)
    if not log.known.any():
        axes[0].set_title("no marker was ever seen: there is no estimate")
    elif log.truth is None:
        _poses(axes, log)
    else:
        _errors(axes, log)
    axes[-1].set_xlabel("time [s]")
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _plan(
    ax: Axes,
    log: PoseLog,
    waypoints: Array,
    radius: float,
    arena: ArenaParameters,
    markers: MarkerMap,
) -> None:
    draw_arena(ax, arena)
    for marker in markers:
        p = marker.X_WM.translation()[:2]
        across = marker.X_WM.rotation().matrix()[:2, 1] * marker.size / 2
        normal = marker.X_WM.rotation().matrix()[:2, 0]
        ax.plot(*np.transpose([p - across, p + across]), color="black", linewidth=3)
        ax.annotate(
            str(marker.id), p + 0.12 * normal, ha="center", va="center", fontsize=7, color="0.3"
        )
    for k, point in enumerate(waypoints):
        ax.add_patch(Circle(point, radius, facecolor="none", edgecolor="tab:green"))
        ax.annotate(f"{k + 1}", point, ha="center", va="center", color="tab:green", fontsize=9)
    if log.truth is not None:
        ax.plot(*log.truth[:, :2].T, label="truth", **_TRUTH)
    known = log.estimate[log.known]
    ax.plot(*known[:, :2].T, label="estimate", **_ESTIMATE)
    for k in _every(log.known, 25):
        a, b, angle = ellipse(log.covariance[k, :2, :2])
        ax.add_patch(
            Ellipse(
                (log.estimate[k, 0], log.estimate[k, 1]),
                2 * a,
                2 * b,
                angle=np.degrees(angle),
                facecolor="none",
                edgecolor="tab:red",
                linewidth=0.7,
            )
        )
    ax.plot([], [], color="tab:red", linewidth=0.7, label="95 % ellipse")
    ax.plot([], [], color="black", linewidth=3, label="marker (id)")
    ax.plot([], [], color="tab:green", linewidth=1, label="waypoint, arrival radius")
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, 1.12), ncol=3, fontsize=8, frameon=False)


def draw_arena(ax: Axes, arena: ArenaParameters) -> None:
    """Draws what stands filled, and what moves as outlines at both ends of its dashed path."""
    filled: dict[str, Any] = {"facecolor": "0.8", "edgecolor": "0.5"}
    for box in [*arena.walls, *arena.boxes]:
        ax.add_patch(Polygon(box.footprint().corners()[0], **filled))
    for cylinder in arena.cylinders:
        ax.add_patch(
            Circle((cylinder.position[0], cylinder.position[1]), cylinder.radius, **filled)
        )
    for moving in arena.moving:
        ax.plot(*np.transpose(moving.path), color="0.5", linestyle=(0, (2, 2)), linewidth=1.0)
        for x, y in (moving.path[0], moving.path[-1]):
            ax.add_patch(Circle((x, y), moving.radius, facecolor="none", edgecolor="0.5"))
    if arena.moving:
        ax.plot([], [], color="0.5", linestyle=(0, (2, 2)), linewidth=1, label="moving obstacle")


def _errors(axes: Array, log: PoseLog) -> None:
    t = log.t[log.known]
    errors = log.errors() * [100.0, 100.0, np.degrees(1.0)]
    covariance = log.covariance[log.known]
    deviations = np.sqrt(np.einsum("nii->ni", covariance)) * [100.0, 100.0, np.degrees(1.0)]
    for k, label in enumerate(("x [cm]", "y [cm]", "heading [deg]")):
        axes[k].plot(t, errors[:, k], color="tab:red", linewidth=1.0, label="estimate - truth")
        bound = 2 * deviations[:, k]
        axes[k].fill_between(t, -bound, bound, color="0.85", linewidth=0, label="2 sigma")
        axes[k].set_ylabel(f"error in {label}")
        axes[k].grid(alpha=0.3)
        limit = max(
            2.5 * float(np.quantile(deviations[:, k], 0.9)), 1.2 * np.abs(errors[:, k]).max()
        )
        axes[k].set_ylim(-limit, limit)
    axes[0].legend(loc="upper right", fontsize=8, ncol=2)
    normalised = np.clip(nees(log.errors(), covariance), 1e-2, 1e6)  # a log axis has no 0 and inf
    axes[3].semilogy(t, normalised, color="tab:red", linewidth=1.0)
    for bound in NEES_BOUNDS:
        axes[3].axhline(bound, **_BOUND)
    axes[3].set_ylabel("NEES (3 dof)\nand 95 % bounds")
    axes[3].grid(alpha=0.3)


def _poses(axes: Array, log: PoseLog) -> None:
    """What there is to see when nobody knows the truth."""
    t, pose = log.t[log.known], log.estimate[log.known]
    for k, label in enumerate(("x [m]", "y [m]", "heading [deg]")):
        values = np.degrees(np.unwrap(pose[:, k])) if k == 2 else pose[:, k]
        axes[k].plot(t, values, **_ESTIMATE)
        axes[k].set_ylabel(f"estimated {label}")
        axes[k].grid(alpha=0.3)


def _every(known: NDArray[np.bool_], count: int) -> NDArray[np.intp]:
    """Returns about `count` indices, evenly over those that are known."""
    index = np.flatnonzero(known)
    return index[:: max(1, len(index) // count)]
