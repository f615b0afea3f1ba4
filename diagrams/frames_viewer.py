"""Frames of tags and of the camera in Meshcat: as they are, as they are seen, as they are chained.

Told apart without colour: true frames have a ball in the middle, observed ones a cube, chained ones
none and thin axes. The axes are red, green and blue, as everywhere.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import Box, Cylinder, Meshcat, Rgba, Shape, Sphere
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.framework import Context, InputPort, LeafSystem

from systems.angles import spatial_pose
from systems.mapping.tag_frames import TagFrame
from systems.markers.layout import MarkerMap
from systems.periods import period
from systems.planners.closed_curve import ClosedCurve
from systems.validation import require, require_positive

Array = NDArray[np.float64]

_ROOT = "frames"
_AXES = {
    "x": (Rgba(0.9, 0.15, 0.15, 1.0), RollPitchYaw(0.0, math.pi / 2, 0.0)),
    "y": (Rgba(0.15, 0.7, 0.15, 1.0), RollPitchYaw(-math.pi / 2, 0.0, 0.0)),
    "z": (Rgba(0.2, 0.3, 0.95, 1.0), RollPitchYaw(0.0, 0.0, 0.0)),
}
_DASH = 0.12  # m of the route; as much again is left out
_STEP = 0.1  # m between two marks of the path


def add_triad(
    meshcat: Meshcat, path: str, *, length: float, radius: float, middle: Shape | None = None
) -> None:
    """Adds the axes of a frame, which is moved by the transform of `path`.

    Args:
        meshcat: where.
        path: of the frame.
        length: of an axis, m.
        radius: of an axis, m.
        middle: what stands in the origin, if anything.
    """
    for axis, (colour, rpy) in _AXES.items():
        name = f"{path}/{axis}"
        meshcat.SetObject(name, Cylinder(radius, length), colour)
        R = RotationMatrix(rpy)
        meshcat.SetTransform(name, RigidTransform(R, R.matrix()[:, 2] * length / 2))
    if middle is not None:
        meshcat.SetObject(f"{path}/middle", middle, Rgba(0.1, 0.1, 0.1, 1.0))


class FramesViewer(LeafSystem):
    """Shows true and observed frames of tags and camera.

    .. pydrake_system::

        name: FramesViewer
        input_ports:
        - frame
        - pose

    Args:
        meshcat: where.
        markers: the tags as they are.
        X_BC: pose of the optical frame in base_link.
        anchor: id of the tag through which the observed camera goes; None takes, in each picture,
            the tag that is nearest.
        rate: pictures a second, Hz.

    Ports:
        frame (input, TagFrame): what the camera sees. Each tag is drawn where the true camera sees
            it, `X_WC X_CT`; the camera where the tag, as it is, says that it is, `X_WT X_CT^-1`.
        pose (input, vector of 3): [x (m), y (m), theta (rad)] of base_link as it is; unconnected,
            there are no true frames of the camera, and no observed ones of tags.

    A sink: it draws in publish events and influences nothing.

    Raises:
        ValueError: the anchor is not among the markers.
    """

    def __init__(
        self,
        *,
        meshcat: Meshcat,
        markers: MarkerMap,
        X_BC: RigidTransform,
        anchor: int | None,
        rate: float,
    ) -> None:
        super().__init__()
        require_positive(rate=rate)
        require(anchor is None or anchor in markers, "anchor", anchor, "one of the markers")
        self._meshcat, self._markers, self._X_BC, self._anchor = meshcat, markers, X_BC, anchor
        self._frame_input = self.DeclareAbstractInputPort("frame", AbstractValue.Make(TagFrame()))
        self._pose_input = self.DeclareVectorInputPort("pose", 3)
        # Where the last marks of the paths were drawn: what the browser holds, not the diagram.
        self._last: dict[str, Array] = {}
        self._marks = {"truth": 0, "observed": 0}
        for marker in markers:
            size = {"length": 0.6 * marker.size, "radius": 0.03 * marker.size}
            true, seen = (f"{_ROOT}/{kind}/tag {marker.id}" for kind in ("true", "observed"))
            add_triad(meshcat, true, **size, middle=Sphere(0.09 * marker.size))
            meshcat.SetTransform(true, marker.X_WM)
            side = 0.14 * marker.size
            add_triad(meshcat, seen, **size, middle=Box(side, side, side))
        cameras = {"true": Sphere(0.014), "observed": Box(0.022, 0.022, 0.022)}
        for kind, middle in cameras.items():
            add_triad(meshcat, f"{_ROOT}/{kind}/camera", length=0.12, radius=0.005, middle=middle)
        self.DeclarePeriodicPublishEvent(period(rate), 0.0, self._draw)

    def frame_input_port(self) -> InputPort:
        """Returns the port of what the camera sees."""
        return self._frame_input

    def pose_input_port(self) -> InputPort:
        """Returns the port of the true pose."""
        return self._pose_input

    def _draw(self, context: Context) -> None:
        t = context.get_time()
        frame: TagFrame = self._frame_input.Eval(context)
        X_WC: RigidTransform | None = None
        if self._pose_input.HasValue(context):
            X_WC = spatial_pose(self._pose_input.Eval(context)) @ self._X_BC
            self._meshcat.SetTransform(f"{_ROOT}/true/camera", X_WC, t)
            self._mark("truth", X_WC, t)
        self._meshcat.SetProperty(f"{_ROOT}/true/camera", "visible", X_WC is not None, t)
        seen = dict(frame.poses())
        for marker in self._markers:
            name = f"{_ROOT}/observed/tag {marker.id}"
            shown = marker.id in seen and X_WC is not None
            self._meshcat.SetProperty(name, "visible", shown, t)
            if shown and X_WC is not None:
                self._meshcat.SetTransform(name, X_WC @ seen[marker.id], t)
        through = self._anchor if self._anchor is not None else nearest(frame)
        known = through is not None and through in seen
        self._meshcat.SetProperty(f"{_ROOT}/observed/camera", "visible", known, t)
        if known and through is not None:
            X_WC = self._markers.markers[through].X_WM @ seen[through].inverse()
            self._meshcat.SetTransform(f"{_ROOT}/observed/camera", X_WC, t)
            self._mark("observed", X_WC, t)

    def _mark(self, path: str, X_WC: RigidTransform, t: float) -> None:
        """Adds a mark to a path when the camera has come far enough."""
        place = X_WC.translation()
        last = self._last.get(path)
        if last is not None and np.linalg.norm(place - last) < _STEP:
            return
        self._last[path] = place.copy()
        name = f"{_ROOT}/path of {path}/{self._marks[path]}"
        self._marks[path] += 1
        if path == "truth":
            self._meshcat.SetObject(name, Sphere(0.008), Rgba(0.1, 0.1, 0.1, 1.0))
        else:
            self._meshcat.SetObject(name, Box(0.02, 0.02, 0.02), Rgba(0.9, 0.45, 0.1, 1.0))
        self._meshcat.SetTransform(name, RigidTransform(place))
        appear(self._meshcat, name, t)


def nearest(frame: TagFrame) -> int | None:
    """Returns the id of the tag that is nearest to the camera; None when there is none."""
    if len(frame) == 0:
        return None
    return int(frame.ids[np.argmin(np.linalg.norm(frame.p_CT[:, 0], axis=1))])


def appear(meshcat: Meshcat, path: str, t: float) -> None:
    """Lets an object be there from a time (s) of the recording on."""
    if t > 0:
        meshcat.SetProperty(path, "visible", False, 0.0)
    meshcat.SetProperty(path, "visible", True, t)


def draw_route(meshcat: Meshcat, curve: ClosedCurve) -> None:
    """Draws a closed route as dashes on the ground, with an arrow's head at its start."""
    for k, s in enumerate(np.arange(0.0, curve.length - _DASH, 2 * _DASH)):
        place, heading = curve.at(s + _DASH / 2)
        name = f"{_ROOT}/route/{k}"
        meshcat.SetObject(name, Box(_DASH, 0.025, 0.002), Rgba(0.95, 0.95, 0.9, 1.0))
        meshcat.SetTransform(name, spatial_pose(np.array([*place, heading]), 0.002))
    place, heading = curve.at(0.0)
    for side in (-1, 1):
        barb = np.array([*place, heading + side * 0.75 * math.pi])
        barb[:2] += 0.09 * np.array([math.cos(barb[2]), math.sin(barb[2])])
        name = f"{_ROOT}/route/start {'left' if side > 0 else 'right'}"
        meshcat.SetObject(name, Box(0.18, 0.03, 0.002), Rgba(0.95, 0.95, 0.9, 1.0))
        meshcat.SetTransform(name, spatial_pose(barb, 0.003))


def look_at(meshcat: Meshcat, places: Array) -> None:
    """Points Meshcat's camera at places (n, 3) m, from the south and above."""
    low, high = places.min(axis=0), places.max(axis=0)
    middle, (wide, deep, _) = (low + high) / 2, high - low
    away = max(1.5, 0.4 * wide, 0.55 * deep)  # windows are wider than high
    eye = np.array([middle[0], middle[1] - 0.5 * deep - 0.2 * away, away])
    meshcat.SetCameraPose(eye, np.array([middle[0], middle[1] - 0.1 * deep, 0.0]))


def show_chained(
    meshcat: Meshcat,
    *,
    tags: list[tuple[int, RigidTransform, float]],
    cameras: list[tuple[RigidTransform, float]],
    size: float,
) -> None:
    """Adds a chain's frames to the recording, each from the time on at which it was placed.

    Args:
        meshcat: where.
        tags: id, pose and time (s).
        cameras: pose and time (s), in order.
        size: of the tags, m.
    """
    for tag, X_WT, t in tags:
        name = f"{_ROOT}/chained/tag {tag}"
        add_triad(meshcat, name, length=1.1 * size, radius=0.018 * size)
        meshcat.SetTransform(name, X_WT)
        appear(meshcat, name, t)
    last: Array | None = None
    for k, (X_WC, t) in enumerate(cameras):
        place = X_WC.translation()
        if last is not None and np.linalg.norm(place - last) < _STEP:
            continue
        last = place
        name = f"{_ROOT}/chained/path/{k}"
        meshcat.SetObject(name, Box(0.03, 0.03, 0.004), Rgba(0.55, 0.2, 0.75, 1.0))
        meshcat.SetTransform(name, RigidTransform(place))
        appear(meshcat, name, t)
