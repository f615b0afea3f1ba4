"""Teaching, optimisation and replay in one go, in three rooms of one run's folder.

teach/   a person or a script drives once around; the recording
map/     the tags' map and the trajectory, optimised; the route
.        the replay
"""

from __future__ import annotations

import copy
import logging
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat

from diagrams.mapping import map_recording
from diagrams.mission import Mission
from diagrams.replay import ReplayKeys
from diagrams.teach import TeachScenario
from diagrams.teach_log import Chained, TeachLog
from diagrams.teach_mission import TeachMission
from systems.mapping.trajectory import Trajectory
from systems.markers.layout import MarkerMap, load_map
from systems.planners.closed_curve import ClosedCurve
from systems.planners.route import Route
from systems.planners.route_limits import RouteLimits
from systems.planners.route_plan import RoutePlan, plan_route
from systems.planners.tag_view import TagView
from systems.planners.taught_path import taught_path
from systems.validation import require

Array = NDArray[np.float64]

_log = logging.getLogger(__name__)
_SPEED = 0.3  # m/s, of the track as it is, for a diagram that nobody has taught yet
_STEP = 0.05  # s


@dataclass(frozen=True, eq=False)
class Taught:
    """What teaching and optimisation have left.

    Attributes:
        log: of the teaching run.
        chains: the unoptimised maps, by name.
        teach_metrics: of its report.
        failure: word for what went wrong, if anything did; the rest may be missing then.
        map_metrics: of the map's report.
        known: the optimised map.
        path: of base_link, optimised.
        plan: the route.
    """

    log: TeachLog
    chains: dict[str, Chained]
    teach_metrics: dict[str, Any]
    failure: str | None = None
    map_metrics: dict[str, Any] = field(default_factory=dict)
    known: MarkerMap | None = None
    path: Trajectory | None = None
    plan: RoutePlan | None = None


@dataclass(kw_only=True)
class TeachReplayScenario(TeachScenario, ReplayKeys):
    """Who drives around which circuit, and how the robot does it after that on its own.

    Attributes:
        limits: that the route is to keep to.
    """

    limits: RouteLimits = field(default_factory=RouteLimits)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_replay(self.robot)
        self._taught: Taught | None = None
        require(
            self.recording is None,
            "recording",
            self.recording,
            "left out: play teaching and replay back one by one",
        )
        require(
            not self.world.moved_markers,
            "world.moved_markers",
            self.world.moved_markers,
            "left out: the map is made of where the tags are",
        )

    def prepared(
        self,
        *,
        meshcat: Meshcat | None = None,
        out: Path | None = None,
        progress: Callable[[float, float], None] | None = None,
    ) -> TeachReplayScenario:
        """Teaches and optimises; returns the scenario that replays what came of it."""
        ready = copy.copy(self)
        with tempfile.TemporaryDirectory() as folder:
            ready._taught = _teach(self, out or Path(folder), meshcat, progress)
        if meshcat is not None:  # what teaching has left there
            meshcat.DeleteAddedControls()
            meshcat.DeleteRecording()
            meshcat.Delete("/drake")
        return ready

    def build(self, *, meshcat: Meshcat | None = None, out: Path | None = None) -> Mission:
        """Wires the replay.

        Without teaching before (see `prepared`) the robot knows the tags and the track as they are.

        Args:
            meshcat: where it is shown, if anywhere.
            out: folder of the run; the recording goes there. None records nothing.

        Raises:
            ValueError: something of the scenario is refused; one line.
        """
        from diagrams.teach_replay_mission import TeachReplayMission

        taught = self._taught
        known = taught.known if taught is not None else None
        plan = taught.plan if taught is not None else None
        return TeachReplayMission(
            self,
            taught=taught,
            known=self.world.marker_map() if known is None else known,
            route=_track(self.route) if plan is None else plan.route,
            meshcat=meshcat,
            out=out,
        )


def _teach(
    scenario: TeachReplayScenario,
    out: Path,
    meshcat: Meshcat | None,
    progress: Callable[[float, float], None] | None,
) -> Taught:
    from diagrams.run import simulate

    keys = {entry.name: getattr(scenario, entry.name) for entry in fields(TeachScenario)}
    teaching = TeachScenario(**keys | {"mission": "teach", "name": "teach"})
    teaching.record = copy.copy(teaching.record)
    teaching.record.bag = True
    run = simulate(teaching, out=out / "teach", meshcat=meshcat, progress=progress)
    mission = run.mission
    assert isinstance(mission, TeachMission)
    log, chains = mission.teach_log(run.context), mission.chains(run.context)
    metrics = run.report["metrics"]
    if not run.succeeded:
        return _failed(Taught(log, chains, metrics, run.report["outcome"]), "teaching", "")
    try:
        mapping = map_recording(
            out / "teach" / "bag", out=out / "map", known=out / "teach" / "anchor.json"
        )
    except ValueError as error:
        return _failed(Taught(log, chains, metrics, "refused"), "map", str(error))
    found = mapping.report["metrics"]
    if not mapping.succeeded:
        reasons = "; ".join(mapping.report["reasons"].values())
        return _failed(Taught(log, chains, metrics, "refused", found), "map", reasons)
    known = load_map(out / "map" / "map.json")
    sensor = scenario.robot.sensors[scenario.camera].build()
    view = TagView(known, sensor.model(), sensor.mounting(), sensor.projector)
    path = mapping.path
    poses = np.column_stack([path.p_WB[:, :2], np.arctan2(path.R_WB[:, 1, 0], path.R_WB[:, 0, 0])])
    try:
        plan = plan_route(taught_path(path.stamps, poses), known, scenario.limits, view)
    except ValueError as error:
        return _failed(
            Taught(log, chains, metrics, "no_route", found, known, path), "route", str(error)
        )
    plan.route.save(out / "map" / "route.json")
    return Taught(log, chains, metrics, None, found, known, path, plan)


def _failed(taught: Taught, stage: str, why: str) -> Taught:
    _log.warning("%s: %s%s", stage, taught.failure, f": {why}" if why else "")
    return taught


def _track(points: list[list[float]]) -> Route:
    """Returns the circuit itself as a route at an even speed."""
    curve = ClosedCurve(points)
    n = max(round(curve.length / _SPEED / _STEP), 8)
    v = curve.length / n / _STEP
    s = curve.length / n * np.arange(n)
    (x, y), theta = curve.at(s)[0].T, np.unwrap(curve.at(s)[1])
    speed = np.full(n, v)
    omega = np.asarray(v * curve.curvature_at(s), np.float64)
    return Route(_STEP * np.arange(n, dtype=float), x, y, theta, speed, omega, closed=True)
