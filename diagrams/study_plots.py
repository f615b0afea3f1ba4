"""The figure of a study: success rates and metrics, a row for each variant.

Successful and other runs differ in their markers, variants in their rows: colour is not needed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from diagrams.study import Study, value_text
from diagrams.study_folder import Record
from diagrams.study_report import by_variant, metric_values, short_keys, wilson_interval

_PANELS = 16  # the success rate and as many metrics as leave the figure legible
_COLUMNS = 4
_LABEL_LENGTH = 30  # of a variant's value
_UNITS = {"m": "m", "s": "s", "ms": "ms", "deg": "degrees"}  # by the last word of a metric's name
_UNITS_BY_NAME = {"integrated_jerk": "m²/s⁵"}
_NOT_SHOWN = ("sim_seconds",)  # the time to the goal, when it is reached, says it

_DONE: dict[str, Any] = {"marker": "o", "s": 12, "facecolor": "tab:blue", "alpha": 0.55}
_OTHER: dict[str, Any] = {"marker": "x", "s": 18, "color": "0.25", "linewidth": 0.9}


def plot_study(path: Path, study: Study, records: Iterable[Record]) -> None:
    """Writes the figure of a study.

    The metrics are the first fifteen that vary at all. Their points are runs, their boxes hold the
    middle half of the successful runs, their lines the middle 80 %.

    Args:
        path: of the PNG.
        study: what was run.
        records: of its runs.
    """
    groups = list(by_variant(study, records).values())
    done = [metric_values(group, succeeded_only=True) for group in groups]
    other = [
        metric_values([r for r in group if not r["succeeded"]], succeeded_only=False)
        for group in groups
    ]
    names = varying_metrics([*done, *other])[: _PANELS - 1]
    columns = min(_COLUMNS, 1 + len(names))
    rows = math.ceil((1 + len(names)) / columns)
    lines = max(1, len(study.sweep)) * len(groups)
    size = (3.3 * columns + 1.5, (1.0 + max(1.0, 0.2 * lines + 0.2 * len(groups))) * rows + 0.5)
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, sharey=True, squeeze=False)
    _rates(axes.flat[0], groups)
    for ax, name in zip(axes.flat[1:], names, strict=False):
        _metric(ax, name, [d.get(name, []) for d in done], [o.get(name, []) for o in other])
    for ax in axes.flat[1 + len(names) :]:
        ax.set_visible(False)
    axes[0, 0].set_yticks(range(len(groups)), short_labels(study))
    axes[0, 0].set_ylim(len(groups) - 0.4, -0.6)  # the first variant on top
    if names:
        _legend(figure, axes.flat[1])
    figure.suptitle(f"{study.scenario}: {len(groups[0])} runs of each variant", fontsize=10)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def varying_metrics(values: Iterable[Mapping[str, Sequence[float]]]) -> list[str]:
    """Returns the names of the metrics that have two different values somewhere."""
    together: dict[str, set[float]] = {}
    for group in values:
        for name, found in group.items():
            together.setdefault(name, set()).update(found)
    return [name for name, found in together.items() if len(found) > 1 and name not in _NOT_SHOWN]


def metric_label(name: str) -> str:
    """Returns a metric's name as the label of an axis, with its unit: "path length [m]"."""
    words = name.split("_")
    if name in _UNITS_BY_NAME:
        unit = _UNITS_BY_NAME[name]
    elif len(words) > 1 and words[-1] in _UNITS:
        unit = _UNITS[words.pop()]
    else:
        unit = "-"
    return f"{' '.join(words)} [{unit}]"


def short_labels(study: Study) -> list[str]:
    """Returns the variants' values under the shortest ends of their keys that tell them apart."""
    if not study.sweep:
        return [variant.name for variant in study.variants]
    keys = short_keys(list(study.sweep))
    labels = [
        "\n".join(
            f"{key} = {_clipped(value_text(value))}"
            for key, value in zip(keys, variant.values.values(), strict=True)
        )
        for variant in study.variants
    ]
    if len(set(labels)) < len(labels):  # they differ only in what was left out
        return [variant.name for variant in study.variants]
    return labels


def _clipped(text: str) -> str:
    half = _LABEL_LENGTH // 2
    return text if len(text) <= _LABEL_LENGTH else f"{text[: half - 1]}...{text[-half + 2 :]}"


def _rates(ax: Axes, groups: Sequence[Sequence[Record]]) -> None:
    for row, records in enumerate(groups):
        successes = sum(record["succeeded"] for record in records)
        rate = 100 * successes / len(records)
        low, high = (100 * bound for bound in wilson_interval(successes, len(records)))
        ax.plot([low, high], [row, row], color="black", linewidth=1.2, marker="|", markersize=8)
        ax.plot(rate, row, color="black", marker="D", markersize=5)
        side = "left" if rate < 50 else "right"
        ax.annotate(
            f"{successes}/{len(records)}",
            (rate, row),
            xytext=(0, 5),
            textcoords="offset points",
            ha=side,
            fontsize=8,
        )
    ax.set_xlim(-4, 104)
    ax.set_xlabel("success rate [%], 95 % interval", fontsize=9)
    _tidy(ax)


def _metric(
    ax: Axes, name: str, done: Sequence[Sequence[float]], other: Sequence[Sequence[float]]
) -> None:
    ax.scatter(*_points(done), linewidth=0, **_DONE)
    ax.scatter(*_points(other), **_OTHER)
    several = [row for row, good in enumerate(done) if len(good) > 1]
    if several:
        _boxes(
            ax,
            np.array(several),
            np.array([np.quantile(done[row], [0.1, 0.25, 0.5, 0.75, 0.9]) for row in several]),
        )
    low, high, logarithmic = axis_range([value for group in (*done, *other) for value in group])
    if logarithmic:
        ax.set_xscale("log")
    else:
        ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.set_xlim(low, high)
    ax.set_xlabel(metric_label(name), fontsize=9)
    _tidy(ax)


def axis_range(values: Sequence[float]) -> tuple[float, float, bool]:
    """Returns the ends of an axis that shows all values, and whether it is logarithmic."""
    low, high = min(values), max(values)
    if low > 0 and high > 100 * low:
        margin = (high / low) ** 0.05
        return low / margin, high * margin, True
    margin = 0.05 * (high - low) or 1.0
    return low - margin, high + margin, False


def _points(groups: Sequence[Sequence[float]]) -> tuple[np.ndarray, np.ndarray]:
    """Returns values and heights; neighbouring runs of a row stand apart (golden ratio)."""
    heights = [
        row + 0.56 * (np.arange(len(values)) * 0.6180339887 % 1.0 - 0.5)
        for row, values in enumerate(groups)
    ]
    return np.concatenate([np.asarray(values, float) for values in groups]), np.concatenate(heights)


def _boxes(ax: Axes, rows: np.ndarray, quantiles: np.ndarray) -> None:
    """Draws the 10, 25, 50, 75 and 90 % quantiles (n, 5) of n rows."""
    low, left, middle, right, high = quantiles.T
    ax.hlines(rows, low, high, color="black", linewidth=1.0, zorder=3)
    ax.barh(
        rows,
        right - left,
        height=0.32,
        left=left,
        facecolor=(1, 1, 1, 0.6),
        edgecolor="black",
        linewidth=1.0,
        zorder=3,
    )
    ax.vlines(middle, rows - 0.24, rows + 0.24, color="black", linewidth=2.2, zorder=4)


def _tidy(ax: Axes) -> None:
    ax.tick_params(labelsize=8)
    ax.grid(axis="x", alpha=0.3)


def _legend(figure: Figure, ax: Axes) -> None:
    handles = [
        ax.scatter([], [], linewidth=0, **_DONE),
        ax.scatter([], [], **_OTHER),
        *ax.plot([], [], color="black", linewidth=1.0),
        ax.fill_between([], [], [], facecolor="white", edgecolor="black"),
        *ax.plot([], [], color="black", linewidth=2.2),
    ]
    words = ["successful run", "other run", "10-90 % of the successful", "25-75 %", "median"]
    figure.legend(handles, words, loc="outside lower center", ncol=5, fontsize=8, frameon=False)
