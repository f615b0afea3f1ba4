"""The wired diagram of teaching: its outcome, its metrics, its results."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context
from pydrake.systems.primitives import ConstantVectorSource, Multiplexer

from diagrams.frames_viewer import FramesViewer, draw_route, look_at, show_chained
from diagrams.mission import FRAME_RATE, Mission, Wiring
from diagrams.teach_log import Chained, TeachLog, chain_metrics, counted, driven
from diagrams.teach_recording import (
    camera_pose_signal,
    low_observability_signal,
    odometry_signal,
    tag_transforms_signal,
)
from diagrams.trajectories import write_poses, write_tum
from systems.angles import spatial_pose
from systems.estimators.wheel_odometry import WheelOdometry
from systems.mapping.tag_frames import TagFrames
from systems.planners.closed_curve import ClosedCurve
from systems.pose_vector import pose_to_vector

if TYPE_CHECKING:
    from diagrams.teach import TeachScenario

ROBOT = "limo"
LOOKS = 5  # for new pictures in the time of one: played back, they come a little early or late


class TeachMission(Mission):
    """The wired diagram of a `TeachScenario`."""

    def __init__(
        self, scenario: TeachScenario, *, meshcat: Meshcat | None, out: Path | None
    ) -> None:
        """See `TeachScenario.build`."""
        wiring = Wiring(
            scenario, world=scenario.world, robots={ROBOT: scenario.robot}, meshcat=meshcat
        )
        self.station = wiring.station
        self._scenario, self._wiring, self._meshcat = scenario, wiring, meshcat
        self._true_markers = scenario.world.true_markers(scenario.seed)
        sensor = scenario.robot.sensors[scenario.camera].build()
        self._camera, self._X_BC, rate = sensor.model(), sensor.mounting(), sensor.rate
        self._truth = f"truth.{ROBOT}.pose"
        self._has_truth = wiring.has_output(self._truth)
        wiring.add(
            TagFrames(
                camera=self._camera,
                markers=wiring.station.marker_map,
                anchor=scenario.anchor,
                rate=LOOKS * rate,
                pixel_noise=scenario.pixel_noise,
            ),
            "frames",
        )
        wiring.connect(f"{ROBOT}.{scenario.camera}.detections", "frames.detections")
        self._add_driver()
        odometry_rate = self._add_odometry()
        for name in ["odometry.pose", *[self._truth] * self._has_truth]:
            wiring.log(name)
        wiring.record("odometry_with_covariance.y0", odometry_signal(ROBOT, odometry_rate))
        wiring.record("frames.camera_pose", camera_pose_signal(ROBOT, rate))
        wiring.record("frames.frame", tag_transforms_signal(ROBOT, rate))
        wiring.record("frames.tags_in_view", low_observability_signal(ROBOT, rate))
        if meshcat is not None:
            self._show(meshcat)
        self.recorder = wiring.add_recorder(out)
        self.diagram, self.logs = wiring.build("teach")
        self._chains: dict[str, Chained] | None = None

    def _add_odometry(self) -> float:
        """Adds wheel odometry; returns its rate, Hz."""
        scenario, wiring = self._scenario, self._wiring
        encoders = scenario.robot.sensors[scenario.encoders].build()
        sides = scenario.robot.body.build().sides
        wiring.add(
            WheelOdometry(
                ticks_per_turn=encoders.parameters.ticks_per_turn,
                wheel_radius=sides.wheel_radius,
                track=sides.base,
                rate=encoders.rate,
                parameters=scenario.odometry,
            ),
            "odometry",
        )
        wiring.connect(f"{ROBOT}.{scenario.encoders}.ticks", "odometry.ticks")
        together = wiring.add(Multiplexer([3, 9, 2]), "odometry_with_covariance")
        for index, port in enumerate(("pose", "covariance", "velocity")):
            wiring.builder.Connect(
                wiring.output(f"odometry.{port}"), together.get_input_port(index)
            )
        return float(encoders.rate)

    def _add_driver(self) -> None:
        scenario, wiring = self._scenario, self._wiring
        self._driven = wiring.station.simulated
        if not self._driven:  # who drove when it was recorded does not drive now
            wiring.add(ConstantVectorSource(np.zeros(2)), "driver")
            wiring.connect("driver.y0", f"{ROBOT}.drive.command")
            return
        driver = scenario.driver.build(route=scenario.route, meshcat=self._meshcat)
        wiring.add(driver, "driver")
        if self._has_truth:
            wiring.connect_if_wanted(self._truth, "driver.pose")
        wiring.connect("driver.command", f"{ROBOT}.drive.command")

    def _show(self, meshcat: Meshcat) -> None:
        curve = ClosedCurve(self._scenario.route)
        draw_route(meshcat, curve)
        tags = [marker.X_WM.translation() for marker in self._true_markers]
        look_at(meshcat, np.array(tags))
        self._wiring.add(
            FramesViewer(
                meshcat=meshcat,
                markers=self._true_markers,
                X_BC=self._X_BC,
                anchor=self._scenario.anchor,
                rate=FRAME_RATE,
            ),
            "viewer",
        )
        self._wiring.connect("frames.frame", "viewer.frame")
        if self._has_truth:
            self._wiring.connect(self._truth, "viewer.pose")

    def outcome(self, context: Context) -> str | None:
        """Returns how teaching ended, once the driver is done.

        `taught` when the anchor was in view at the beginning and is at the end; `no_anchor` when
        not: such a drive cannot be closed.
        """
        if not self._driven or self._wiring.value("driver.finished", context)[0] == 0:
            return None
        return "taught" if self._anchored(context) else "no_anchor"

    def unfinished(self, context: Context, word: str) -> str:
        """Returns the word for a run whose time was up."""
        del context
        return word

    def succeeded(self, outcome: str) -> bool:
        """Whether the drive can be made into a map: also one that was recorded."""
        return outcome in ("taught", "played")

    def _anchored(self, context: Context) -> bool:
        frames = self._wiring.value("frames.history", context).frames()
        return bool(frames) and all(
            self._scenario.anchor in frame.ids for frame in (frames[0], frames[-1])
        )

    def teach_log(self, context: Context) -> TeachLog:
        """Returns what the run left."""
        t, odometry = self.log("odometry.pose", context)
        return TeachLog(
            frames=self._wiring.value("frames.history", context).frames(),
            t=t,
            truth=self.log(self._truth, context)[1] if self._has_truth else None,
            odometry=odometry,
            markers=self._true_markers,
            anchor=self._scenario.anchor,
            X_BC=self._X_BC,
        )

    def chains(self, context: Context) -> dict[str, Chained]:
        """Returns the unoptimised maps; computed once, at the end of the run."""
        if self._chains is None:
            self._chains = self.teach_log(context).chained(self._camera)
        return self._chains

    def metrics(self, context: Context) -> dict[str, Any]:
        """Returns counters, statistics and the errors of the chains (see `diagrams.teach_log`)."""
        log = self.teach_log(context)
        end = None
        if log.truth is not None and len(log.truth):
            X = spatial_pose(log.truth[0])
            moved = X.inverse() @ spatial_pose(log.truth[-1])
            end = float(np.hypot(*(log.odometry[-1, :2] - moved.translation()[:2])))
        return {
            **counted(log),
            **driven(log),
            "odometry_error_m": end,
            **chain_metrics(log, self.chains(context)),
        }

    def write(self, context: Context, out: Path) -> None:
        """Writes `summary.png`, trajectories, the anchor's map; shows the chained frames."""
        from diagrams.teach_plots import plot_teaching  # loads Matplotlib

        log, chains = self.teach_log(context), self.chains(context)
        known = self.station.marker_map
        anchor = {self._scenario.anchor: known.markers[self._scenario.anchor]}
        replace(known, markers=anchor).save(out / "anchor.json")
        if log.truth is not None:
            write_tum(out / "truth.tum", log.t, log.truth)
            stamps = np.array([frame.stamp for frame in log.frames])
            write_cameras(out / "truth_camera.tum", stamps, log.true_cameras(stamps))
        for name, chained in chains.items():
            cameras = chained.cameras()
            stamps = np.array([t for t, _ in cameras])
            write_cameras(out / f"{name}_camera.tum", stamps, [X for _, X in cameras])
        plot_teaching(out / "summary.png", log, chains, route=self._scenario.route)
        if self._meshcat is not None and "naive" in chains:
            self._show_chained(chains["naive"], log)

    def _show_chained(self, naive: Chained, log: TeachLog) -> None:
        assert self._meshcat is not None
        first_seen: dict[int, float] = {}
        for frame in log.frames:
            for tag in frame.ids:
                first_seen.setdefault(int(tag), frame.stamp)
        show_chained(
            self._meshcat,
            tags=[(tag, X, first_seen[tag]) for tag, X in naive.tags().items()],
            cameras=[(X, t) for t, X in naive.cameras()],
            size=log.markers.size,
        )


def write_cameras(path: Path, stamps: np.ndarray, X_WC: list[RigidTransform]) -> None:
    """Writes poses of a camera in the map at times (s)."""
    poses = np.array([pose_to_vector(X) for X in X_WC]).reshape(-1, 7)
    write_poses(path, stamps, poses)
