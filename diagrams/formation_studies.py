"""Studies of a formation in open space by models of its errors, beside the paper's numbers.

`formation_error_model` says how exactly one triangle is built, `formation_table1` what comes of it
after many. Nothing here is simulated in the plant: the error of a triangle comes from a source that
is handed in. By default the first simulates Algorithm I in many worlds of kinematics and projection
at once, and the second draws from the paper's own distribution.

[FORM]: Kang, Kwon, Bae, Kim, "Monocular Vision-Based Swarm Robot Localization Using Equilateral
Triangular Formations".
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diagrams.formation_closed_loop import closed_loop
from diagrams.formation_plots import (
    plot_cdfs,
    plot_over_time,
    plot_robots,
    plot_sides,
    plot_table,
)
from diagrams.formation_table import (
    GYRO_BIAS,
    PAPER,
    PATHS,
    WHEEL_SPEEDS,
    Numbers,
    by_robots,
    by_side,
    cell,
    study_random,
    table1,
)
from diagrams.model_studies import Findings
from diagrams.study_folder import Record
from diagrams.study_report import TextTable
from systems.formation.dead_reckoning import DeadReckoningParameters
from systems.formation.error_models import FoldedNormalErrors, StepErrors
from systems.formation.trials import Algorithm1Trials
from systems.validation import require

Array = NDArray[np.float64]

# [FORM] 4.2: mean and standard deviation of the absolute error of a triangle, m.
PAPER_ERRORS = {"lateral": (0.036, 0.021), "longitudinal": (0.013, 0.009)}

PAPER_SOURCE = "the paper's distribution"
ALGORITHM1_SOURCE = "Algorithm I"

# --- One triangle ---


def formation_error_model(
    folder: Path, *, trials: int = 60, seed: int = 0, errors: StepErrors | None = None
) -> Numbers:
    """Writes `error_model.json`, `.png` and `error_cdf.png` ([FORM] Fig. 11); returns the numbers.

    By axis: bias (mean of the signed errors), mean and standard deviation (ddof 1) of the absolute
    ones, their 95th percentile and largest, the paper's mean and deviation; and how many trials
    never ended (not finite), which are in nothing else.

    Args:
        folder: an existing one.
        trials: how many triangles are built.
        seed: of the study.
        errors: builds the triangles; by default simulates Algorithm I under conditions that are
            ours, as the paper does not state them. `FoldedNormalErrors()` is the paper's
            distribution, which then comes out but for the trials' finite number.

    Raises:
        ValueError: too few trials.
    """
    require(trials >= 2, "trials", trials, "2 or more")
    drawn = (errors or Algorithm1Trials()).draw(study_random(seed, "error_model"), (trials,))
    ended = drawn[np.isfinite(drawn).all(axis=1)]
    source = ALGORITHM1_SOURCE if errors is None else type(errors).__name__
    numbers: Numbers = {
        "errors_from": source,
        "trials": trials,
        "not_ended": trials - len(ended),
        "axes": {},
    }
    for k, (axis, paper) in enumerate(PAPER_ERRORS.items()):
        numbers["axes"][axis] = {
            **_statistics(ended[:, k]),
            "paper_mean_m": paper[0],
            "paper_standard_deviation_m": paper[1],
        }
    _write(folder / "error_model.json", numbers)
    table = _error_model_table(numbers)
    plot_table(folder / "error_model.png", table.title, table.header, table.rows, [])
    plot_cdfs(folder / "error_cdf.png", np.abs(ended), PAPER_ERRORS, source)
    return numbers


def _error_model_table(numbers: Numbers) -> TextTable:
    header = ["[mm]", "bias", "mean", "± std", "95 %", "largest", "paper: mean", "± std"]
    rows = [
        [axis, *(_scaled(value, 1000, 1) for value in row.values())]
        for axis, row in numbers["axes"].items()
    ]
    trials = numbers["trials"]
    ended = f"{trials - numbers['not_ended']} of {trials} trials ended"
    title = f"Error of building a triangle, from {numbers['errors_from']}: {ended}"
    return TextTable(title, header, rows, [len(rows)])


def _statistics(signed: Array) -> dict[str, float | None]:
    size = np.abs(signed)
    if len(size) < 2:
        return dict.fromkeys(_STATISTICS)
    values = signed.mean(), size.mean(), size.std(ddof=1), np.percentile(size, 95), size.max()
    return dict(zip(_STATISTICS, map(float, values), strict=True))


_STATISTICS = ("bias_m", "mean_m", "standard_deviation_m", "p95_m", "maximum_m")


# --- Many triangles, and dead reckoning ---


def formation_table1(
    folder: Path,
    *,
    runs: int = 100,
    seed: int = 0,
    errors: StepErrors | None = None,
    plant_runs: int = 0,
) -> Numbers:
    """Writes table 1 of [FORM] and what belongs to it into a folder; returns all numbers.

    Files: `table1.json` (all), `table1.png`, `error_over_time.png` (Fig. 14), `error_by_robots.png`
    (Fig. 15), `error_by_side.png` (4.3).

    Args:
        folder: an existing one.
        runs: of each model on each path.
        seed: of the study.
        errors: of a triangle of 1.5 m; by default the paper's distribution.
        plant_runs: how many formations are simulated in the plant besides, closed loop, straight
            ahead for as many moves as path 2 has; 0 for none.

    Raises:
        ValueError: too few runs.
    """
    require(runs >= 2, "runs", runs, "2 or more")
    source = errors or FoldedNormalErrors()
    over_time: Numbers = {}
    numbers: Numbers = {
        "errors_from": PAPER_SOURCE if errors is None else type(errors).__name__,
        "runs": runs,
        "seed": seed,
        "period_s": DeadReckoningParameters().period,
        "table": table1(runs=runs, seed=seed, errors=source, over_time=over_time),
        "over_time": over_time,
        "robots": by_robots(runs=runs, seed=seed, errors=source),
        "sides": by_side(runs=runs, seed=seed, errors=source),
    }
    if plant_runs > 0:
        moves = numbers["table"]["triangles, sum"]["path 2"][0]["moves"]
        numbers["plant_runs"] = plant_runs
        numbers["closed_loop"] = {
            way: closed_loop_cell(
                closed_loop(folder / "runs" / name, way, moves=moves, runs=plant_runs)
            )
            for way, name in (("Algorithm I", "algorithm1"), ("ours", "ours"))
        }
    _write(folder / "table1.json", numbers)
    table = _table1_table(numbers)
    notes = _table1_notes(numbers, "Bold")
    plot_table(folder / "table1.png", table.title, table.header, table.rows, notes)
    plot_over_time(folder / "error_over_time.png", over_time)
    plot_robots(folder / "error_by_robots.png", numbers["robots"])
    plot_sides(folder / "error_by_side.png", numbers["sides"])
    return numbers


def _table1_table(numbers: Numbers) -> TextTable:
    header = ["mean error at the destination [m]"]
    header += [f"{path}, {speed:g} rad/s" for path in PATHS for speed in WHEEL_SPEEDS]
    rows: list[list[str]] = []
    for name, paths in numbers["table"].items():
        cells = [_printed(cell) for path in PATHS for cell in _for_each_speed(paths[path])]
        rows.append([name, *cells])
    for way, result in numbers.get("closed_loop", {}).items():
        rows.append([f"closed loop, {way}", "-", "-", _printed(result), "the same"])
    for name, by_path in PAPER.items():
        row = [f"{value:.2f}" for path in PATHS for value in by_path[path]]
        rows.append([f"paper: {name}", *row])
    return TextTable("Table 1", header, rows, [len(rows) - len(PAPER), len(PAPER)])


def _table1_notes(numbers: Numbers, mark: str) -> list[str]:
    """Returns what the table means; `mark` is what cells that begin with * are called."""
    moves = [numbers["table"]["triangles, sum"][path][0]["moves"] for path in PATHS]
    closed = []
    if "closed_loop" in numbers:
        closed = [
            f"closed loop: {numbers['plant_runs']} runs in the plant, straight ahead for "
            f"{moves[1]} moves. Algorithm I: the paper's way, camera and latency such that its "
            "triangles are as inexact as the paper's. ours: resection and estimator. Who does not "
            "arrive counts as broken."
        ]
    return [
        f"{numbers['runs']} runs; ± is the standard error of the mean. {mark}: within 15 % of the "
        "paper's (of triangles: of the mean of its two speeds).",
        f"Triangles: {moves[0]} and {moves[1]} moves at any speed, errors of each from "
        f"{numbers['errors_from']}. sum: added as if each triangle's orientation were known.",
        "chain: each triangle stands on displaced robots; mean over the runs that did not break "
        "(a side outside 0.6-1.6 of the nominal), and which part broke.",
        f"Dead reckoning sampled every {numbers['period_s']:g} s. gyro bias: an integrated bias of "
        f"the heading's rate of {math.degrees(GYRO_BIAS):g} deg/s (standard deviation), ours.",
        *closed,
    ]


def closed_loop_cell(records: list[Record]) -> Numbers:
    """Returns what came of closed loops: as of a chain, the mean over those that did not break."""
    paper = float(np.mean(PAPER["triangles"]["path 2"]))
    metrics = [record["metrics"] for record in records if record["outcome"] == "reached"]
    whole = [m["destination_error_m"] for m in metrics if not m["broken"]]
    return {**cell(np.array(whole), paper), "broken": 1 - len(whole) / len(records)}


def _for_each_speed(cells: list[Numbers]) -> list[Numbers]:
    return cells if len(cells) == len(WHEEL_SPEEDS) else [*cells, {}]


def _printed(cell: Numbers) -> str:
    if not cell:
        return "the same"
    if cell["mean_m"] is None:
        text = "-"
    else:
        text = f"{cell['mean_m']:.3f} ± {cell['standard_error_m']:.3f}"
    if "broken" in cell:
        text += f" ({100 * cell['broken']:.0f} % broke)"
    return f"*{text}" if cell["fits"] else text


def _scaled(value: float | None, factor: float, digits: int) -> str:
    return "-" if value is None else f"{factor * value:.{digits}f}"


def _write(path: Path, numbers: Numbers) -> None:
    path.write_text(json.dumps(numbers, indent=1, allow_nan=False) + "\n")


_MODELLED_FOR_A_RUN = 50  # runs of models for each run in the plant, which takes a minute

# --- By name, see `diagrams.model_studies` ---


def error_model_findings(folder: Path, runs: int) -> Findings:
    """Does `formation_error_model` and returns what to print of it."""
    return Findings(_error_model_table(formation_error_model(folder, trials=runs)), [])


def table1_findings(folder: Path, runs: int) -> Findings:
    """Does `formation_table1` and returns what to print of it."""
    numbers = formation_table1(folder, runs=runs, plant_runs=runs // _MODELLED_FOR_A_RUN)
    return Findings(_table1_table(numbers), _table1_notes(numbers, "*"))
