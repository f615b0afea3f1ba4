"""Figures of the studies of a formation. Line styles and marks tell all; colour only helps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from systems.formation.error_models import unfold

Array = NDArray[np.float64]

_PITCH = 0.32  # of a table's lines, inches
_FIRST, _COLUMN = 2.8, 2.2  # widths of a table's columns, inches
_MARGIN = 0.2  # inches

# By the beginning of a curve's name; the first that fits.
_STYLES: dict[str, dict[str, Any]] = {
    "dead reckoning, gyro bias": {"color": "tab:orange", "linestyle": "-."},
    "dead reckoning": {"color": "tab:red", "linestyle": "--"},
    "triangles, sum": {"color": "black", "linestyle": "-"},
    "triangles, chain (bearings)": {"color": "tab:blue", "linestyle": ":"},
    "triangles, chain (edge)": {"color": "tab:green", "linestyle": (0, (4, 1, 1, 1, 1, 1))},
}


def plot_table(
    path: Path,
    title: str,
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    notes: Sequence[str],
) -> None:
    """Writes a table as a PNG; cells that begin with * are bold."""
    width = 2 * _MARGIN + _FIRST + _COLUMN * (len(header) - 1)
    height = _PITCH * (len(rows) + len(notes) + 4.2)
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    ax = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(height, 0))
    ax.set_axis_off()

    def write(column: int, line: float, text: str, **style: Any) -> None:
        left = _MARGIN if column == 0 else _MARGIN + _FIRST + _COLUMN * (column - 0.5)
        ax.text(
            left,
            _PITCH * line,
            text.removeprefix("*"),
            va="center",
            ha="left" if column == 0 else "center",
            fontweight="bold" if text.startswith("*") else "normal",
            **{"fontsize": 10, **style},
        )

    def rule(line: float, thickness: float) -> None:
        ends = [_MARGIN, width - _MARGIN]
        ax.plot(ends, 2 * [_PITCH * line], color="black", linewidth=thickness)

    write(0, 0.8, title, fontsize=12)
    rule(1.4, 1.5)
    for column, text in enumerate(header):
        write(column, 2.0, text)
    rule(2.6, 0.8)
    for line, row in enumerate(rows):
        for column, text in enumerate(row):
            write(column, 3.2 + line, text)
    rule(2.8 + len(rows), 1.5)
    for line, text in enumerate(notes):
        write(0, 3.5 + len(rows) + line, text, fontsize=9, color="0.3")
    _save(figure, path)


def plot_cdfs(
    path: Path, sizes: Array, paper: Mapping[str, tuple[float, float]], source: str
) -> None:
    """Writes the empirical distributions of absolute errors, [FORM] Fig. 11.

    Args:
        path: of the PNG.
        sizes: (n, axes) m.
        paper: by axis, in the order of the columns: mean and standard deviation, m. Drawn as the
            folded normal distribution that has them, as the paper's samples are not known.
        source: of the errors, a word for the title.
    """
    figure = Figure(figsize=(9.0, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(paper), sharey=True, squeeze=False)[0]
    for k, (ax, (axis, (mean, deviation))) in enumerate(zip(axes, paper.items(), strict=True)):
        errors = np.sort(sizes[:, k])
        end = 1.05 * max([mean + 4 * deviation, *errors[-1:]])
        grid = np.linspace(0, end, 300)
        theirs = f"paper: {1e3 * mean:.0f} ± {1e3 * deviation:.0f} mm"
        below = folded_normal_cdf(grid, mean, deviation)
        ax.plot(1e3 * grid, below, color="tab:red", linestyle="--", label=theirs)
        if len(errors) > 1:
            ours = f"{1e3 * errors.mean():.1f} ± {1e3 * errors.std(ddof=1):.1f} mm"
            ax.ecdf(1e3 * errors, color="black", label=f"{len(errors)} trials: {ours}")
        ax.set_xlim(0, 1e3 * end)
        ax.set_xlabel(f"absolute {axis} error [mm]")
        ax.legend(loc="lower right", fontsize=8)
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("part of the trials below")
    figure.suptitle(f"Error of building a triangle, from {source}", fontsize=10)
    _save(figure, path)


def folded_normal_cdf(sizes: Array, mean: float, deviation: float) -> Array:
    """Returns the part of |x| below sizes (n,) for a normal x whose |x| has mean and deviation."""
    offset, spread = unfold(mean, deviation)
    scale = math.sqrt(2) * spread
    return np.array(
        [(math.erf((a - offset) / scale) + math.erf((a + offset) / scale)) / 2 for a in sizes]
    )


def plot_over_time(path: Path, curves: Mapping[str, Mapping[str, Any]]) -> None:
    """Writes the errors over time, [FORM] Fig. 14: a column for each path, a row for each speed.

    Args:
        path: of the PNG.
        curves: {path: {"{model}, {speed} rad/s": {"time_s", "error_m"}}}.
    """
    speeds = list(dict.fromkeys(name.split(", ")[-1] for each in curves.values() for name in each))
    figure = Figure(figsize=(12.0, 3.6 * len(speeds) + 0.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(speeds), len(curves), squeeze=False)
    for column, (name, each) in enumerate(curves.items()):
        for row, speed in enumerate(speeds):
            ax = axes[row, column]
            for curve, values in each.items():
                model = curve.removesuffix(f", {speed}")
                if model != curve:
                    ax.plot(values["time_s"], values["error_m"], label=model, **_style(model))
            ax.set_title(f"{name}, {speed}", fontsize=10)
            ax.set_ylim(bottom=0)
            _label(ax, "time [s]", "error [m]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9)
    _save(figure, path)


def plot_robots(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes the error by number of robots, [FORM] Fig. 15, and the moves and time it takes."""
    figure = Figure(figsize=(12.0, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    for name, mark, line in (("straight", "o", "-"), ("path 1", "s", "--")):
        known = [row for row in rows if row[name] is not None]
        robots = [row["robots"] for row in known]
        style: dict[str, Any] = {"marker": mark, "linestyle": line, "color": "black"}
        means = [row[name]["mean_m"] for row in known]
        bars = [2 * row[name]["standard_error_m"] for row in known]
        axes[0].errorbar(robots, means, yerr=bars, capsize=3, label=name, **style)
        axes[1].plot(robots, [row[name]["moves"] for row in known], label=name, **style)
        axes[2].plot(robots, [row[name]["time_s"] for row in known], label=name, **style)
    labels = ("mean error of the sum, ± 2 standard errors [m]", "moves", "time at 5.8 rad/s [s]")
    for ax, label in zip(axes, labels, strict=True):
        ax.set_ylim(bottom=0)
        _label(ax, "robots", label)
    axes[0].legend(fontsize=8)
    _save(figure, path)


def plot_sides(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes side length against accuracy, number of moves and time."""
    figure = Figure(figsize=(12.0, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    sides = [row["side_m"] for row in rows]
    for name, mark, label in (
        ("proportional_errors", "o", "a triangle's error in proportion to the side"),
        ("constant_errors", "s", "the same at every side"),
    ):
        means = [row[name]["mean_m"] for row in rows]
        bars = [2 * row[name]["standard_error_m"] for row in rows]
        axes[0].errorbar(sides, means, yerr=bars, capsize=3, marker=mark, label=label)
    axes[1].plot(sides, [row["moves"] for row in rows], marker="o", color="black")
    axes[2].plot(sides, [row["time_s"] for row in rows], marker="o", color="black")
    labels = ("mean error of the sum, ± 2 standard errors [m]", "moves", "time at 5.8 rad/s [s]")
    for ax, label in zip(axes, labels, strict=True):
        ax.set_ylim(bottom=0)
        _label(ax, "side of the triangles [m]", label)
    axes[0].legend(fontsize=8)
    _save(figure, path)


def _style(model: str) -> dict[str, Any]:
    return next((s for beginning, s in _STYLES.items() if model.startswith(beginning)), {})


def _label(ax: Axes, x: str, y: str) -> None:
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    ax.grid(alpha=0.3)


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=110, metadata={"Software": None})
