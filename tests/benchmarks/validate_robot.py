"""`make validate`: the whole navigation robot over many seeds; takes half an hour on two cores."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from diagrams.metrics import nees, pose_metrics
from diagrams.navigation import NavigationMission
from diagrams.run import Run, simulate
from diagrams.scenario import load_scenario
from diagrams.study import load_study, run_study
from diagrams.workers import Died, available_cores, work
from tests.benchmarks.table import Row, show

SEEDS = range(30)
ARENAS = 100
AVOIDERS = ("vfh_plus", "sector", "dwa")
DARK = (20.0, 5.0)  # s: no marker from, and for how long
CHI2_95_2D = 5.991


class Logged(NamedTuple):
    """What an estimator made of one log.

    Attributes:
        nees: mean over the run, per dimension.
        rmse: of the position, m.
        last_error: of the position at the end, m.
        last_inside: whether that is inside the 95 % ellipse.
    """

    nees: float
    rmse: float
    last_error: float
    last_inside: bool


def rows() -> Iterator[Row]:
    """Yields what was measured."""
    yield from estimator_rows()
    yield from arena_rows()


def estimator_rows() -> Iterator[Row]:
    """The robot drives by our filter; the paper's gets the same recordings."""
    runs = _both_filters(dark=False)
    ours, theirs = ([pair[k] for pair in runs] for k in range(2))
    a, b = (float(np.mean([one.nees for one in each])) for each in (ours, theirs))
    what = f"bundled robot, {len(SEEDS)} seeds"
    yield Row(f"{what}: NEES per dimension", f"{a:.2f}", "0.8 to 1.25", 0.8 <= a <= 1.25,
              f"the paper's: {b:.2f}")  # fmt: skip
    a, b = (float(np.sqrt(np.mean([one.rmse**2 for one in each]))) for each in (ours, theirs))
    yield Row(f"{what}: position RMSE", f"{1e3 * a:.1f} mm", "at most half the paper's",
              a <= b / 2, f"the paper's: {1e3 * b:.1f} mm")  # fmt: skip
    runs = _both_filters(dark=True)
    ours, theirs = ([pair[k] for pair in runs] for k in range(2))
    what = f"after {DARK[1]:g} s without a marker"
    a, b = (float(np.sqrt(np.mean([one.last_error**2 for one in each]))) for each in (ours, theirs))
    yield Row(f"{what}: position RMS", f"{100 * a:.1f} cm", "<= 10 cm", a <= 0.1,
              f"the paper's: {100 * b:.1f} cm")  # fmt: skip
    a, b = (float(np.mean([one.last_inside for one in each])) for each in (ours, theirs))
    yield Row(f"{what}: inside the 95 % ellipse", f"{a:.0%}", ">= 90 %", a >= 0.9,
              f"the paper's: {b:.0%}")  # fmt: skip


def arena_rows() -> Iterator[Row]:
    """Random rooms with each avoider."""
    sweep = f"avoider={','.join(AVOIDERS)}"
    with tempfile.TemporaryDirectory() as folder:
        study = load_study("navigation_random", ["sight=projected"], [sweep])
        records = run_study(study, runs=ARENAS, out=Path(folder) / "study")
    for variant in study.variants:
        mine = [record for record in records if record["variant"] == variant.name]
        reached = sum(record["succeeded"] for record in mine)
        contacts = sum(record["metrics"]["contacts"] for record in mine)
        done = [record["metrics"] for record in mine if record["succeeded"]]
        middle = {
            name: float(np.median([metrics[name] for metrics in done]))
            for name in ("time_to_goal_s", "path_length_m", "min_clearance_m", "mean_clearance_m",
                         "integrated_jerk")
        }  # fmt: skip
        ours = variant.name == "avoider=vfh_plus"
        yield Row(
            f"{ARENAS} random rooms, {variant.name}",
            f"{reached} reached, {contacts} contacts",
            ">= 98 reached, 0 contacts" if ours else "",
            (reached >= 98 and contacts == 0) if ours else None,
            ", ".join(f"{name} {value:.3g}" for name, value in middle.items()),
        )


def _both_filters(*, dark: bool) -> list[tuple[Logged, Logged]]:
    seed = partial(_seed, dark=dark)
    found = work(seed, SEEDS, workers=available_cores(), tasks_per_worker=10)
    results = [result for _, result in found]
    died = [result for result in results if isinstance(result, Died)]
    if died:
        raise RuntimeError(f"a run was killed: {died[0]}")
    return results


def _seed(seed: int, *, dark: bool) -> tuple[Logged, Logged]:
    """Drives by our filter, and plays the recording to the paper's."""
    start, duration = DARK
    fault = {"signal": "front_camera.detections", "kind": "silent", "start": start}
    changes = {"robot.faults": [fault], "duration": start + duration} if dark else {}
    with tempfile.TemporaryDirectory() as folder:
        base = {"sight": "projected", "seed": seed, **changes}
        ours = simulate(load_scenario("navigation", base), out=Path(folder))
        played = {**base, "recording": str(Path(folder) / "bag"), "estimator": "kf"}
        theirs = simulate(load_scenario("navigation", played))
    return _logged(ours), _logged(theirs)


def _logged(run: Run) -> Logged:
    assert isinstance(run.mission, NavigationMission)
    log = run.mission.pose_log(run.context)
    metrics = pose_metrics(log)
    error, covariance = log.errors()[-1:, :2], log.covariance[-1:, :2, :2]
    return Logged(
        float(metrics["nees_mean"] or np.nan),
        float(metrics["position_rmse_m"] or np.nan),
        float(np.hypot(*error[0])),
        bool(nees(error, covariance)[0] <= CHI2_95_2D),
    )


if __name__ == "__main__":
    raise SystemExit(0 if show("The robot over many seeds", rows()) else 1)
