"""The picture of a map: from above, how well the corners fit, and how sure each tag is."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from systems.mapping.mapping import TagMap
from systems.mapping.scene import corner_errors
from systems.mapping.trajectory import Trajectory
from systems.markers.layout import MarkerMap

Array = NDArray[np.float64]

_NAMES = "xyz"


def plot_map(
    path: Path,
    tag_map: TagMap,
    way: Trajectory,
    marker_map: MarkerMap,
    report: dict[str, Any],
    frames: list[dict[str, Any]],
) -> None:
    """Writes the figure of a map.

    Args:
        path: of the PNG.
        tag_map: what was found.
        way: of camera or body.
        marker_map: its tags, and known ones that were not seen.
        report: as `report.json` has it.
        frames: as `frames.csv` has them.
    """
    figure = Figure(figsize=(12.5, 8.0), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = cast(NDArray[Any], figure.subfigures(1, 2, width_ratios=[1.15, 1.0]))
    _plan(left.subplots(), way, marker_map, report["map"])
    histogram, time, rms, sigma = right.subplots(4, 1, height_ratios=[1.2, 1.0, 1.0, 1.0])
    _residuals(histogram, tag_map)
    _over_time(time, frames)
    _bars(rms, sigma, report["tags"])
    metrics, title = report["metrics"], report["outcome"]
    title += f": {metrics['tags']} tags, {metrics['frames']} frames, "
    title += f"{metrics['reprojection_rms_px']:.2f} px RMS over "
    title += f"{metrics['corners_used_fraction']:.1%} of the corners"
    for reason in report["reasons"].values():
        title += "\n" + (reason if len(reason) < 130 else reason[:127] + "...")
    figure.suptitle(title, fontsize=11)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _plan(ax: Axes, way: Trajectory, marker_map: MarkerMap, what: dict[str, Any]) -> None:
    corners = marker_map.corners(np.array(list(marker_map.markers)))
    places = np.concatenate([way.p_WB, corners.mean(axis=1)])
    # Along the axis that tells least: from above, where the map's z is up.
    along = int(np.argmin(np.ptp(places, axis=0)))
    a, b = (k for k in range(3) if k != along)
    if along == 1:
        a, b = 0, 2
    normals = np.array([marker.X_WM.rotation().matrix()[:, 0] for marker in marker_map])
    middles = corners.mean(axis=1)
    ax.plot(
        way.p_WB[:, a], way.p_WB[:, b], color="tab:blue", linewidth=0.9,
        label=f"way of {what['trajectory_of']}",
    )  # fmt: skip
    if len(way):
        ax.plot(way.p_WB[0, a], way.p_WB[0, b], "o", color="tab:blue", markersize=6, label="start")
    for quad in corners:
        ring = quad[[0, 1, 2, 3, 0]]
        ax.plot(ring[:, a], ring[:, b], color="black", linewidth=1.6)
    reach = 0.035 * float(np.ptp(places[:, [a, b]], axis=0).max())
    ax.quiver(
        middles[:, a], middles[:, b], reach * normals[:, a], reach * normals[:, b],
        angles="xy", scale_units="xy", scale=1, width=0.003, color="tab:red",
        label="tag, looking along the arrow",
    )  # fmt: skip
    held = set(what["held"])
    labels: list[Array] = []
    for k, marker in enumerate(marker_map):
        at = middles[k, [a, b]] - 0.7 * reach * normals[k, [a, b]]
        if all(np.hypot(*(at - other)) > 0.8 * reach for other in labels):  # legible ones only
            labels.append(at)
            ax.annotate(
                str(marker.id), at, fontsize=7, ha="center", va="center", color="0.25"
            )  # fmt: skip
    if len(held) == 1:
        at = middles[list(marker_map.markers).index(min(held))]
        ax.plot(at[a], at[b], "s", color="none", markeredgecolor="tab:green", markersize=13,
                label=f"anchor {min(held)}")  # fmt: skip
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel=f"{_NAMES[a]} [m]", ylabel=f"{_NAMES[b]} [m]")
    ax.set_title(f"seen along {_NAMES[along]} of the map's frame", fontsize=10)
    ax.grid(alpha=0.3)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), fontsize=8, ncol=4, frameon=False)


def _residuals(ax: Axes, tag_map: TagMap) -> None:
    r = corner_errors(tag_map.adjustment.scene, tag_map.all_sightings).reshape(-1, 4, 2)
    length = np.hypot(r[..., 0], r[..., 1]).ravel()
    noise = tag_map.pixel_noise
    top = 6 * noise
    shown = np.minimum(length, top)
    edges = np.linspace(0, top, 61).tolist()
    ax.hist(shown, edges, color="0.7", label="corners (the last bar: all beyond)")
    # Two coordinates of equal noise: Rayleigh's distribution.
    middle = (np.arange(60) + 0.5) * top / 60
    density = middle / noise**2 * np.exp(-((middle / noise) ** 2) / 2)
    ax.plot(middle, len(length) * density * top / 60, color="tab:red",
            label=f"noise of {noise:.2f} px in x and y")  # fmt: skip
    ax.set(xlabel="distance of a corner from where the map has it [px]", ylabel="corners")
    ax.legend(fontsize=8)
    ax.grid(alpha=0.3)


def _over_time(ax: Axes, frames: list[dict[str, Any]]) -> None:
    t, rms, outliers = (
        np.array([row[key] for row in frames])
        for key in ("time", "reprojection_rms_px", "outliers")
    )
    ax.plot(t - t[0], rms, ".", markersize=3, color="tab:blue", label="frame")
    some = outliers > 0
    if some.any():
        ax.plot((t - t[0])[some], np.nan_to_num(rms[some]), "x", color="tab:red", markersize=5,
                label="one with tags that do not fit, left out")  # fmt: skip
    ax.set(xlabel="time [s]", ylabel="residual\nRMS [px]")
    ax.set_ylim(0.0, 1.25 * ax.get_ylim()[1])  # room for the legend
    ax.legend(fontsize=8, ncol=2, loc="upper left")
    ax.grid(alpha=0.3)


def _bars(rms: Axes, sigma: Axes, rows: list[dict[str, Any]]) -> None:
    at = np.arange(len(rows))
    rms.bar(at, [row["reprojection_rms_px"] for row in rows], color="tab:blue", width=0.8)
    rms.set_ylabel("residual\nRMS [px]")
    sigma.bar(at, [1e3 * row["sigma_m"] for row in rows], color="tab:orange", width=0.8)
    sigma.set(xlabel="tag", ylabel="sigma of the\nposition [mm]")
    every = 1 + (len(rows) - 1) // 24
    for ax in (rms, sigma):
        ax.set_xticks(at[::every], [str(row["ID"]) for row in rows][::every], fontsize=7)
        ax.set_xlim(-1, len(rows))
        ax.grid(axis="y", alpha=0.3)
