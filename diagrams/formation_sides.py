"""How long the sides of a formation's triangles should be: accuracy against moves and time.

[FORM] 4.3 names the trade-off and does not measure it. Here each side length gets its own trials of
building a triangle, in kinematics and projection, by Algorithm I and by resection; then the
triangles are put one after another along a straight line of about 30 m.

[FORM]: Kang, Kwon, Bae, Kim, "Monocular Vision-Based Swarm Robot Localization Using Equilateral
Triangular Formations".
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from diagrams.formation_table import STRAIGHT, WHEEL_RADIUS, WHEEL_SPEEDS, Numbers, study_random
from diagrams.model_studies import Findings
from diagrams.study_report import TextTable
from systems.formation.error_models import MeasuredErrors, summed_errors
from systems.formation.trials import (
    Outcome,
    TrialParameters,
    build_by_algorithm1,
    build_by_resection,
)
from systems.formation.vertex_walk import VertexWalk, closest_vertex_walk
from systems.validation import require

Array = NDArray[np.float64]
Build = Callable[[int, np.random.Generator, TrialParameters], Outcome]

SIDES = (0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0)  # m
METHODS: Mapping[str, Build] = {
    "Algorithm I": build_by_algorithm1,
    "resection": build_by_resection,
}


def by_measured_side(*, runs: int, seed: int) -> list[Numbers]:
    """Returns a row for each method and side length.

    Mean absolute errors of a triangle, trials that never ended (in nothing else), seconds to build
    one, moves along the line, the whole time at 5.8 rad/s, and the error at the end where the
    triangles' errors are summed as if each orientation were known.

    Args:
        runs: triangles that are built at each side, and lines that are made of them.
        seed: of the study.
    """
    rows = []
    for method, build in METHODS.items():
        for side in SIDES:
            random = study_random(seed, f"side/{method}/{side:g}")
            outcome = build(runs, random, TrialParameters(side=side))
            ended = np.isfinite(outcome.seconds)
            trials = np.stack([outcome.aside, outcome.along], axis=1)[ended]
            walk = closest_vertex_walk(STRAIGHT, side=side)
            row: Numbers = {
                "method": method,
                "side_m": side,
                "not_ended": int((~ended).sum()),
                "moves": len(walk),
            }
            rows.append(row | _of_trials(trials, outcome.seconds[ended], walk, random, runs))
    return rows


def _of_trials(
    trials: Array, seconds: Array, walk: VertexWalk, random: np.random.Generator, runs: int
) -> Numbers:
    names = ("lateral_m", "longitudinal_m", "build_s", "time_s", "error_m", "standard_error_m")
    if len(trials) == 0:
        return dict.fromkeys(names)
    lateral, longitudinal = np.abs(trials).mean(axis=0)
    build = seconds.mean()
    drive = walk.drives.sum() / (WHEEL_SPEEDS[0] * WHEEL_RADIUS)
    drawn = MeasuredErrors(trials).draw(random, (runs, len(walk)))
    sizes = np.linalg.norm(summed_errors(walk, drawn)[:, -1], axis=1)
    error = sizes.std(ddof=1) / math.sqrt(runs)
    values = (lateral, longitudinal, build, drive + len(walk) * build, sizes.mean(), error)
    return dict(zip(names, map(float, values), strict=True))


def formation_side(folder: Path, runs: int, *, seed: int = 0) -> Findings:
    """Writes `sides.json` and `sides.png` into an existing folder; returns what to print.

    Args:
        folder: an existing one.
        runs: triangles that are built at each side.
        seed: of the study.

    Raises:
        ValueError: too few runs.
    """
    require(runs >= 2, "runs", runs, "2 or more")
    rows = by_measured_side(runs=runs, seed=seed)
    numbers = {"runs": runs, "seed": seed, "conditions": vars(TrialParameters()), "rows": rows}
    (folder / "sides.json").write_text(json.dumps(numbers, indent=1, allow_nan=False) + "\n")
    plot_measured_sides(folder / "sides.png", rows)
    return Findings(_table(rows, runs), _notes(rows, runs))


def _notes(rows: list[Numbers], runs: int) -> list[str]:
    notes = [
        f"Of {runs} triangles at each side: mean absolute lateral and longitudinal error, time to "
        "build one.",
        f"Of a straight line of about 30 m: moves, time (wheels at {WHEEL_SPEEDS[0]:g} rad/s), "
        "mean error at its end, summed as if each triangle's orientation were known.",
    ]
    lost = sum(row["not_ended"] for row in rows)
    return [*notes, f"{lost} triangles were never finished and are in no mean."] if lost else notes


def _table(rows: list[Numbers], runs: int) -> TextTable:
    header = ["", "side m", "lat. mm", "long. mm", "build s", "moves", "time s", "error m"]
    words = [
        [
            row["method"].replace("Algorithm", "Alg."),
            f"{row['side_m']:g}",
            _scaled(row["lateral_m"], 1e3, 1),
            _scaled(row["longitudinal_m"], 1e3, 1),
            _scaled(row["build_s"], 1, 1),
            str(row["moves"]),
            _scaled(row["time_s"], 1, 0),
            _scaled(row["error_m"], 1, 3),
        ]
        for row in rows
    ]
    title = f"Sides of the triangles, {runs} of each built"
    return TextTable(title, header, words, [len(SIDES)] * len(METHODS))


def _scaled(value: float | None, factor: float, digits: int) -> str:
    return "-" if value is None else f"{factor * value:.{digits}f}"


def plot_measured_sides(path: Path, rows: list[Numbers]) -> None:
    """Writes side length against the error of a triangle, that of the line, moves and time."""
    figure = Figure(figsize=(14.0, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 4)
    for (method, style), mark in zip(_STYLES.items(), "os", strict=True):
        known = [row for row in rows if row["method"] == method and row["error_m"] is not None]
        sides = [row["side_m"] for row in known]
        for axis, fill in (("lateral", "full"), ("longitudinal", "none")):
            values = [1e3 * row[f"{axis}_m"] for row in known]
            label = f"{method}, {axis}"
            axes[0].plot(sides, values, style, marker=mark, fillstyle=fill, label=label)
        errors = [row["error_m"] for row in known]
        bars = [2 * row["standard_error_m"] for row in known]
        line = {"linestyle": style[1:], "color": "k", "marker": mark, "label": method}
        axes[1].errorbar(sides, errors, yerr=bars, capsize=3, **line)
        axes[3].plot(sides, [row["time_s"] for row in known], **line)
    first = rows[: len(SIDES)]
    axes[2].plot([row["side_m"] for row in first], [row["moves"] for row in first], "k-D")
    labels = ("error of a triangle [mm]", "error after 30 m [m]", "moves", "time [s]")
    for ax, label in zip(axes, labels, strict=True):
        ax.set(xlabel="side of the triangles [m]", ylabel=label, ylim=(0, None))
        ax.grid(alpha=0.3)
    for k in (0, 1, 3):  # with room above the curves
        axes[k].set_ylim(0, 1.35 * axes[k].get_ylim()[1])
        axes[k].legend(fontsize=7, loc="upper center", ncols=2)
    figure.savefig(path, dpi=110, metadata={"Software": None})


_STYLES = {"Algorithm I": "k-", "resection": "k--"}
