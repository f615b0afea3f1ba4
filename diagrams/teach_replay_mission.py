"""The replay of what was taught before in the same run: metrics and figure of all of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context

from diagrams.replay_mission import ReplayMission
from systems.markers.layout import MarkerMap
from systems.planners.route import Route

if TYPE_CHECKING:
    from diagrams.teach_replay import Taught, TeachReplayScenario


class TeachReplayMission(ReplayMission):
    """The wired replay of a `TeachReplayScenario`.

    Args:
        scenario: robot, world, blocks.
        taught: what teaching left; None before it.
        known: the tags as the robot knows them.
        route: what to follow.
        meshcat: where it is shown, if anywhere.
        out: folder of the run; None records nothing.
    """

    def __init__(
        self,
        scenario: TeachReplayScenario,
        *,
        taught: Taught | None,
        known: MarkerMap,
        route: Route,
        meshcat: Meshcat | None,
        out: Path | None,
    ) -> None:
        self._taught = taught
        super().__init__(scenario, known=known, route=route, meshcat=meshcat, out=out)

    def outcome(self, context: Context) -> str | None:
        """Returns what went wrong before the replay, if anything did, else how that went."""
        if self._taught is not None and self._taught.failure is not None:
            return self._taught.failure
        return super().outcome(context)

    def metrics(self, context: Context) -> dict[str, Any]:
        """Returns the metrics of the replay, and before them those of map and trajectory."""
        replay = super().metrics(context)
        if self._taught is None:
            return replay
        if self._taught.failure is not None:
            replay = dict.fromkeys(replay)
        return {**taught_metrics(self._taught), **replay}

    def write(self, context: Context, out: Path) -> None:
        """Writes what a replay does; the figure shows the teaching and the maps too."""
        from diagrams.teach_replay_plots import plot_teach_replay  # loads Matplotlib

        super().write(context, out)
        if self._taught is not None:
            log = None if self._taught.failure is not None else self.replay_log(context)
            plot_teach_replay(out / "summary.png", self._taught, log)


def tag_errors(taught: Taught) -> dict[int, float]:
    """Returns by id how far the optimised tags are from where they are, m; without the anchor."""
    known, true = taught.known, taught.log.markers
    if known is None:
        return {}
    return {
        tag.id: float(
            np.linalg.norm(tag.X_WM.translation() - true.markers[tag.id].X_WM.translation())
        )
        for tag in known
        if tag.id != taught.log.anchor and tag.id in true
    }


def path_errors(taught: Taught) -> np.ndarray:
    """Returns (n,) how far the optimised places of base_link are from the true ones, m."""
    if taught.path is None or taught.log.truth is None:
        return np.zeros(0)
    true = taught.log.true_base(taught.path.stamps)
    return np.asarray(np.hypot(*(taught.path.p_WB[:, :2] - true[:, :2]).T))


def taught_metrics(taught: Taught) -> dict[str, Any]:
    """Returns how good the maps are, before optimisation and after it."""
    before = {
        f"{name}_{key}": taught.teach_metrics.get(f"{name}_{key}")
        for name in ("naive", "gated")
        for key in ("tag_error_mean_m", "trajectory_error_mean_m")
    }
    tags, path = list(tag_errors(taught).values()), path_errors(taught)
    names = ("reprojection_rms_px", "chi2_per_dof", "tags")
    return {
        **before,
        "optimised_tag_error_mean_m": float(np.mean(tags)) if tags else None,
        "optimised_tag_error_max_m": max(tags) if tags else None,
        "trajectory_error_mean_m": float(path.mean()) if len(path) else None,
        **{name: taught.map_metrics.get(name) for name in names},
        "taught_length_m": taught.teach_metrics.get("path_length_m"),
        "planned_lap_time_s": None if taught.plan is None else taught.plan.route.duration,
    }
