"""What Meshcat shows of a robot on a shell beyond the geometry: estimate, covariance, paths.

The replay keeps transforms and properties, not changes of shape. So the ellipse is a disc that is
scaled, the interval of the heading lies between two needles that turn, and the paths are marks that
appear one after the other.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import Box, Cylinder, Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, InputPort, LeafSystem

from diagrams.viewer import ellipse
from plants.shell import ShellParameters
from plants.snailbot import SnailBotParameters, wheel_centres
from systems.periods import period
from systems.validation import require_positive

Array = NDArray[np.float64]

_SIGMAS = 1.96  # half the 95 % interval of one number, in standard deviations
_STEP = 0.08  # rad between two marks of a path
_UNKNOWN = math.radians(60.0)  # standard deviation of the orientation from which it is not shown
_ABOVE = 0.004  # m; the ellipse floats over the robot, which would hide it
_SMALLEST = 5e-4  # m, semi-axis of an ellipse that one still sees
_GHOST = Rgba(0.9, 0.2, 0.2, 0.35)
_RED = Rgba(0.9, 0.2, 0.2, 1.0)
_BLACK = Rgba(0.05, 0.05, 0.05, 1.0)
_YELLOW = Rgba(1.0, 0.85, 0.1, 0.7)


def place_ellipse(R_RB: Array, covariance: Array) -> tuple[float, float, float]:
    """Returns the 95 % ellipse of the place on the shell: a >= b (m), direction of a in B (rad).

    Args:
        R_RB: (3, 3).
        covariance: (6, 6) in R, rotation first (rad), then the position (m).
    """
    tangent = R_RB[:, :2]
    return ellipse(tangent.T @ covariance[3:, 3:] @ tangent)


def heading_interval(R_RB: Array, covariance: Array) -> float:
    """Returns half the 95 % interval of the heading about the outward normal, rad.

    Args:
        R_RB: (3, 3).
        covariance: (6, 6) in R, rotation first (rad).
    """
    normal = R_RB[:, 2]
    variance = float(normal @ covariance[:3, :3] @ normal)
    return _SIGMAS * math.sqrt(max(variance, 0.0))


class ShellViewer(LeafSystem):
    """Shows the estimated pose on a shell as a ghost, its covariance above it, and both paths.

    .. pydrake_system::

        name: ShellViewer
        input_ports:
        - pose
        - covariance
        - reference_pose
        - truth

    Over the ghost float the 95 % ellipse of the place, as a disc, and the 95 % interval of the
    heading, between two needles: both `magnification` times as large as they are, since the
    estimates are better than a picture of the whole shell shows.

    Args:
        meshcat: where.
        body: dimensions of the ghost.
        shell: what it stands on.
        rate: pictures a second, Hz.
        magnification: of ellipse and interval.
        name: what it is called in Meshcat's tree.

    Ports:
        pose (input, RigidTransform): `X_RB`, the estimate.
        covariance (input, vector of 36): of the estimate, (6, 6) row by row: rotation first, a
            small rotation vector in R (rad), then the position (m). The estimate is hidden while
            its orientation is unknown to 60 degrees.
        reference_pose (input, RigidTransform): `X_WR` of the shell; where it is not connected, the
            world's origin.
        truth (input, RigidTransform): the true `X_RB`, for its path; may be left unconnected.

    A sink: it draws in publish events and influences nothing.

    Raises:
        ValueError: rate or magnification not positive, or a shell too small for the robot.
    """

    def __init__(
        self,
        *,
        meshcat: Meshcat,
        body: SnailBotParameters,
        shell: ShellParameters,
        rate: float,
        magnification: float = 10.0,
        name: str = "robot",
    ) -> None:
        super().__init__()
        require_positive(rate=rate, magnification=magnification)
        self._meshcat = meshcat
        self._radius = shell.radius
        self._magnification = magnification
        self._frame = 1.0 / rate
        self._root = f"view/{name}"
        pose = AbstractValue.Make(RigidTransform())
        self._pose_input = self.DeclareAbstractInputPort("pose", pose)
        self._covariance_input = self.DeclareVectorInputPort("covariance", 36)
        self._reference_input = self.DeclareAbstractInputPort("reference_pose", pose)
        self._truth_input = self.DeclareAbstractInputPort("truth", pose)
        # What the browser holds, not the diagram: where the marks are, what is seen.
        self._marks: dict[str, list[Array]] = {"estimate": [], "truth": []}
        self._visible: bool | None = None  # said anew in the first frame, for the recording
        self._top = body.height + _ABOVE
        self._draw_ghost(body, shell)
        self._draw_covariance(body)
        meshcat.SetProperty(f"{self._root}/estimate", "visible", False, 0.0)
        self.DeclarePeriodicPublishEvent(period(rate), 0.0, self._draw)

    def pose_input_port(self) -> InputPort:
        """Returns the port of the estimated pose."""
        return self._pose_input

    def covariance_input_port(self) -> InputPort:
        """Returns the port of the covariance."""
        return self._covariance_input

    def reference_pose_input_port(self) -> InputPort:
        """Returns the port of the shell's pose."""
        return self._reference_input

    def truth_input_port(self) -> InputPort:
        """Returns the port of the true pose."""
        return self._truth_input

    def _draw_ghost(self, body: SnailBotParameters, shell: ShellParameters) -> None:
        ghost = f"{self._root}/estimate/ghost"
        chassis = Box(body.length, body.width, body.height)
        self._meshcat.SetObject(f"{ghost}/chassis", chassis, _GHOST)
        self._meshcat.SetTransform(f"{ghost}/chassis", RigidTransform([0.0, 0.0, body.height / 2]))
        upright = RotationMatrix.MakeXRotation(math.pi / 2)
        for k, centre in enumerate(wheel_centres(body, shell)):
            wheel = Cylinder(body.wheel_radius, body.wheel_width)
            self._meshcat.SetObject(f"{ghost}/wheel_{k}", wheel, _GHOST)
            self._meshcat.SetTransform(f"{ghost}/wheel_{k}", RigidTransform(upright, centre))

    def _draw_covariance(self, body: SnailBotParameters) -> None:
        above = f"{self._root}/estimate/covariance"
        self._meshcat.SetTransform(above, RigidTransform([0.0, 0.0, self._top]))
        self._meshcat.SetObject(f"{above}/ellipse/disc", Cylinder(1.0, 0.0005), _YELLOW)
        needle = Box(body.length, 0.0012, 0.0012)
        for side in ("left", "right"):
            self._meshcat.SetObject(f"{above}/{side}/needle", needle, _BLACK)
            self._meshcat.SetTransform(
                f"{above}/{side}/needle", RigidTransform([body.length / 2, 0.0, 0.001])
            )

    def _draw(self, context: Context) -> None:
        # Frames of the recording are counted down from t.
        t = (round(context.get_time() / self._frame) + 0.25) * self._frame
        if self._reference_input.HasValue(context):
            self._meshcat.SetTransform(self._root, self._reference_input.Eval(context), t)
        X_RB = self._pose_input.Eval(context)
        covariance = self._covariance_input.Eval(context).reshape(6, 6)
        sound = bool(np.isfinite(X_RB.GetAsMatrix34()).all() and np.isfinite(covariance).all())
        known = sound and float(np.linalg.eigvalsh(covariance[:3, :3])[-1]) < _UNKNOWN**2
        if known != self._visible:
            self._meshcat.SetProperty(f"{self._root}/estimate", "visible", known, t)
            self._visible = known
        if known:
            self._show_estimate(X_RB, covariance, t)
            self._mark("estimate", X_RB, t)
        if self._truth_input.HasValue(context):
            truth = self._truth_input.Eval(context)
            if np.isfinite(truth.GetAsMatrix34()).all():
                self._mark("truth", truth, t)

    def _show_estimate(self, X_RB: RigidTransform, covariance: Array, t: float) -> None:
        self._meshcat.SetTransform(f"{self._root}/estimate", X_RB, t)
        above = f"{self._root}/estimate/covariance"
        R_RB = X_RB.rotation().matrix()
        a, b, direction = place_ellipse(R_RB, covariance)
        size = [min(max(self._magnification * s, _SMALLEST), self._radius) for s in (a, b)]
        turned = RigidTransform(RotationMatrix.MakeZRotation(direction), np.zeros(3))
        self._meshcat.SetTransform(f"{above}/ellipse", turned, t)
        self._meshcat.SetProperty(f"{above}/ellipse/disc", "scale", [*size, 1.0], t)
        half = min(self._magnification * heading_interval(R_RB, covariance), math.pi)
        for side, angle in (("left", half), ("right", -half)):
            turned = RigidTransform(RotationMatrix.MakeZRotation(angle), np.zeros(3))
            self._meshcat.SetTransform(f"{above}/{side}", turned, t)

    def _mark(self, path: str, X_RB: RigidTransform, t: float) -> None:
        """Marks a place of the shell where the path has not been yet."""
        place = X_RB.translation() / np.linalg.norm(X_RB.translation())
        marks = self._marks[path]
        if marks and float((np.array(marks) @ place).max()) > math.cos(_STEP):
            return
        name = f"{self._root}/path of the {path}/{len(marks)}"
        marks.append(place)
        # Told apart without colour: the truth leaves balls, the estimate flat squares.
        if path == "truth":
            self._meshcat.SetObject(name, Sphere(0.0012), _BLACK)
        else:
            self._meshcat.SetObject(name, Box(0.004, 0.004, 0.0005), _RED)
        self._meshcat.SetTransform(name, RigidTransform(X_RB.rotation(), self._radius * place))
        if t > self._frame:
            self._meshcat.SetProperty(name, "visible", False, 0.0)
        self._meshcat.SetProperty(name, "visible", True, t)
