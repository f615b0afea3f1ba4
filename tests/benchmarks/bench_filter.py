"""The planar filters: how exact, honest and fast; the paper's beside ours, on the same logs."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiscreteValues

from systems.estimators.planar_ekf import PlanarEkf
from systems.estimators.planar_kalman import PlanarKalmanFilter
from systems.messages import PoseEstimate
from tests.benchmarks.table import Row, show
from tests.planar_log import RATE, PlanarLog, Result, Truth, arcs, drive, estimate, listen

Array = NDArray[np.float64]

SEEDS = range(30)
DARK = 24.9  # s; the last picture, then 0.2 m/s for 5 s
SEEN = slice(20, round(DARK * RATE))  # from the first fix on


def rows() -> Iterator[Row]:
    """Yields the measurements."""
    yield from accuracy_rows()
    yield from learning_rows()
    yield from speed_rows()


def accuracy_rows() -> Iterator[Row]:
    """Thirty drives of 30 s on arcs, the last 5 s without a picture."""
    logs, ours, theirs = [], [], []
    for seed in SEEDS:
        command = np.vstack([arcs(25.0, seed), arcs(5.0, seed + 100, speed=0.2)])
        log = drive(command, seed, dark=(DARK, math.inf))
        a, b = listen(log, PlanarEkf(), PlanarKalmanFilter())
        logs.append(log)
        ours.append(a)
        theirs.append(b)

    def both(function: object) -> tuple[float, float]:
        return function(ours), function(theirs)  # type: ignore[operator]

    def nees(results: list[Result]) -> float:
        return float(
            np.mean([r.nees(log)[SEEN].mean() for r, log in zip(results, logs, strict=True)])
        )

    def errors(results: list[Result], where: slice) -> Array:
        return np.vstack([r.errors(log)[where] for r, log in zip(results, logs, strict=True)])

    a, b = both(nees)
    what = f"{len(SEEDS)} drives of {DARK:g} s"
    yield Row(f"{what}: NEES per dimension", f"{a:.2f}", "0.8 to 1.25", 0.8 <= a <= 1.25,
              f"the paper's: {b:.2f}")  # fmt: skip
    a, b = both(lambda results: float(np.mean([r.nis.mean() for r in results])))
    yield Row(f"{what}: NIS per dimension", f"{a:.2f}", "0.8 to 1.25", 0.8 <= a <= 1.25,
              f"the paper's: {b:.2f}")  # fmt: skip
    a, b = both(lambda results: _rms_position(errors(results, SEEN)))
    yield Row(f"{what}: position RMSE", f"{1e3 * a:.1f} mm", "at most half the paper's",
              a <= b / 2, f"the paper's: {1e3 * b:.1f} mm")  # fmt: skip
    a, b = both(lambda results: math.degrees(_rms(errors(results, SEEN)[:, 2])))
    yield Row(f"{what}: heading RMSE", f"{a:.2f} deg", "at most half the paper's", a <= b / 2,
              f"the paper's: {b:.2f} deg")  # fmt: skip
    a, b = both(lambda results: _rms_position(errors(results, slice(-1, None))))
    what = "after 5 s without a marker at 0.2 m/s"
    yield Row(f"{what}: position RMS", f"{100 * a:.1f} cm", "<= 10 cm", a <= 0.10,
              f"the paper's: {100 * b:.1f} cm")  # fmt: skip
    a, b = both(lambda results: _inside(results, logs))
    yield Row(f"{what}: inside the 95 % ellipse", f"{a:.0%}", ">= 90 %", a >= 0.9,
              f"the paper's: {b:.0%}")  # fmt: skip


def learning_rows() -> Iterator[Row]:
    """A gyro that is off by 0.05 rad/s and wheels by 5 %, after 30 s."""
    found = []
    for seed in SEEDS[:10]:
        truth = Truth(bias=0.05, scale=1.05, bias_walk=0.0, scale_walk=0.0)
        (result,) = listen(drive(arcs(30.0, seed), seed, truth), PlanarEkf())
        block, context = result.block, result.context
        found.append([block.gyro_bias(context)[0], block.wheel_scale(context)[0]])
    error = np.abs(np.array(found) - [0.05, 1.05]).max(axis=0)
    yield Row("gyro bias of 0.05 rad/s, worst of 10 drives of 30 s", f"off by {error[0]:.4f} rad/s",
              "<= 0.005", bool(error[0] <= 0.005))  # fmt: skip
    yield Row("wheel scale of 1.05, likewise", f"off by {100 * error[1]:.1f} %", "<= 1.5 %",
              bool(error[1] <= 0.015))  # fmt: skip


def speed_rows() -> Iterator[Row]:
    """Time of one update of the block, in Python, inputs at hand."""
    ours, theirs = _update_times(PlanarEkf), _update_times(PlanarKalmanFilter)
    for name, k, limit in (("nothing new", 0, 60.0), ("a picture 60 ms late", 1, 500.0)):
        a, b = 1e6 * ours[k], 1e6 * theirs[k]
        yield Row(f"one update, {name}", f"{a:.0f} us", f"<= {limit:g} us", bool(a <= limit),
                  f"the paper's: {b:.0f} us")  # fmt: skip


def _update_times(kind: type) -> tuple[float, float]:
    """Returns the time of an update without a new picture and with one, s: least of five runs."""
    runs = []
    for _ in range(5):
        times: list[float] = []

        class Timed(kind):  # type: ignore[misc, valid-type]
            def _step(
                self,
                context: Context,
                discrete_state: DiscreteValues,
                times: list[float] = times,
            ) -> None:
                started = time.perf_counter()
                super()._step(context, discrete_state)
                times.append(time.perf_counter() - started)  # fmt: skip

        block = Timed()
        simulator = Simulator(block)
        context = simulator.get_mutable_context()
        block.command_input_port().FixValue(context, [0.2, 0.1])
        block.imu_input_port().FixValue(context, [0.0, 0.0, 0.1, 0.0, 0.0, 9.81])
        block.marker_alternative_input_port().FixValue(context, PoseEstimate())
        block.marker_pose_input_port().FixValue(context, PoseEstimate())
        new = np.arange(600) % 7 == 6
        for k, arrives in enumerate(new):
            if arrives:
                seen = estimate([0.002 * k, 0.0, 0.0], 1e-2 * np.eye(3), k / RATE - 0.06)
                block.marker_pose_input_port().FixValue(context, seen)
            simulator.AdvanceTo((k + 0.5) / RATE)
        runs.append(times)
    least = np.min(runs, axis=0)[100:]
    return float(np.median(least[~new[100:]])), float(np.median(least[new[100:]]))


def _inside(results: list[Result], logs: list[PlanarLog]) -> float:
    """Returns the part of the drives that ended inside the 95 % ellipse of the position."""
    inside = []
    for result, log in zip(results, logs, strict=True):
        e, P = result.errors(log)[-1, :2], result.covariance[-1, :2, :2]
        inside.append(e @ np.linalg.solve(P, e) <= 5.991)
    return float(np.mean(inside))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _rms_position(errors: Array) -> float:
    return math.sqrt(2) * _rms(errors[:, :2])


if __name__ == "__main__":
    show("Planar filters", rows())
