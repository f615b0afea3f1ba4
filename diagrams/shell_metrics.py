"""How good an estimate of the pose on a shell was, from logs.

Errors are rotation vectors in frame R of the shell, `R_estimate = exp([phi]x) R_true`. Their
components x, y, z are reported as roll, pitch and yaw: where pitch and yaw are 0 those are the axes
that the three angles turn about (pitch about -y). Elsewhere they are not, and at the poles yaw and
roll are not separate; errors of this kind mean the same everywhere. The paper's own differences of
angles are given beside them in its table, see `diagrams.shell_table`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diagrams.metrics import NEES_BOUNDS, nees
from systems.shell.angles import angle_differences, angles_defined, rotation_error

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

AXES = ("roll", "pitch", "yaw")
OUTLIER = 15.0  # deg
_FIRST_SCORED = 2  # markers met: one alone leaves its own misplacement in the whole estimate

NAMES = (
    *(f"{axis}_rmse_deg" for axis in AXES),
    "max_error_deg",
    "p95_error_deg",
    "outlier_rate_15deg",
    "nees_mean",
    "nees_in_bounds",
    "marker_visible_fraction",
    "position_rmse_m",
    "start_rmse_deg",
    "scored_from_s",
)


@dataclass(frozen=True, eq=False)
class ShellLog:
    """Truth and estimate at common times, in frame R of the shell.

    Attributes:
        t: (n,) s, ascending.
        R: (n, 3, 3) true `R_RB`.
        p: (n, 3) true `p_RB`, m.
        R_estimate: (n, 3, 3).
        p_estimate: (n, 3) m.
        covariance: (n, 6, 6) of the estimate, rotation first, a rotation vector in R (rad, m).
        iteration: (n,) which iteration of the routine; what comes after the last one (such as the
            turn back) belongs to it.
        visible: (n,) whether the latest picture showed a marker of the map.
        markers_met: (n,) number of different markers that pictures have shown.
    """

    t: Array
    R: Array
    p: Array
    R_estimate: Array
    p_estimate: Array
    covariance: Array
    iteration: NDArray[np.int64]
    visible: Mask
    markers_met: NDArray[np.int64]

    def scored(self) -> Mask:
        """Returns (n,) what is scored: all from the second marker on."""
        return np.maximum.accumulate(self.markers_met >= _FIRST_SCORED)

    def errors(self) -> Array:
        """Returns (n, 3) deg, the estimate's rotation vector away from the truth, in R."""
        return np.degrees(rotation_error(self.R_estimate, self.R))

    def angle_errors(self) -> tuple[Array, Mask]:
        """Returns the paper's differences of [roll, pitch, yaw] (n, 3) deg, and where they mean it.

        That is where the truth is farther than 10 degrees from the poles, wherever the estimate is.
        """
        return np.degrees(angle_differences(self.R_estimate, self.R)), angles_defined(self.R)


def shell_metrics(log: ShellLog) -> dict[str, float | None]:
    """Returns the metrics of an estimate on a shell, by `NAMES`; None where nothing can be said.

    All are of the scored part, but `marker_visible_fraction` (of the whole run) and
    `start_rmse_deg` (of the part before it, the norm of all three components).

    `max_error_deg` and `p95_error_deg` are those of the worst axis, `outlier_rate_15deg` counts
    samples with any axis above 15 deg, or no number. `nees_mean` is that of the rotation per
    dimension (1 is right; infinite for whoever claims to be certain), `nees_in_bounds` the part of
    the samples inside the two-sided 95 % bounds; infinite covariances claim nothing and are left
    out of both.
    """
    metrics: dict[str, float | None] = dict.fromkeys(NAMES)
    if not len(log.t):
        return metrics
    scored = log.scored()
    errors = log.errors()
    metrics["marker_visible_fraction"] = float(log.visible.mean())
    if not scored.all():
        metrics["start_rmse_deg"] = float(np.sqrt((errors[~scored] ** 2).sum(axis=1).mean()))
    if not scored.any():
        return metrics
    metrics["scored_from_s"] = float(log.t[scored][0])
    errors = errors[scored]
    for axis, rmse in zip(AXES, np.sqrt((errors**2).mean(axis=0)), strict=True):
        metrics[f"{axis}_rmse_deg"] = float(rmse)
    worst = np.abs(errors).max(axis=1)
    metrics["max_error_deg"] = float(worst.max())
    metrics["p95_error_deg"] = float(np.percentile(np.abs(errors), 95, axis=0).max())
    metrics["outlier_rate_15deg"] = float((~(worst <= OUTLIER)).mean())
    off = log.p_estimate[scored] - log.p[scored]
    metrics["position_rmse_m"] = float(np.sqrt((off**2).sum(axis=1).mean()))
    covariance = log.covariance[scored, :3, :3]
    claimed = np.isfinite(covariance).all(axis=(1, 2))
    if claimed.any():
        normalised = nees(np.radians(errors[claimed]), covariance[claimed])
        inside = (normalised >= NEES_BOUNDS[0]) & (normalised <= NEES_BOUNDS[1])
        metrics["nees_mean"] = float(normalised.mean() / 3)
        metrics["nees_in_bounds"] = float(inside.mean())
    return metrics
