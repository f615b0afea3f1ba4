"""What Meshcat shows beyond the geometry: the estimate, its covariance, the paths, the waypoints.

The replay keeps transforms and properties, not changes of shape. So the ellipse is a disc that is
scaled, and the paths are marks that appear one after the other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box, Cylinder, Meshcat, Rgba, Shape, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import Context, InputPort, LeafSystem

from systems.angles import spatial_pose
from systems.periods import period

Array = NDArray[np.float64]

_ROOT = "view"
_SIGMAS = 2.4477  # semi-axes of the planar 95 % ellipse, in standard deviations
_STEP = 0.10  # m between two marks of a path
_MAX_SEMI_AXIS = 5.0  # m; larger ellipses are drawn as this
_ABOVE = 0.03  # m; the ellipse floats over the robot, which would hide it


def ellipse(covariance: Array) -> tuple[float, float, float]:
    """Returns semi-axes a >= b (m) and direction of a (rad) of the 95 % ellipse of (2, 2)."""
    values, vectors = np.linalg.eigh(covariance)
    a, b = _SIGMAS * np.sqrt(np.maximum(values[::-1], 0.0))
    return float(a), float(b), float(np.arctan2(vectors[1, 1], vectors[0, 1]))


class Ghost(NamedTuple):
    """How a robot looks where it believes to be.

    Attributes:
        parts: name to shape and its pose in base_link.
        height: of the robot, m.
    """

    parts: dict[str, tuple[Shape, RigidTransform]]
    height: float


def ghost_of(
    *,
    length: float,
    width: float,
    clearance: float,
    height: float,
    wheels: dict[str, tuple[float, float]],
    wheel_radius: float,
    wheel_width: float,
) -> Ghost:
    """Returns the ghost of a box on wheels.

    Args:
        length: of the box, m.
        width: m.
        clearance: from the ground to the box, m.
        height: from the ground to its top, m.
        wheels: name to [x, y] of the wheel's middle in base_link, m.
        wheel_radius: m.
        wheel_width: m.
    """
    middle = RigidTransform([0.0, 0.0, (clearance + height) / 2])
    parts: dict[str, tuple[Shape, RigidTransform]] = {
        "chassis": (Box(length, width, height - clearance), middle)
    }
    upright = RollPitchYaw(np.pi / 2, 0.0, 0.0)
    for name, (x, y) in wheels.items():
        wheel = Cylinder(wheel_radius, wheel_width)
        parts[name] = wheel, RigidTransform(upright, [x, y, wheel_radius])
    return Ghost(parts, height)


class EstimateViewer(LeafSystem):
    """Shows the estimated pose as a ghost of the robot, with its 95 % ellipse and both paths.

    .. pydrake_system::

        name: EstimateViewer
        input_ports:
        - pose
        - covariance
        - truth

    Args:
        meshcat: where.
        ghost: how the robot looks.
        waypoints: (n, 2) m, shown as posts with discs of the arrival radius.
        radius: arrival radius, m.
        rate: pictures a second, Hz.
        show_truth: whether the port `truth` is connected.

    Ports:
        pose (input, vector of 3): [x (m), y (m), theta (rad)], the estimate.
        covariance (input, vector of 9): of the estimate, (3, 3) row by row.
        truth (input, vector of 3): the true pose; may be left unconnected.

    A sink: it draws in publish events and influences nothing.
    """

    def __init__(
        self,
        *,
        meshcat: Meshcat,
        ghost: Ghost,
        waypoints: Array,
        radius: float,
        rate: float,
        show_truth: bool = True,
    ) -> None:
        super().__init__()
        self._meshcat = meshcat
        self._pose_input = self.DeclareVectorInputPort("pose", 3)
        self._covariance_input = self.DeclareVectorInputPort("covariance", 9)
        self._truth_input = self.DeclareVectorInputPort("truth", 3)
        self._show_truth = show_truth
        # Where the last mark of each path was drawn: what the browser holds, not the diagram.
        self._last: dict[str, Array] = {}
        self._count = {"estimate": 0, "truth": 0}
        self._top = ghost.height + _ABOVE
        self._draw_ghost(ghost)
        self._draw_waypoints(waypoints, radius)
        meshcat.SetObject(f"{_ROOT}/ellipse/disc", Cylinder(1.0, 0.002), Rgba(1.0, 0.85, 0.1, 0.9))
        self.DeclarePeriodicPublishEvent(period(rate), 0.0, self._draw)

    def pose_input_port(self) -> InputPort:
        """Returns the port of the estimated pose."""
        return self._pose_input

    def covariance_input_port(self) -> InputPort:
        """Returns the port of the covariance."""
        return self._covariance_input

    def truth_input_port(self) -> InputPort:
        """Returns the port of the true pose."""
        return self._truth_input

    def _draw_ghost(self, ghost: Ghost) -> None:
        for name, (shape, X_BG) in ghost.parts.items():
            path = f"{_ROOT}/estimate/{name}"
            self._meshcat.SetObject(path, shape, Rgba(0.9, 0.2, 0.2, 0.35))
            self._meshcat.SetTransform(path, X_BG)

    def _draw_waypoints(self, waypoints: Array, radius: float) -> None:
        for k, (x, y) in enumerate(waypoints):
            name = f"{_ROOT}/waypoints/{k}"
            self._meshcat.SetTransform(name, RigidTransform([x, y, 0.0]))
            self._meshcat.SetObject(
                f"{name}/area", Cylinder(radius, 0.002), Rgba(0.2, 0.6, 0.3, 0.25)
            )
            self._meshcat.SetObject(f"{name}/post", Cylinder(0.01, 0.3), Rgba(0.2, 0.6, 0.3, 0.9))
            self._meshcat.SetTransform(f"{name}/post", RigidTransform([0.0, 0.0, 0.15]))

    def _draw(self, context: Context) -> None:
        t = context.get_time()
        pose = self._pose_input.Eval(context)
        covariance = self._covariance_input.Eval(context).reshape(3, 3)
        drawable = bool(np.isfinite(pose).all() and np.isfinite(covariance).all())
        known = drawable and covariance[0, 0] < _MAX_SEMI_AXIS**2
        for name in ("estimate", "ellipse"):
            self._meshcat.SetProperty(f"{_ROOT}/{name}", "visible", known, t)
        if known:
            a, b, angle = ellipse(covariance[:2, :2])
            self._meshcat.SetTransform(f"{_ROOT}/estimate", spatial_pose(pose), t)
            at = spatial_pose(np.array([pose[0], pose[1], angle]), self._top)
            self._meshcat.SetTransform(f"{_ROOT}/ellipse", at, t)
            size = [min(max(s, 5e-3), _MAX_SEMI_AXIS) for s in (a, b)]
            self._meshcat.SetProperty(f"{_ROOT}/ellipse/disc", "scale", [*size, 1.0], t)
            self._mark("estimate", pose, t)
        if self._show_truth:
            truth = self._truth_input.Eval(context)
            if np.isfinite(truth).all():
                self._mark("truth", truth, t)

    def _mark(self, path: str, pose: Array, t: float) -> None:
        """Adds a mark to a path when the robot has come far enough."""
        last = self._last.get(path)
        if last is not None and np.hypot(*(pose[:2] - last)) < _STEP:
            return
        self._last[path] = pose[:2].copy()
        name = f"{_ROOT}/path of the {path}/{self._count[path]}"
        self._count[path] += 1
        # Told apart without colour: the truth leaves balls, the estimate flat squares.
        if path == "truth":
            self._meshcat.SetObject(name, Sphere(0.012), Rgba(0.1, 0.1, 0.1, 1.0))
        else:
            self._meshcat.SetObject(name, Box(0.04, 0.04, 0.003), Rgba(0.9, 0.2, 0.2, 1.0))
        self._meshcat.SetTransform(name, spatial_pose(pose, 0.008))
        if t > 0:
            self._meshcat.SetProperty(name, "visible", False, 0.0)
        self._meshcat.SetProperty(name, "visible", True, t)
