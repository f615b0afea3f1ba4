"""The figure of a teaching run. Truth and chains differ in lines and marks, not only in colour."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from diagrams.teach_log import Chained, TeachLog, chain_errors
from systems.planners.closed_curve import ClosedCurve

Array = NDArray[np.float64]

_STYLES: dict[str, dict[str, Any]] = {
    "naive": {"color": "tab:red", "linestyle": "--", "marker": "x"},
    "gated": {"color": "tab:blue", "linestyle": ":", "marker": "s"},
}
_ARROW = 0.18  # m; how long a tag's normal is drawn


def plot_teaching(
    path: Path, log: TeachLog, chains: dict[str, Chained], *, route: Sequence[Sequence[float]]
) -> None:
    """Writes the figure: plan view; errors of tags and trajectory; tags in view.

    Args:
        path: of the PNG.
        log: of the run.
        chains: the unoptimised maps.
        route: [[x, y], ...] of the circuit, m.
    """
    figure = Figure(figsize=(13.0, 6.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = cast(NDArray[Any], figure.subfigures(1, 2, width_ratios=[1.15, 1.0]))
    plan = left.subplots()
    _plan(plan, log, chains, ClosedCurve(route))
    left.legend(*plan.get_legend_handles_labels(), loc="outside upper center", ncol=4, fontsize=8)
    tags, errors, seen = right.subplots(3, 1)
    _tag_errors(tags, log, chains)
    _trajectory_errors(errors, log, chains)
    _seen(seen, log)
    errors.sharex(seen)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _plan(ax: Axes, log: TeachLog, chains: dict[str, Chained], curve: ClosedCurve) -> None:
    ring = np.vstack([curve.positions, curve.positions[:1]])
    ax.plot(*ring.T, color="0.8", linewidth=6, solid_capstyle="round", label="circuit", zorder=0)
    if log.truth is not None:
        ax.plot(*log.truth[:, :2].T, color="black", linewidth=1.4, label="robot, true")
    for name, chained in chains.items():
        style = _STYLES[name]
        places = np.array([X.translation()[:2] for _, X in chained.cameras()]).reshape(-1, 2)
        times = np.array([t for t, _ in chained.cameras()])
        if len(places):
            gaps = np.flatnonzero(np.diff(times) > 3 * np.median(np.diff(times))) + 1
            pieces = np.insert(places, gaps, np.nan, axis=0)  # no line where nothing was known
            line = {key: style[key] for key in ("color", "linestyle")}
            ax.plot(*pieces.T, linewidth=1.1, label=f"camera, {name} chain", **line)
    for marker in log.markers:
        place, R = marker.X_WM.translation()[:2], marker.X_WM.rotation().matrix()
        ends = place + marker.size / 2 * np.outer([-1, 1], R[:2, 1])
        ax.plot(*ends.T, color="black", linewidth=3)
        ax.plot(*np.array([place, place + _ARROW * R[:2, 0]]).T, color="black", linewidth=0.8)
        ax.annotate(
            str(marker.id),
            place - 0.19 * R[:2, 0],
            ha="center",
            va="center",
            fontsize=8,
            fontweight="bold" if marker.id == log.anchor else "normal",
        )
        for name, chained in chains.items():
            X = chained.tags().get(marker.id)
            if X is None:
                continue
            style, there = _STYLES[name], X.translation()[:2]
            ax.plot(*np.array([place, there]).T, color=style["color"], linewidth=0.5)
            ax.plot(
                *there,
                color=style["color"],
                marker=style["marker"],
                markersize=5,
                fillstyle="none",
                linestyle="none",
            )
    anchor = log.markers.markers[log.anchor].X_WM.translation()[:2]
    ax.plot(
        *anchor, color="black", marker="o", markersize=14, fillstyle="none", linestyle="none",
        label=f"anchor, tag {log.anchor}",
    )  # fmt: skip
    ax.plot([], [], color="black", linewidth=3, label="tag, true (id)")
    for name in chains:
        style = {**_STYLES[name], "linestyle": "none"}
        ax.plot([], [], fillstyle="none", label=f"tag, {name} chain", **style)
    # What has been carried far away is cut off: the circuit is what matters.
    low, high = ring.min(axis=0) - 1.6, ring.max(axis=0) + 1.6
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")


def _tag_errors(ax: Axes, log: TeachLog, chains: dict[str, Chained]) -> None:
    ax.set_xlabel("tag")
    ax.set_ylabel("error of position [m]")
    if log.truth is None or not chains:
        ax.set_title("the anchor was never seen" if not chains else "nobody knows the truth")
        return
    for k, (name, chained) in enumerate(chains.items()):
        tags, _ = chain_errors(chained, log)
        style = {**_STYLES[name], "linestyle": "none"}
        where = np.array(list(tags)) + 0.2 * (k - 0.5)
        ax.plot(where, list(tags.values()), fillstyle="none", label=f"{name} chain", **style)
    ax.set_yscale("log")
    ax.grid(alpha=0.3, which="both")
    ax.legend(loc="lower right", fontsize=8)


def _trajectory_errors(ax: Axes, log: TeachLog, chains: dict[str, Chained]) -> None:
    ax.set_ylabel("error of camera [m]")
    if log.truth is None:
        return
    for name, chained in chains.items():
        _, errors = chain_errors(chained, log)
        times = [t for t, _ in chained.cameras()]
        style = _STYLES[name]
        ax.plot(
            times, errors, color=style["color"], marker=style["marker"], markersize=3,
            fillstyle="none", linestyle="none", label=f"{name} chain",
        )  # fmt: skip
    if chains:
        ax.set_yscale("log")
    ax.grid(alpha=0.3, which="both")


def _seen(ax: Axes, log: TeachLog) -> None:
    times = np.array([frame.stamp for frame in log.frames])
    counts = np.array([len(frame) for frame in log.frames])
    anchor = np.array([log.anchor in frame.ids for frame in log.frames], bool)
    low = np.array([frame.low_observability for frame in log.frames], bool)
    ax.step(times, counts, where="mid", color="0.4", linewidth=1.0, label="tags in view")
    ax.plot(times[anchor], 0 * times[anchor], "k|", markersize=8, label="anchor in view")
    ax.plot(times[low], counts[low], "rx", markersize=6, label="fewer than two")
    ax.set_ylim(-0.4, max(counts.max(initial=1) + 1.5, 4))
    ax.set_ylabel("tags in view")
    ax.set_xlabel("time [s]")
    ax.grid(alpha=0.3)
    ax.legend(loc="upper right", fontsize=8, ncol=3)


def plot_frames(
    path: Path, log: TeachLog, errors: Array, observed: Sequence[tuple[float, Any]]
) -> None:
    """Writes the figure of true and observed frames.

    Args:
        path: of the PNG.
        log: of the run.
        errors: (n, 3) of every observation (`diagrams.tag_frames.frame_errors`).
        observed: time (s) and `X_WC` of the camera by the nearest tag.
    """
    figure = Figure(figsize=(12.0, 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = cast(NDArray[Any], figure.subfigures(1, 2, width_ratios=[1.0, 1.0]))
    plan = left.subplots()
    stamps = np.array([frame.stamp for frame in log.frames])
    true = log.true_cameras(stamps)
    places = np.array([X.translation()[:2] for X in true]).reshape(-1, 2)
    plan.plot(*places.T, color="black", linewidth=1.6, label="camera, true")
    seen = np.array([X.translation()[:2] for _, X in observed]).reshape(-1, 2)
    plan.plot(
        *seen.T, color="tab:red", marker="s", markersize=3, fillstyle="none", linestyle="none",
        label="camera, observed",
    )  # fmt: skip
    first = True
    for frame, X_WC in zip(log.frames, true, strict=True):
        for _, X_CT in frame.poses():
            x, y, _ = (X_WC @ X_CT).translation()
            label = "tag, observed" if first else None
            first = False
            plan.plot(x, y, color="tab:red", marker="x", markersize=3, label=label)
    for marker in log.markers:
        place, R = marker.X_WM.translation()[:2], marker.X_WM.rotation().matrix()
        ends = place + marker.size / 2 * np.outer([-1, 1], R[:2, 1])
        plan.plot(*ends.T, color="black", linewidth=3)
        plan.plot(*np.array([place, place + _ARROW * R[:2, 0]]).T, color="black", linewidth=0.8)
        plan.annotate(str(marker.id), place - 0.19 * R[:2, 0], ha="center", va="center", fontsize=8)
    plan.plot([], [], color="black", linewidth=3, label="tag, true (id)")
    plan.set_aspect("equal")
    plan.set_xlabel("x [m]")
    plan.set_ylabel("y [m]")
    left.legend(*plan.get_legend_handles_labels(), loc="outside upper center", ncol=4, fontsize=8)
    when = np.repeat(stamps, [len(frame) for frame in log.frames])
    names = ("tag [m]", "camera [m]", "rotation [deg]")
    for ax, name, values in zip(right.subplots(3, 1, sharex=True), names, errors.T, strict=True):
        ax.semilogy(when, np.maximum(values, 1e-12), "k.", markersize=3)
        ax.set_ylabel(f"error of {name}")
        ax.grid(alpha=0.3)
    ax.set_xlabel("time [s]")
    figure.savefig(path, dpi=110, metadata={"Software": None})
