"""`make validate`: four trackers replay circuits by what a camera sees; minutes on two cores."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from diagrams.workers import Died, available_cores, work
from systems.controllers.kanayama import Kanayama
from systems.controllers.mpc import Mpc
from systems.controllers.path_tracking import PathTracker
from systems.controllers.pure_pursuit import PurePursuit
from systems.controllers.tvlqr import Tvlqr
from systems.estimators.planar_ekf import PlanarEkf
from tests.benchmarks.table import Row, show
from tests.replay_bound import least_covariance
from tests.replay_world import Truth, circuit, replay

CIRCUITS = range(20)
TRACKERS: dict[str, Callable[..., PathTracker]] = {
    "kanayama": Kanayama,
    "pure_pursuit": PurePursuit,
    "tvlqr": Tvlqr,
    "mpc": Mpc,
}
PLAIN = Truth()
HARSH = Truth(slip=0.1, yaw_noise=0.3)
# Condition: what is wrong, the largest RMSE and the largest distance from the route allowed (m).
CONDITIONS = {
    "5 % slip, 0.1 rad/s": (PLAIN, 0.01, 0.03),
    "10 % slip, 0.3 rad/s": (HARSH, 0.017, 0.05),
    "5 % slip, 0.1 rad/s, 3 s blind": (Truth(blind=(10.0, 13.0)), 0.017, 0.05),
    "10 % slip, 0.3 rad/s, 3 s blind": (
        Truth(slip=0.1, yaw_noise=0.3, blind=(10.0, 13.0)), 0.017, 0.05,
    ),
}  # fmt: skip
NO_SIGHT = (0.15, float("inf"))  # after the first fix


class Lap(NamedTuple):
    """What one circuit gave.

    Attributes:
        rmse: of the true robot's distance from the route, m.
        most: of it, m.
        nees: of the estimate, by dimension.
        nis: of the pictures, by degrees of freedom.
        lost: error of the position at the end of a blind stretch, m; NaN without one.
        least: its deviation where dead reckoning is as good as it can be, m.
    """

    rmse: float
    most: float
    nees: float
    nis: float
    lost: float
    least: float


def rows() -> Iterator[Row]:
    """Yields what was measured."""
    yield from tracking_rows()
    yield from odometry_rows()
    yield from speed_rows()


def tracking_rows() -> Iterator[Row]:
    """Each tracker under each condition: the worst circuit counts."""
    for what, (truth, rmse, most) in CONDITIONS.items():
        all_laps: list[Lap] = []
        for name in TRACKERS:
            laps = _laps(name, truth)
            all_laps += laps
            a, b = max(lap.rmse for lap in laps), max(lap.most for lap in laps)
            yield Row(
                f"{what}: {name}, worst of {len(laps)} circuits",
                f"RMSE {100 * a:.2f} cm, max {100 * b:.1f} cm",
                f"<= {100 * rmse:g} cm, <= {100 * most:g} cm",
                a <= rmse and b <= most,
                f"RMSE over all {100 * np.sqrt(np.mean([lap.rmse**2 for lap in laps])):.2f} cm",
            )
        nees, nis = np.mean([(lap.nees, lap.nis) for lap in all_laps], axis=0)
        yield Row(f"{what}: NEES and NIS per dimension", f"{nees:.2f}, {nis:.2f}",
                  "0.8 to 1.25", bool(0.8 <= nees <= 1.25 and 0.8 <= nis <= 1.25))  # fmt: skip
        if np.isfinite(truth.blind[1]):
            lost, least = np.sqrt(np.mean([(a.lost**2, a.least**2) for a in all_laps], axis=0))
            yield Row(
                f"{what}: position at the end of it, RMS", f"{100 * lost:.1f} cm", "", None,
                f"least, by an oracle of the slip at its beginning: {100 * least:.1f} cm",
            )  # fmt: skip


def odometry_rows() -> Iterator[Row]:
    """The same without any sight after the first: what the tags are for."""
    for what, gyro in (("odometry and gyro, no sight", True), ("odometry alone, no sight", False)):
        laps = _laps("tvlqr", Truth(blind=NO_SIGHT, gyro=gyro))
        each = 100 * np.array([lap.rmse for lap in laps])
        yield Row(
            f"{what}: {len(laps)} circuits", f"RMSE {each.min():.0f} to {each.max():.0f} cm, "
            f"median {np.median(each):.0f} cm",
        )  # fmt: skip


def speed_rows() -> Iterator[Row]:
    """Time of a command, of a picture's way to a pose, and of the filter's update with it."""
    world = circuit(0)
    for name, kind in TRACKERS.items():
        times: list[float] = []
        replay(world, _timed(kind, "_step", times)(route=world.route), truth=HARSH, duration=10.0)
        yield Row(f"one command of {name}", f"{1e6 * np.median(times):.0f} us",
                  "", None, f"slowest {1e3 * np.max(times):.1f} ms")  # fmt: skip
    times = []
    original = PlanarEkf._step
    PlanarEkf._step = _timed(PlanarEkf, "_step", times)._step  # type: ignore[method-assign]
    try:
        replay(world, Kanayama(route=world.route), truth=PLAIN, duration=10.0)
    finally:
        PlanarEkf._step = original  # type: ignore[method-assign]
    with_picture = np.sort(times[100:])[-len(times[100:]) // 10 :]  # one tick in ten has one
    took = 1e3 * float(np.median(with_picture))
    yield Row("filter update, picture to pose included", f"{took:.2f} ms", "<= 1 ms", took <= 1.0)


def _laps(name: str, truth: Truth) -> list[Lap]:
    found = work(
        partial(_lap, name=name, truth=truth), CIRCUITS, workers=available_cores(),
        tasks_per_worker=20,
    )  # fmt: skip
    laps = [lap for _, lap in found]
    died = [lap for lap in laps if isinstance(lap, Died)]
    if died:
        raise RuntimeError(f"a run was killed: {died[0]}")
    return laps


def _lap(seed: int, *, name: str, truth: Truth) -> Lap:
    world = circuit(seed)
    drive = replay(world, TRACKERS[name](route=world.route), truth=truth, seed=seed)
    off = drive.cross_track(world.route, every=5)
    lost = least = float("nan")
    if np.isfinite(truth.blind[1]):
        k = int(np.searchsorted(drive.t, truth.blind[1] - 1e-9))
        lost = float(np.linalg.norm((drive.estimate - drive.pose)[k, :2]))
        least = float(np.sqrt(np.trace(least_covariance(drive, truth))))
    return Lap(
        float(np.sqrt(np.mean(off**2))), float(np.abs(off).max()), float(drive.nees().mean()),
        float(drive.nis.mean()) if len(drive.nis) else float("nan"), lost, least,
    )  # fmt: skip


def _timed(kind: type, method: str, times: list[float]) -> type:
    """Returns the class with a method that notes how long it takes."""
    inner = getattr(kind, method)

    def timed(self: object, *arguments: object) -> object:
        started = time.perf_counter()
        result = inner(self, *arguments)
        times.append(time.perf_counter() - started)
        return result

    return type(kind.__name__, (kind,), {method: timed})


if __name__ == "__main__":
    raise SystemExit(0 if show("Replay of circuits", rows()) else 1)
