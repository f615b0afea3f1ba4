"""The attitude filter: how exact on real recordings and how fast, `ahrs` beside it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

import ahrs
import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiscreteValues
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from systems.estimators.madgwick import Madgwick, Quaternion, madgwick_step, tilt_of
from tests.benchmarks.table import Row, show
from tests.recordings import FOLDER

Array = NDArray[np.float64]

BETA = 0.04
# Limit of the inclination's error, degrees.
RECORDINGS = {"02_undisturbed_slow_rotation_B": 0.65, "07_undisturbed_fast_rotation_B": 2.1}


def rows() -> Iterator[Row]:
    """Yields the measurements."""
    yield from recording_rows()
    yield from speed_rows()


def recording_rows() -> Iterator[Row]:
    """The recordings of BROAD, scored during the movement where the cameras saw the sensor."""
    for name, limit in RECORDINGS.items():
        path = FOLDER / "broad_imu" / f"{name}.mat"
        if not path.is_file():
            continue
        data = loadmat(path)
        gyro, accel, truth = data["imu_gyr"], data["imu_acc"], data["opt_quat"]
        gyro[~gyro.any(axis=1)] = 1e-12  # at exact zeros `ahrs` skips the sample
        dt = 1.0 / data["sampling_rate"].item()
        start = tilt_of(accel[0].tolist())
        ours = _ours(gyro[1:], accel[1:], dt, start)
        theirs = _theirs(gyro[1:], accel[1:], dt, start)
        scored = (data["movement"].ravel() == 1) & np.isfinite(truth).all(axis=1)
        a, b = (_inclination_rmse(found[scored], truth[scored]) for found in (ours, theirs))
        what = f"BROAD {name[:2]}, beta = {BETA:g}"
        yield Row(f"{what}: inclination RMSE", f"{a:.3f} deg", f"<= {limit:g} deg", a <= limit,
                  f"ahrs: {b:.3f} deg")  # fmt: skip
        apart = float((_rotations(ours).inv() * _rotations(theirs)).magnitude().max())
        yield Row(f"{what}: from ahrs at most", f"{apart:.1e} rad", "<= 1e-6 rad", apart <= 1e-6)


def speed_rows() -> Iterator[Row]:
    """Time of one update, one thread, least of interleaved runs over the same samples."""
    random = np.random.default_rng(1)
    n = 2000
    gyro, accel = random.normal(0, 1, (n, 3)), random.normal([0.0, 0.0, 9.8], 1, (n, 3))
    start = tilt_of(accel[0].tolist())
    times = np.array(
        [
            [
                _time(lambda: _ours(gyro, accel, 1 / 300, start)) / n,
                _time(lambda: _theirs(gyro, accel, 1 / 300, start)) / n,
                _block_time(gyro, accel),
            ]
            for _ in range(9)
        ]
    )
    ours, theirs, block = 1e6 * times.min(axis=0)
    yield Row("one update, numbers to numbers", f"{ours:.1f} us, 1/{theirs / ours:.0f} of ahrs'",
              "<= 1/5 of ahrs'", bool(5 * ours <= theirs), f"ahrs: {theirs:.1f} us")  # fmt: skip
    yield Row("one update of the block", f"{block:.1f} us, 1/{theirs / block:.1f} of ahrs'")


def _ours(gyro: Array, accel: Array, dt: float, q: Quaternion) -> Array:
    found = [q]
    for rate, force in zip(gyro.tolist(), accel.tolist(), strict=True):
        q = madgwick_step(q, rate, force, BETA, dt)
        found.append(q)
    return np.array(found)


def _theirs(gyro: Array, accel: Array, dt: float, start: Quaternion) -> Array:
    peer = ahrs.filters.Madgwick(gain_imu=BETA, Dt=dt)
    found = [np.array(start)]
    for rate, force in zip(gyro, accel, strict=True):
        found.append(peer.updateIMU(found[-1], rate, force))
    return np.array(found)


def _time(function: Callable[[], object]) -> float:
    started = time.perf_counter()
    function()
    return time.perf_counter() - started


def _block_time(gyro: Array, accel: Array) -> float:
    """Returns the time of an update of the block, input at hand, s: the middle of many."""
    times: list[float] = []

    class Timed(Madgwick):
        def _step(self, context: Context, discrete_state: DiscreteValues) -> None:
            started = time.perf_counter()
            super()._step(context, discrete_state)
            times.append(time.perf_counter() - started)

    block = Timed()
    simulator = Simulator(block)
    context = simulator.get_mutable_context()
    for k, sample in enumerate(np.hstack([gyro, accel])[:300]):
        block.imu_input_port().FixValue(context, sample)
        simulator.AdvanceTo((k + 0.5) / 300.0)
    return float(np.median(times[1:]))


def _rotations(q: Array) -> Rotation:
    return Rotation.from_quat(np.roll(q, -1, axis=1))


def _inclination_rmse(found: Array, truth: Array) -> float:
    """Returns the root mean square of the angle between two ideas of up, degrees."""
    u, v = (_rotations(q).inv().apply([0.0, 0.0, 1.0]) for q in (found, truth))
    angle = np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), (u * v).sum(axis=1))
    return math.degrees(float(np.sqrt(np.mean(angle**2))))


if __name__ == "__main__":
    show("Attitude filter", rows())
