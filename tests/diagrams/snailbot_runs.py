"""Short runs of a robot on a shell, and what is asked of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagrams.run import Run, simulate
from diagrams.scenario import load_scenario
from diagrams.shell_metrics import ShellLog

Array = NDArray[np.float64]

# 60 degrees up from the equator, over markers of three rings.
CLIMB = "team=[{route: [{roll_deg: 0, pitch_deg: 0, yaw_deg: 0, arc_deg: 60}]}]"
# On over the pole.
FAR = CLIMB.replace("60", "180")


def run(*overrides: str, name: str = "snailbot", out: Path | None = None) -> Run:
    """Simulates under projected sight, unless the overrides want another."""
    return simulate(load_scenario(name, ["sight=projected", *overrides]), out=out)


def fault(signal: str, kind: str, start: float, duration: float = np.inf) -> str:
    """The override that lets a signal fail from `start` for `duration` (s)."""
    lasts = f", duration: {duration}" if np.isfinite(duration) else ""
    return f"robot.faults=[{{signal: {signal}, kind: {kind}, start: {start}{lasts}}}]"


def log_of(finished: Run, robot: int = 0) -> ShellLog:
    """What was true of a robot of the team and what was estimated."""
    mission: Any = finished.mission
    log = mission.shell_log(finished.context, mission.robots[robot])
    assert isinstance(log, ShellLog)
    return log


def errors(log: ShellLog) -> Array:
    """(n,) size of the estimate's error, deg."""
    return np.asarray(np.linalg.norm(log.errors(), axis=1))


def deviations(log: ShellLog) -> Array:
    """(n,) what the estimate says of it: the root of its mean square, deg."""
    return np.degrees(np.sqrt(np.trace(log.covariance[:, :3, :3], axis1=1, axis2=2)))


def at(log: ShellLog, t: float) -> int:
    """The index of the sample of time t (s)."""
    index = int(np.argmin(np.abs(log.t - t)))
    assert abs(log.t[index] - t) < 0.011
    return index
