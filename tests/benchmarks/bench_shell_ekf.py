"""The filter on the shell: how exact, honest and fast; the paper's rule beside it.

Ten drives of the paper's routine under projected sight, the same logs for both; five iterations
unless said otherwise.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from systems.estimators.shell_rule import ShellRule
from tests.benchmarks.table import Row, show
from tests.shell_log import (
    BASE,
    HARSH,
    RATE,
    Result,
    ShellLog,
    drive,
    ekf,
    listen,
)
from tests.systems.shell.shell_world import HEIGHT, RADIUS

Array = NDArray[np.float64]

SEEDS = range(10)
ITERATIONS = 5
_EVENLY = 1 / math.sqrt(3)
# What the filter is told of the harsh errors: their bounds.
HARSH_BOUNDS = {
    "placement_std": HARSH.placement * _EVENLY,
    "mounting_std": HARSH.mounting * _EVENLY,
    "scale_std": HARSH.scale * _EVENLY,
    "rock_std": HARSH.rock * _EVENLY,
}


def rows() -> Iterator[Row]:
    """Yields the measurements."""
    yield from base_rows()
    yield from harsh_rows()
    yield from dark_rows()
    yield from speed_rows()


def base_rows() -> Iterator[Row]:
    """The base errors, and the rule with and without the camera's mounting calibrated."""
    ours, nees, rule, calibrated = [], [], [], []
    for seed in SEEDS:
        log = drive.__wrapped__(seed, BASE, ITERATIONS)
        result = listen(log, ekf(), 15).after(log.second)
        ours.append(np.degrees(result.errors))
        nees.append(float(result.nees().mean()))
        rule.append(_rule_errors(log))
        calibrated.append(_rule_errors(_with_mounting_known(log)))
    errors = np.concatenate(ours)
    rmse, theirs, known = (_rmse(np.concatenate(e)) for e in (ours, rule, calibrated))
    what = f"base errors, {len(SEEDS)} seeds"
    yield Row(f"{what}: RMSE by axis", _three(rmse), "<= 0.35 deg", bool((rmse <= 0.35).all()),
              f"the rule: {_three(theirs)}")  # fmt: skip
    p95, most = np.percentile(np.abs(errors), 95, axis=0), float(np.abs(errors).max())
    yield Row(f"{what}: P95 by axis", _three(p95), "<= 0.8 deg", bool((p95 <= 0.8).all()))
    yield Row(f"{what}: largest", f"{most:.2f} deg", "<= 2 deg", most <= 2.0)
    ratio = float(np.linalg.norm(rmse) / np.linalg.norm(theirs))
    yield Row(f"{what}: RMSE by the rule's", f"{ratio:.2f}", "<= 0.3", ratio <= 0.3)
    ratio = float(np.linalg.norm(rmse) / np.linalg.norm(known))
    yield Row(f"{what}: RMSE by the rule's with the mounting known", f"{ratio:.2f}", "<= 0.6",
              ratio <= 0.6, f"the rule: {_three(known)}")  # fmt: skip
    mean = float(np.mean(nees))
    yield Row(f"{what}: NEES per dimension", f"{mean:.2f}", "0.8 to 1.25", 0.8 <= mean <= 1.25)


def harsh_rows() -> Iterator[Row]:
    """The harsh errors."""
    ours, nees = [], []
    for seed in SEEDS:
        log = drive.__wrapped__(seed, HARSH, ITERATIONS)
        result = listen(log, ekf(**HARSH_BOUNDS), 15).after(log.second)
        ours.append(np.degrees(result.errors))
        nees.append(float(result.nees().mean()))
    rmse, most = _rmse(np.concatenate(ours)), float(np.abs(np.concatenate(ours)).max())
    what = f"harsh errors, {len(SEEDS)} seeds"
    yield Row(f"{what}: RMSE by axis", _three(rmse), "<= 0.8 deg", bool((rmse <= 0.8).all()))
    yield Row(f"{what}: largest", f"{most:.2f} deg", "<= 5 deg", most <= 5.0)
    yield Row(f"{what}: NEES per dimension", f"{np.mean(nees):.2f}")


def dark_rows() -> Iterator[Row]:
    """No marker for a quarter of the routine, in one iteration."""
    most, inside = [], []
    for seed in SEEDS:
        log = drive.__wrapped__(seed, replace(BASE, dark=(0.6, 0.85)), 1)
        result = listen(log, ekf(), 15).after(log.second)
        most.append(float(np.degrees(np.abs(result.errors)).max()))
        inside.append(float((3 * result.nees() <= 7.815).mean()))  # chi-square, 95 %
    yield Row("no marker for a quarter of the routine: largest", f"{max(most):.2f} deg", "<= 2 deg",
              max(most) <= 2.0)  # fmt: skip
    part = float(np.mean(inside))
    yield Row("likewise: inside the 95 % ellipsoid", f"{part:.0%}", ">= 90 %", part >= 0.9)


def speed_rows() -> Iterator[Row]:
    """Real-time factor of the block alone, in Python, inputs at hand."""
    log, least = drive(0, BASE, 1), math.inf
    for _ in range(3):
        started = time.perf_counter()
        listen(log, ekf(), 10**9)
        least = min(least, time.perf_counter() - started)
    factor = len(log.R) / RATE / least
    yield Row("simulated by wall time, 300 Hz with 60 pictures a second", f"{factor:.1f}")


def _with_mounting_known(log: ShellLog) -> ShellLog:
    """Returns the log as if the rule's marker poses had been made with the true mounting."""
    turned = RotationMatrix(Rotation.from_rotvec(log.mounting).as_matrix())
    arm = np.array([0.0, 0.0, 0.010 - HEIGHT])
    off = RigidTransform(turned, arm - turned.multiply(arm))
    markers = {k: replace(told, pose=told.pose @ off.inverse()) for k, told in log.markers.items()}
    return replace(log, markers=markers)


def _rule_errors(log: ShellLog) -> Array:
    result: Result = listen(log, ShellRule(radius=RADIUS, height=HEIGHT), 15)
    return np.asarray(np.degrees(result.after(log.second).errors))


def _rmse(errors: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(errors**2, axis=0)))


def _three(values: Array) -> str:
    return "/".join(f"{value:.2f}" for value in values) + " deg"


if __name__ == "__main__":
    show("Filter on the shell", rows())
