"""Models of a formation's errors: how near the paper's table 1, and how many runs a second."""

from __future__ import annotations

import time
from collections.abc import Iterator

from diagrams.formation_table import FITS, PATHS, table1
from systems.formation.error_models import FoldedNormalErrors
from tests.benchmarks.table import Row, show

RUNS = 10_000
TO_REACH = 1000  # runs a second
SIZES = (100, 1000)  # runs at once


def rows() -> Iterator[Row]:
    """Yields the measurements."""
    yield from table_rows()
    yield from speed_rows()


def table_rows() -> Iterator[Row]:
    """Mean errors of 10,000 runs against the paper's; goals where it states the model."""
    numbers = table1(runs=RUNS, seed=0, errors=FoldedNormalErrors())
    for name, paths in numbers.items():
        for path in PATHS:
            for cell in paths[path]:
                speed = cell.get("wheel_speed_rad_s")
                what = f"{name}, {path}" + (f", {speed:g} rad/s" if speed else "")
                goal = name == "triangles, sum" or (name == "dead reckoning" and speed == 5.8)
                mean = cell["mean_m"]
                value = "nobody arrived" if mean is None else f"{mean:.3f} m"
                if mean is not None:
                    value += f" ({100 * (cell['ratio'] - 1):+.1f} %)"
                if "broken" in cell:
                    value += f", {100 * cell['broken']:.1f} % broken"
                yield Row(
                    what,
                    value,
                    f"within {100 * FITS:.0f} %" if goal else "",
                    bool(cell["fits"]) if goal else None,
                    f"paper: {cell['paper_m']:.3f} m",
                )


def speed_rows() -> Iterator[Row]:
    """Runs of the whole table a second, each of all models, paths and speeds; one thread."""
    table1(runs=2, seed=0, errors=FoldedNormalErrors())
    least = dict.fromkeys(SIZES, float("inf"))
    for _ in range(5):
        for runs in SIZES:
            started = time.perf_counter()
            table1(runs=runs, seed=0, errors=FoldedNormalErrors())
            least[runs] = min(least[runs], time.perf_counter() - started)
    for runs, seconds in least.items():
        rate = runs / seconds
        models = 14 * rate  # 2 of dead reckoning at 2 speeds, 3 of triangles, on 2 paths
        yield Row(f"table 1, {runs} runs at once",
                  f"{rate:.0f} runs/s, {models:.0f} of one model",
                  f">= {TO_REACH} runs/s", rate >= TO_REACH)  # fmt: skip


if __name__ == "__main__":
    show("Models of a formation's errors", rows())
