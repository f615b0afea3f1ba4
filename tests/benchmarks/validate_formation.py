"""`make validate`: formations that cross 30 m in 40 moves, closed loop; takes an hour on two cores.

Options say how many runs of each kind, and where what is done is kept: the same command then goes
on where it was interrupted.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from diagrams.formation_closed_loop import PAPERS_WAY
from diagrams.study import load_study, run_study
from tests.benchmarks.table import Row, show

MOVES = 40
# Straight ahead of the formation: each move takes it half a side of 1.5 m on.
BASE = (
    "sight=projected",
    "destination=[32.25, 0.65]",
    "world.arena.ground=80.0",
    "duration=6000.0",
)


@dataclass(frozen=True)
class Kind:
    """What is run, and what is asked of it.

    Attributes:
        name: in the table.
        overrides: of the scenario.
        asked: whether it is to reach anything: never broken, and at most 0.10 m off.
        consistent: whether it is to be as wrong as it says.
    """

    name: str
    overrides: tuple[str, ...]
    asked: bool
    consistent: bool = False


TWIN = Kind("ours, kinematic twin", (*BASE, "dynamics=kinematic"), True, consistent=True)
PLANT = Kind("ours, plant", BASE, True)
EXACT = Kind("... robots as they are said to be", (*TWIN.overrides, "errors=none"), True)
# What no mean takes away, and what is not known at the start, are not in that simulation.
TOLD = Kind(
    "... and the estimator is told so",
    (
        *EXACT.overrides,
        "estimator.corner_floor=0",
        "estimator.bearing_floor=1e-5",
        "estimator.range_floor=1e-4",
        "estimator.yaw_error=1e-5",
        "estimator.start_position_noise=1e-4",
        "estimator.start_heading_noise=1e-4",
    ),
    False,
)
PAPER = Kind(
    "the paper's way with its errors, twin",
    (*BASE, "dynamics=kinematic", "duration=3000.0", *PAPERS_WAY),
    False,
)


def rows(kind: Kind, records: list[dict[str, Any]]) -> Iterator[Row]:
    """Yields what came of the runs of a kind.

    A run that did not end at its destination has no error there; how runs ended is beside. Broken
    is what is so by the true sides, whatever the robots believed.
    """
    n = len(records)
    what = f"{kind.name}, {n} runs"
    broken = sum(bool(record.get("metrics", {}).get("broken")) for record in records)
    reached = [record["metrics"] for record in records if record["outcome"] == "reached"]
    ends = sorted({record["outcome"] for record in records})
    counts = ", ".join(f"{sum(r['outcome'] == end for r in records)} {end}" for end in ends)
    sound = broken == 0 and len(reached) == n
    yield Row(
        f"{what}: broken", f"{broken}", "0" if kind.asked else "", sound if kind.asked else None,
        counts,
    )  # fmt: skip
    moves = np.median([record["metrics"]["moves"] for record in records if "metrics" in record])
    yield Row(f"{what}: moves, median", f"{moves:g}", f"{MOVES}" if kind.asked else "",
              bool(moves == MOVES) if kind.asked else None)  # fmt: skip
    if not reached:
        return
    errors = np.array([metrics["destination_error_m"] for metrics in reached])
    rms = float(np.sqrt(np.mean(errors**2)))
    yield Row(f"{what}: error at the destination, RMS", f"{rms:.3f} m",
              "<= 0.100 m" if kind.asked else "", rms <= 0.1 if kind.asked else None,
              f"median {np.median(errors):.3f}, largest {errors.max():.3f}")  # fmt: skip
    sides = max(metrics["side_error_max_m"] for metrics in reached)
    yield Row(f"{what}: side, largest error", f"{1e3 * sides:.1f} mm")
    each = [metrics["nees_mean"] for metrics in reached if metrics["nees_mean"] is not None]
    if each:
        nees, asked = float(np.mean(each)), kind.consistent
        yield Row(f"{what}: NEES per dimension", f"{nees:.2f}", "0.8 to 1.25" if asked else "",
                  0.8 <= nees <= 1.25 if asked else None)  # fmt: skip
    factor = np.median([r["sim_seconds"] / r["wall_seconds"] for r in records if "metrics" in r])
    yield Row(f"{what}: real-time factor, median", f"{factor:.1f}")


def measure(kind: Kind, runs: int, out: Path, workers: int | None) -> Iterator[Row]:
    """Does the runs that the folder lacks and yields what came of all."""
    study = load_study("formation", list(kind.overrides), [])
    yield from rows(kind, run_study(study, runs=runs, out=out, workers=workers))


def main() -> bool:
    """Runs what the command line asks for; returns whether all that is asked was reached."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=100, help="of ours on the twin (100)")
    parser.add_argument("--plant-runs", type=int, default=5, help="of ours in the plant (5)")
    parser.add_argument("--exact-runs", type=int, default=20, help="of robots without errors (20)")
    parser.add_argument("--told-runs", type=int, default=10, help="... and who knows it (10)")
    parser.add_argument("--paper-runs", type=int, default=20, help="of the paper's way (20)")
    parser.add_argument("--workers", type=int, help="processes (one for each core)")
    parser.add_argument("--out", type=Path, help="folder that keeps what is done")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        out = options.out or Path(folder)
        wanted = (
            (TWIN, options.runs, "twin"),
            (PLANT, options.plant_runs, "plant"),
            (EXACT, options.exact_runs, "exact"),
            (TOLD, options.told_runs, "told"),
            (PAPER, options.paper_runs, "paper"),
        )
        found = (
            row
            for kind, runs, name in wanted
            if runs > 0
            for row in measure(kind, runs, out / name, options.workers)
        )
        return show(f"Formations over {MOVES} moves", found)


if __name__ == "__main__":
    raise SystemExit(0 if main() else 1)
