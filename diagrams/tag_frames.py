"""Frames of tags and of a camera on a circular path, as they are and as they are observed.

The check of the pipeline of Martins do Lago Reis, da Silva Ramos, "AprilTag-based Trajectory
Tracking for the LIMOS Robot", section 3.1: without noise observed frames lie on the true ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context
from pydrake.systems.primitives import ConstantVectorSource

from diagrams.frames_viewer import FramesViewer, look_at
from diagrams.mission import FRAME_RATE, Mission, Wiring
from diagrams.scenario import Scenario
from diagrams.station import RobotParameters
from diagrams.teach_log import TeachLog
from diagrams.teach_mission import LOOKS, write_cameras
from diagrams.teach_recording import tag_transforms_signal
from diagrams.world import WorldParameters
from systems.mapping.tag_frames import TagFrames
from systems.validation import require, require_positive

Array = NDArray[np.float64]

ROBOT = "rig"
FLIPPED = 20.0  # degrees; a rotation that is wrong by more is the square's other pose


@dataclass
class Circle:
    """The camera's path.

    Attributes:
        radius: of base_link's circle, to the left of the start, m.
        speed: m/s.
    """

    radius: float = 1.2
    speed: float = 0.4

    def __post_init__(self) -> None:
        require_positive(**vars(self))

    @property
    def time(self) -> float:
        """Of a turn, s."""
        return 2 * math.pi * self.radius / self.speed


@dataclass(kw_only=True)
class TagFramesScenario(Scenario):
    """A camera that goes round once, and tags.

    Attributes:
        world: the tags.
        robot: what carries the camera, which is among its sensors.
        circle: the path.
        camera: which of the sensors looks for tags.
    """

    world: WorldParameters
    robot: RobotParameters
    circle: Circle
    camera: str = "front_camera"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.robot.require_sensor("camera", self.camera, "mounting")
        require(len(self.world.marker_map()) > 0, "world.markers", "empty", "of tags")

    def build(self, *, meshcat: Meshcat | None = None, out: Path | None = None) -> Mission:
        """Wires station and observer.

        Args:
            meshcat: where it is shown, if anywhere.
            out: folder of the run; the recording goes there. None records nothing.

        Raises:
            ValueError: something of the scenario is refused; one line.
        """
        return TagFramesMission(self, meshcat=meshcat, out=out)


class TagFramesMission(Mission):
    """The wired diagram of a `TagFramesScenario`."""

    def __init__(
        self, scenario: TagFramesScenario, *, meshcat: Meshcat | None, out: Path | None
    ) -> None:
        """See `TagFramesScenario.build`."""
        wiring = Wiring(
            scenario, world=scenario.world, robots={ROBOT: scenario.robot}, meshcat=meshcat
        )
        self.station = wiring.station
        self._scenario, self._wiring = scenario, wiring
        self._true_markers = scenario.world.true_markers(scenario.seed)
        sensor = scenario.robot.sensors[scenario.camera].build()
        self._X_BC = sensor.mounting()
        self._truth = f"truth.{ROBOT}.pose"
        self._has_truth = wiring.has_output(self._truth)
        known = wiring.station.marker_map
        wiring.add(
            TagFrames(
                camera=sensor.model(),
                markers=known,
                anchor=min(known.markers),
                rate=LOOKS * sensor.rate,
            ),
            "frames",
        )
        wiring.connect(f"{ROBOT}.{scenario.camera}.detections", "frames.detections")
        circle = scenario.circle
        wiring.add(ConstantVectorSource([circle.speed, circle.speed / circle.radius]), "driver")
        wiring.connect("driver.y0", f"{ROBOT}.drive.command")
        if self._has_truth:
            wiring.log(self._truth, _LOG_RATE)
        wiring.record("frames.frame", tag_transforms_signal(ROBOT, sensor.rate))
        if meshcat is not None:
            viewer = FramesViewer(
                meshcat=meshcat,
                markers=self._true_markers,
                X_BC=self._X_BC,
                anchor=None,
                rate=FRAME_RATE,
            )
            wiring.add(viewer, "viewer")
            look_at(meshcat, np.array([m.X_WM.translation() for m in self._true_markers]))
            wiring.connect("frames.frame", "viewer.frame")
            if self._has_truth:
                wiring.connect(self._truth, "viewer.pose")
        self.recorder = wiring.add_recorder(out)
        self.diagram, self.logs = wiring.build("tag_frames")

    def outcome(self, context: Context) -> str | None:
        """Returns `round` when the camera has been round."""
        return "round" if context.get_time() >= self._scenario.circle.time else None

    def succeeded(self, outcome: str) -> bool:
        """Whether the camera has been round, or the recording was played."""
        return outcome in ("round", "played")

    def frames_log(self, context: Context) -> TeachLog:
        """Returns what the camera saw, and where it was."""
        t, truth = self.log(self._truth, context) if self._has_truth else (np.zeros(0), None)
        return TeachLog(
            frames=self._wiring.value("frames.history", context).frames(),
            t=t,
            truth=truth,
            odometry=np.zeros((len(t), 3)),
            markers=self._true_markers,
            anchor=min(self._true_markers.markers),
            X_BC=self._X_BC,
        )

    def metrics(self, context: Context) -> dict[str, Any]:
        """Returns how far observed frames are from the true ones."""
        log = self.frames_log(context)
        frames = log.frames
        observations = sum(len(frame) for frame in frames)
        counts: dict[str, Any] = {
            "frames": len(frames),
            "observations": observations,
            "tags_seen": len({int(i) for frame in frames for i in frame.ids}),
        }
        names = ("tag_position", "camera_position", "rotation")
        keys = [
            f"{name}_error_{kind}_{'deg' if name == 'rotation' else 'm'}"
            for name in names
            for kind in ("mean", "max")
        ]
        if log.truth is None or observations == 0:
            return {**counts, **dict.fromkeys([*keys, "flipped_fraction"])}
        errors = frame_errors(log)
        values = [float(f(errors[:, k])) for k in range(3) for f in (np.mean, np.max)]
        flipped = float((errors[:, 2] > FLIPPED).mean())
        return {**counts, **dict(zip(keys, values, strict=True)), "flipped_fraction": flipped}

    def write(self, context: Context, out: Path) -> None:
        """Writes `summary.png`, the true trajectory and the observed one of the camera."""
        from diagrams.teach_plots import plot_frames  # loads Matplotlib

        log = self.frames_log(context)
        if log.truth is None:
            return
        stamps = np.array([frame.stamp for frame in log.frames])
        write_cameras(out / "truth_camera.tum", stamps, log.true_cameras(stamps))
        seen = observed_cameras(log)
        write_cameras(
            out / "observed_camera.tum", np.array([t for t, _ in seen]), [X for _, X in seen]
        )
        plot_frames(out / "summary.png", log, frame_errors(log), seen)


def frame_errors(log: TeachLog) -> Array:
    """Returns (n, 3) of every observation of a tag: errors of the observed frames.

    How far the tag's frame is off when the camera's is right, m; the camera's when the tag's is
    right, m; and the rotation of either, degrees.
    """
    stamps = np.array([frame.stamp for frame in log.frames])
    rows = []
    for frame, X_WC in zip(log.frames, log.true_cameras(stamps), strict=True):
        for tag, X_CT in frame.poses():
            X_WT = log.markers.markers[tag].X_WM
            of_tag = (X_WC @ X_CT).translation() - X_WT.translation()
            of_camera = (X_WT @ X_CT.inverse()).translation() - X_WC.translation()
            turned = (X_WT.inverse() @ X_WC @ X_CT).rotation().ToAngleAxis().angle()
            rows.append([np.linalg.norm(of_tag), np.linalg.norm(of_camera), math.degrees(turned)])
    return np.array(rows, float).reshape(-1, 3)


def observed_cameras(log: TeachLog) -> list[tuple[float, RigidTransform]]:
    """Returns time (s) and the camera's pose by the nearest tag, of the frames with any."""
    found = []
    for frame in log.frames:
        poses = frame.poses()
        if poses:
            tag, X_CT = min(poses, key=lambda pair: float(np.linalg.norm(pair[1].translation())))
            found.append((frame.stamp, log.markers.markers[tag].X_WM @ X_CT.inverse()))
    return found


_LOG_RATE = 100.0  # Hz: to be as exact between two samples as what is compared
