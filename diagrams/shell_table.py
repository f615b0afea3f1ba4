"""Table I of the paper, ours beside the paper's, as JSON and as a picture.

[SNAIL]: Zhang, Lam, "Relative Localization System Design for SnailBot: A Modular
Self-reconfigurable Robot". It scores differences of angles; ours are components of rotation vectors
(see `diagrams.shell_metrics`), with its differences beside them where they are defined. In every
row less is better.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from diagrams.shell_metrics import AXES, ShellLog

Array = NDArray[np.float64]
Cell = dict[str, float | None]
Table = dict[str, dict[str, Cell]]

COLUMNS = ("ours", "paper", "ours_angle")
SHARE = "share_of_samples"

# [SNAIL] Table I: roll, pitch, yaw; degrees, and fractions (which it heads %).
PAPER: dict[str, tuple[float, float, float]] = {
    "rmse_deg": (3.2965, 3.1783, 3.7709),
    "mae_deg": (2.6386, 2.5048, 3.0562),
    "median_deg": (2.2810, 2.0993, 2.6156),
    "p95_deg": (6.4552, 6.4052, 7.1980),
    "maximum_deg": (10.0509, 10.9924, 12.1913),
    "standard_deviation_deg": (3.2941, 3.1777, 3.7707),
    "rate_above_5_deg": (0.1290, 0.1160, 0.1950),
    "rate_above_10_deg": (0.0010, 0.0020, 0.0070),
    "rate_above_15_deg": (0.0, 0.0, 0.0),
    "rate_above_20_deg": (0.0, 0.0, 0.0),
    "p99_deg": (8.2629, 8.5815, 8.9005),
    "p99_5_deg": (8.8337, 9.1606, 10.0841),
    "iterations_rmse_mean_deg": (3.2891, 3.1737, 3.7618),
    "iterations_rmse_std_deg": (0.1576, 0.1235, 0.1288),
    "iterations_mae_mean_deg": (2.6350, 2.5011, 3.0469),
    "iterations_mae_std_deg": (0.1218, 0.1047, 0.0771),
}


def table(log: ShellLog) -> Table:
    """Returns {row: {axis: {"ours", "paper", "ours_angle"}}}; None where nothing can be said.

    Rows are those of `PAPER`, of absolute errors, but the standard deviation, which is that of the
    signed ones about their mean (ddof 0, so that RMSE^2 = mean^2 + deviation^2; the paper's numbers
    agree with that). `ours` is of the scored samples, `ours_angle` of those at which the angles are
    defined; the last row, `share_of_samples`, says which part of the run each is. Over the
    iterations: mean and standard deviation (ddof 1, of a sample of iterations) of each one's RMSE
    and MAE, None with fewer than two.
    """
    scored = log.scored()
    by_angle, defined = log.angle_errors()
    ours = _rows(log.errors(), scored, log.iteration)
    ours_angle = _rows(by_angle, scored & defined, log.iteration)
    return {
        row: {
            axis: {
                "ours": _number(ours[row][k]),
                "paper": PAPER[row][k] if row in PAPER else None,
                "ours_angle": _number(ours_angle[row][k]),
            }
            for k, axis in enumerate(AXES)
        }
        for row in (*PAPER, SHARE)
    }


def _rows(errors: Array, used: NDArray[np.bool_], iteration: NDArray[np.int64]) -> dict[str, Array]:
    """Returns each row's three numbers, of the used ones of errors (n, 3) deg."""
    nothing = np.full(3, np.nan)
    rows = dict.fromkeys(PAPER, nothing)
    rows[SHARE] = np.full(3, used.mean()) if len(used) else nothing
    errors, iteration = errors[used], iteration[used]
    if not len(errors):
        return rows
    size = np.abs(errors)
    rows["rmse_deg"] = _rmse(errors)
    rows["mae_deg"] = _mae(errors)
    rows["median_deg"] = np.median(size, axis=0)
    rows["maximum_deg"] = size.max(axis=0)
    rows["standard_deviation_deg"] = errors.std(axis=0)
    for percentile, row in ((95, "p95_deg"), (99, "p99_deg"), (99.5, "p99_5_deg")):
        rows[row] = np.percentile(size, percentile, axis=0)
    for limit in (5, 10, 15, 20):
        rows[f"rate_above_{limit}_deg"] = (~(size <= limit)).mean(axis=0)  # no number is above
    each = [errors[iteration == k] for k in np.unique(iteration)]
    if len(each) > 1:
        measures: dict[str, Callable[[Array], Array]] = {"rmse": _rmse, "mae": _mae}
        for name, measure in measures.items():
            values = np.array([measure(part) for part in each])
            rows[f"iterations_{name}_mean_deg"] = values.mean(axis=0)
            rows[f"iterations_{name}_std_deg"] = values.std(axis=0, ddof=1)
    return rows


def _rmse(errors: Array) -> Array:
    return np.asarray(np.sqrt((errors**2).mean(axis=0)))


def _mae(errors: Array) -> Array:
    return np.asarray(np.abs(errors).mean(axis=0))


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def write_table(log: ShellLog, folder: Path, suffix: str = "") -> Table:
    """Writes `table1{suffix}.json` and `table1{suffix}.png` into a folder; returns the table."""
    numbers = table(log)
    name = f"table1{suffix}"
    (folder / f"{name}.json").write_text(json.dumps(numbers, indent=1, allow_nan=False) + "\n")
    table_figure(numbers).savefig(folder / f"{name}.png", dpi=_DPI, metadata={"Software": None})
    return numbers


# --- The picture ---


_LABELS = {
    "rmse_deg": "RMSE [deg]",
    "mae_deg": "mean absolute error [deg]",
    "median_deg": "median [deg]",
    "p95_deg": "95th percentile [deg]",
    "p99_deg": "99th percentile [deg]",
    "p99_5_deg": "99.5th percentile [deg]",
    "maximum_deg": "maximum [deg]",
    "standard_deviation_deg": "standard deviation [deg]",
    "rate_above_5_deg": "part above 5 deg",
    "rate_above_10_deg": "part above 10 deg",
    "rate_above_15_deg": "part above 15 deg",
    "rate_above_20_deg": "part above 20 deg",
    "iterations_rmse_mean_deg": "RMSE of each iteration, mean [deg]",
    "iterations_rmse_std_deg": "    ± [deg]",
    "iterations_mae_mean_deg": "MAE of each iteration, mean [deg]",
    "iterations_mae_std_deg": "    ± [deg]",
    SHARE: "part of the run's samples",
}
_RULED_AFTER = ("standard_deviation_deg", "rate_above_20_deg", "iterations_mae_std_deg")
_DPI = 100
_WIDTH, _PITCH = 16.0, 0.34  # of the figure and from line to line, inches
_MARGIN, _FIRST, _GROUP, _COLUMN = 0.25, 4.4, 4.15, 1.3  # places along the width, inches
_HEADINGS = {"ours": "ours", "paper": "paper", "ours_angle": "our angles"}
# Told by weight and mark; colour only helps.
_BETTER: dict[str, Any] = {"fontweight": "bold", "color": "black"}
_WORSE: dict[str, Any] = {"fontstyle": "italic", "color": "tab:red"}
_PLAIN: dict[str, Any] = {"color": "0.35"}


def table_figure(numbers: Table) -> Figure:
    """Returns the table as a figure: what is below the paper's bold and marked, above it italic."""
    height = _PITCH * (len(_LABELS) + 6.4)
    figure = Figure(figsize=(_WIDTH, height))
    FigureCanvasAgg(figure)
    ax = figure.add_axes((0, 0, 1, 1), xlim=(0, _WIDTH), ylim=(height, 0))
    ax.set_axis_off()

    def rule(line: float, width: float, start: float = _MARGIN, end: float | None = None) -> None:
        ends = [start, _WIDTH - _MARGIN if end is None else end]
        ax.plot(ends, 2 * [_PITCH * line], color="black", linewidth=width)

    def write(x: float, line: float, text: str, **style: Any) -> None:
        ax.text(x, _PITCH * line, text, va="center", **{"fontsize": 11, **style})

    rule(0.5, 1.5)
    for k, axis in enumerate(AXES):
        left = _FIRST + k * _GROUP
        write(left + 0.5 * _COLUMN, 1.1, f"{axis} ({'xyz'[k]} of R)", ha="center", fontsize=12)
        rule(1.65, 0.5, left - 0.95 * _COLUMN, left + 1.95 * _COLUMN)
        for c, column in enumerate(COLUMNS):
            write(left + (c - 0.5) * _COLUMN, 2.15, _HEADINGS[column], ha="center", **_PLAIN)
    rule(2.7, 1.0)
    for n, (row, label) in enumerate(_LABELS.items()):
        y = 3.4 + n
        write(_MARGIN, y, label)
        for k, axis in enumerate(AXES):
            for c, column in enumerate(COLUMNS):
                text, style = _printed(numbers[row][axis], column)
                x = _FIRST + k * _GROUP + (c - 0.5) * _COLUMN
                write(x, y, text, ha="center", **style)
        if row in _RULED_AFTER:
            rule(y + 0.5, 0.5)
    last = 3.4 + len(_LABELS)
    rule(last - 0.4, 1.5)
    words = [
        "ours: components of the error's rotation vector in the shell's frame R. "
        "our angles: differences of angles, as in the paper, farther than 10 deg from the poles.",
        "paper: Zhang, Lam, Table I. Bold, ▼: below the paper's. Italic, ▲: above it. "
        "Scored from the second marker on. -: nothing to say (of iterations: fewer than two).",
    ]
    for n, sentence in enumerate(words):
        write(_MARGIN, last + 0.4 + 0.9 * n, sentence, fontsize=10)
    return figure


def _printed(cell: Cell, column: str) -> tuple[str, dict[str, Any]]:
    """Returns a cell's text and style."""
    value, paper = cell[column], cell["paper"]
    if value is None:
        return "-", _PLAIN
    if column == "paper" or paper is None or value == paper:
        return f"{value:.4f}", _PLAIN
    return (f"▼ {value:.4f}", _BETTER) if value < paper else (f"▲ {value:.4f}", _WORSE)
