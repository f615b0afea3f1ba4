"""What Meshcat shows of a formation beyond the geometry: turns, triangles, ways, estimates.

The replay keeps transforms and properties, not changes of shape, and glides from one value to the
next. So what belongs to one move is drawn once, at its place, and shown while the move lasts; and
what is moved is told its old place again a frame before it gets another one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import Box, Cylinder, Meshcat, MeshcatCone, Rgba, Shape, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import Context, InputPort, LeafSystem

from diagrams.surroundings_viewer import along
from diagrams.viewer import ellipse
from systems.periods import period
from systems.planners.formation_course import FormationMove
from systems.planners.formation_turns import RECORD_SIZE
from systems.validation import require, require_positive

Array = NDArray[np.float64]

_ROOT = "view"
_STEP = 0.10  # m between two marks of a way
_DOTS = 0.12  # m between two dots of a planned path
_DASH = 0.15  # m, a dash with the gap after it
_MAGNIFIED = 10.0  # times, of the larger one of a robot's two ellipses
_LARGEST = 0.75  # m, semi-axis of an ellipse that is still drawn
_SMALLEST = 0.004  # m, that one still sees
_FLOOR = 0.006  # m, height of what is drawn on the ground
_ABOVE = 0.30  # m; estimates float over the robots, which would hide them
_LIGHTS = (
    ("AmbientLight", "intensity", 2.8),
    ("SpotLight", "visible", False),
    ("PointLightNegativeX", "visible", False),
    ("PointLightPositiveX", "visible", False),
)
_WHITE = Rgba(0.95, 0.95, 0.95, 1.0)
_BLACK = Rgba(0.05, 0.05, 0.05, 1.0)
_BLUE = Rgba(0.1, 0.3, 0.9, 1.0)
_GREEN = Rgba(0.2, 0.6, 0.3, 0.9)
_RED = Rgba(0.9, 0.2, 0.2, 1.0)
_ORANGE = Rgba(1.0, 0.5, 0.0, 1.0)
_YELLOW = Rgba(1.0, 0.85, 0.1, 0.5)


def dashes(a: Array, b: Array, dash: float) -> list[tuple[Array, Array]]:
    """Returns the ends (2,) of dashes on the line from a to b, as long as the gaps after them."""
    length = float(np.linalg.norm(b - a))
    count = max(1, math.ceil(length / dash - 1e-9))
    way = (b - a) / max(length, 1e-9)
    starts = dash * np.arange(count)
    return [(a + s * way, a + min(s + dash / 2, length) * way) for s in starts]


class _Object:
    """An object in Meshcat whose place and properties change; only what changes is sent."""

    def __init__(self, meshcat: Meshcat, name: str, frame: float) -> None:
        self._meshcat = meshcat
        self._name = name
        self._frame = frame  # s between two pictures
        self._said: dict[str, tuple[Any, float]] = {}

    def place(self, pose: tuple[float, float, float, float], t: float) -> None:
        """Puts it to [x (m), y (m), z (m), yaw (rad)]."""
        x, y, z = (round(v, 3) for v in pose[:3])  # finer nobody sees
        yaw = round(pose[3], 2)
        X = RigidTransform(RollPitchYaw(0.0, 0.0, yaw), [x, y, z])
        self._say(
            "", (x, y, z, yaw), X, t, lambda X, t: self._meshcat.SetTransform(self._name, X, t)
        )

    def set(self, key: str, value: Any, t: float) -> None:
        """Sets a property."""
        self._say(
            key, value, value, t, lambda v, t: self._meshcat.SetProperty(self._name, key, v, t)
        )

    def _move(self, X: RigidTransform, t: float) -> None:
        self._meshcat.SetTransform(self._name, X, t)

    def _say(
        self, key: str, identity: Any, value: Any, t: float, send: Callable[[Any, float], None]
    ) -> None:
        if key in self._said:
            (old_identity, old_value), since = self._said[key]
            if old_identity == identity:
                return
            if t - since > 1.5 * self._frame:
                send(old_value, t - self._frame)
        send(value, t)
        self._said[key] = (identity, value), t


class FormationViewer(LeafSystem):
    """Shows whose turn it is, the triangles, the mover's way, and where the robots are believed.

    .. pydrake_system::

        name: FormationViewer
        input_ports:
        - move
        - moving
        - record
        - positions
        - poses
        - covariance
        - truth_{k}

    The robot that moves has an arrow over it and a ring below it. Of its move one sees the triangle
    of its beacons (black lines), the sides that it is to build (blue dashes), its planned path
    (blue dots, a large one at each centre point) and the vertex (a blue disc); sides that were
    built stay as white lines. Robots leave black balls where they have been, flat red squares where
    that is only believed. Over each robot floats a red pin at the estimate, with a needle along its
    heading, and the 95 % ellipse twice: as it is (orange, at least 4 mm) and ten times as large
    (yellow, as long as it is below 0.75 m). All of that is hidden while nothing is known of the
    robot, as it may be while it moves.

    Args:
        meshcat: where; its lights are made even, as a formation crosses a wide ground.
        robots: how many, N.
        destination: (2,) m in map, shown as a green post.
        rate: pictures a second, Hz.

    Ports:
        move (input, FormationMove): what the formation is at.
        moving (input, vector of N): other than 0 for the robot that moves.
        record (input, vector of 10): of the last move that ended, see `FormationTurns`.
        positions (input, vector of 2 N): x, y of the robots as they are believed to be, m in map.
        poses (input, vector of 3 N): [x (m), y (m), theta (rad)] of the estimator; unconnected,
            pins without needles and ellipses stand at `positions`.
        covariance (input, vector of 9 N N): (3 N, 3 N) of them, row by row, if `poses`
            are connected.
        truth_{k} (input, vector of 3): true pose of robot k, from 0; may be left unconnected.

    A sink: it draws in publish events and influences nothing.

    Raises:
        ValueError: no robots, a destination that is not finite, or a rate out of range.
    """

    def __init__(self, *, meshcat: Meshcat, robots: int, destination: Array, rate: float) -> None:
        super().__init__()
        require_positive(rate=rate)
        require(robots >= 1, "robots", robots, "1 or more")
        place = np.array(destination, float)
        sound = place.shape == (2,) and bool(np.isfinite(place).all())
        require(sound, "destination", place.tolist(), "[x, y] in metres")
        self._meshcat = meshcat
        self._robots = robots
        self._frame = 1.0 / rate
        self._move_input = self.DeclareAbstractInputPort(
            "move", AbstractValue.Make(FormationMove())
        )
        self._moving_input = self.DeclareVectorInputPort("moving", robots)
        self._record_input = self.DeclareVectorInputPort("record", RECORD_SIZE)
        self._positions_input = self.DeclareVectorInputPort("positions", 2 * robots)
        self._poses_input = self.DeclareVectorInputPort("poses", 3 * robots)
        self._covariance_input = self.DeclareVectorInputPort("covariance", 9 * robots**2)
        self._truth_inputs = [self.DeclareVectorInputPort(f"truth_{k}", 3) for k in range(robots)]
        # What the browser holds, not the diagram: the move on show, the last one that ended, marks.
        self._shown: FormationMove | None = None
        self._ended = 0
        self._last: dict[str, Array] = {}
        self._known = [False] * robots
        self._count = 0
        self._turn = [self._draw_turn(f"{_ROOT}/robot{k + 1}/turn") for k in range(robots)]
        self._pins = [self._draw_pin(f"{_ROOT}/robot{k + 1}/estimate") for k in range(robots)]
        self._draw_destination(place)
        for light, key, value in _LIGHTS:
            meshcat.SetProperty(f"/Lights/{light}/<object>", key, value)
        self.DeclarePeriodicPublishEvent(period(rate), 0.0, self._draw)

    def move_input_port(self) -> InputPort:
        """Returns the port of the present move."""
        return self._move_input

    def moving_input_port(self) -> InputPort:
        """Returns the port of who moves."""
        return self._moving_input

    def record_input_port(self) -> InputPort:
        """Returns the port of the last move that ended."""
        return self._record_input

    def positions_input_port(self) -> InputPort:
        """Returns the port of the believed positions."""
        return self._positions_input

    def poses_input_port(self) -> InputPort:
        """Returns the port of the estimated poses."""
        return self._poses_input

    def covariance_input_port(self) -> InputPort:
        """Returns the port of the covariance."""
        return self._covariance_input

    def truth_input_port(self, robot: int) -> InputPort:
        """Returns the port of a robot's true pose."""
        return self._truth_inputs[robot]

    # --- What is there from the start ---

    def _draw_turn(self, name: str) -> _Object:
        """Draws the mark of a robot whose turn it is: an arrow over it, a ring below it."""
        self._meshcat.SetObject(f"{name}/arrow", MeshcatCone(0.16, 0.07, 0.07), _ORANGE)
        self._meshcat.SetTransform(f"{name}/arrow", RigidTransform([0.0, 0.0, 0.55]))
        self._meshcat.SetObject(f"{name}/ring", Cylinder(0.28, 0.003), Rgba(1.0, 0.5, 0.0, 0.6))
        self._meshcat.SetTransform(f"{name}/ring", RigidTransform([0.0, 0.0, 0.004]))
        return self._object(name)

    def _draw_pin(self, name: str) -> dict[str, _Object]:
        """Draws the estimate of a robot."""
        self._meshcat.SetObject(f"{name}/pin", Cylinder(0.008, 0.06), _RED)
        self._meshcat.SetTransform(f"{name}/pin", RigidTransform([0.0, 0.0, 0.03]))
        self._meshcat.SetObject(f"{name}/needle", Box(0.2, 0.008, 0.008), _RED)
        self._meshcat.SetTransform(f"{name}/needle", RigidTransform([0.1, 0.0, 0.056]))
        heights = {"ellipse": (_ORANGE, 0.01), "ten times": (_YELLOW, 0.0)}
        for part, (colour, height) in heights.items():
            self._meshcat.SetObject(f"{name}/{part}/disc", Cylinder(1.0, 0.002), colour)
            self._meshcat.SetTransform(f"{name}/{part}/disc", RigidTransform([0.0, 0.0, height]))
        parts = ["", "/needle", *(f"/{part}{disc}" for part in heights for disc in ("", "/disc"))]
        return {part: self._object(f"{name}{part}") for part in parts}

    def _draw_destination(self, place: Array) -> None:
        name = f"{_ROOT}/destination"
        self._meshcat.SetTransform(name, RigidTransform([*place, 0.0]))
        self._meshcat.SetObject(f"{name}/post", Cylinder(0.015, 0.5), _GREEN)
        self._meshcat.SetTransform(f"{name}/post", RigidTransform([0.0, 0.0, 0.25]))
        self._meshcat.SetObject(f"{name}/top", Sphere(0.05), _GREEN)
        self._meshcat.SetTransform(f"{name}/top", RigidTransform([0.0, 0.0, 0.5]))

    def _object(self, name: str) -> _Object:
        return _Object(self._meshcat, name, self._frame)

    # --- One picture ---

    def _draw(self, context: Context) -> None:
        # Frames of the recording are counted down from t.
        t = (round(context.get_time() / self._frame) + 0.25) * self._frame
        positions = self._positions_input.Eval(context).reshape(-1, 2)
        truth = self._truth(context)
        self._show_estimates(context, positions, t)
        self._show_turns(self._moving_input.Eval(context), positions, truth, t)
        self._show_built(self._record_input.Eval(context), positions, t)
        self._show_move(self._move_input.Eval(context), positions, t)
        for k in range(self._robots):
            if self._truth_inputs[k].HasValue(context):
                if k in truth:
                    self._mark(f"true way of robot{k + 1}", truth[k][:2], t)
            elif self._known[k]:
                self._mark(f"estimated way of robot{k + 1}", positions[k], t)

    def _truth(self, context: Context) -> dict[int, Array]:
        poses = {
            k: port.Eval(context)
            for k, port in enumerate(self._truth_inputs)
            if port.HasValue(context)
        }
        return {k: pose for k, pose in poses.items() if np.isfinite(pose).all()}

    def _show_turns(
        self, moving: Array, positions: Array, truth: dict[int, Array], t: float
    ) -> None:
        for k, turn in enumerate(self._turn):
            place = truth.get(k, positions[k])
            visible = bool(moving[k] != 0 and np.isfinite(place).all())
            turn.set("visible", visible, t)
            if visible:
                turn.place((float(place[0]), float(place[1]), 0.0, 0.0), t)

    def _show_estimates(self, context: Context, positions: Array, t: float) -> None:
        poses, P = None, None
        if self._poses_input.HasValue(context):
            poses = self._poses_input.Eval(context).reshape(-1, 3)
            size = 3 * self._robots
            P = self._covariance_input.Eval(context).reshape(size, size)
        for k, pin in enumerate(self._pins):
            x, y = positions[k] if poses is None else poses[k, :2]
            block = None if P is None else P[3 * k : 3 * k + 2, 3 * k : 3 * k + 2]
            known = math.isfinite(x + y) and (
                block is None or bool(np.isfinite(block).all() and np.trace(block) < _LARGEST**2)
            )
            pin[""].set("visible", known, t)
            self._known[k] = known
            if not known:
                continue
            heading = 0.0 if poses is None else float(poses[k, 2])
            pin[""].place((float(x), float(y), _ABOVE, heading), t)
            pin["/needle"].set("visible", poses is not None, t)
            for part, factor in (("/ellipse", 1.0), ("/ten times", _MAGNIFIED)):
                self._show_ellipse(pin, part, block, factor, heading, t)

    def _show_ellipse(
        self,
        pin: dict[str, _Object],
        part: str,
        block: Array | None,
        factor: float,
        heading: float,
        t: float,
    ) -> None:
        a, b, direction = (0.0, 0.0, 0.0) if block is None else ellipse(block)
        visible = block is not None and factor * a < _LARGEST
        pin[part].set("visible", visible, t)
        if visible:
            # The pin has turned with the robot, the ellipse is that of the map.
            pin[part].place((0.0, 0.0, 0.0, direction - heading), t)
            size = [float(f"{max(factor * s, _SMALLEST):.2g}") for s in (a, b)]
            pin[f"{part}/disc"].set("scale", [*size, 1.0], t)

    def _show_move(self, move: FormationMove, positions: Array, t: float) -> None:
        """Shows the plan of a new move, in place of the one before."""
        shown = self._shown
        if shown is not None and shown.number == move.number and shown.status == move.status:
            return
        if shown is not None and shown.status == "moving":
            self._meshcat.SetProperty(f"{_ROOT}/moves/{shown.number}", "visible", False, t)
        self._shown = move
        if move.status != "moving":
            return
        name = f"{_ROOT}/moves/{move.number}"
        stand, target = positions[move.beacons], move.target
        for k in range(3):
            self._line(f"{name}/beacons/{k}", stand[k - 1], stand[k], 0.025, _BLACK)
        for k in range(2):
            for i, (a, b) in enumerate(dashes(stand[k], target, _DASH)):
                self._line(f"{name}/sides to build/{k}/{i}", a, b, 0.025, _BLUE)
        way = np.vstack([positions[move.mover], move.points])
        for i, place in enumerate(along(way, _DOTS)):
            self._put(f"{name}/path/{i}", Cylinder(0.018, 0.004), _BLUE, place)
        for i, place in enumerate(move.points[:-1]):
            self._put(f"{name}/centre points/{i}", Cylinder(0.05, 0.004), _BLUE, place)
        self._put(f"{name}/vertex", Cylinder(0.12, 0.003), Rgba(0.1, 0.3, 0.9, 0.5), target)
        self._appear(name, t)

    def _show_built(self, record: Array, positions: Array, t: float) -> None:
        """Draws the sides that a move has built, for good."""
        number, _, one, two, _, x, y, outcome, *_ = record
        if number <= self._ended:
            return
        self._ended = int(number)
        if outcome > 0:
            name = f"{_ROOT}/built/{self._ended}"
            for k, beacon in enumerate((int(one), int(two))):
                ends = positions[beacon], np.array([x, y])
                self._line(f"{name}/{k}", *ends, 0.012, _WHITE, height=0.003)
            self._appear(name, t)

    def _mark(self, way: str, place: Array, t: float) -> None:
        """Marks a way when the robot has come far enough."""
        last = self._last.get(way)
        if last is None:
            self._last[way] = place.copy()
        if last is None or np.hypot(*(place - last)) < _STEP:
            return
        self._last[way] = place.copy()
        self._count += 1
        name = f"{_ROOT}/{way}/{self._count}"
        # Told apart without colour: the truth leaves balls, the estimate flat squares.
        if way.startswith("true"):
            self._put(name, Sphere(0.014), _BLACK, place)
        else:
            self._put(name, Box(0.06, 0.06, 0.003), _RED, place)
        self._appear(name, t)

    def _line(
        self, name: str, a: Array, b: Array, width: float, colour: Rgba, height: float = _FLOOR
    ) -> None:
        way = b - a
        shape = Box(float(np.hypot(*way)) + 1e-6, width, 0.004)
        self._put(name, shape, colour, (a + b) / 2, math.atan2(way[1], way[0]), height)

    def _put(
        self,
        name: str,
        shape: Shape,
        colour: Rgba,
        place: Array,
        heading: float = 0.0,
        height: float = _FLOOR,
    ) -> None:
        self._meshcat.SetObject(name, shape, colour)
        X = RigidTransform(RollPitchYaw(0.0, 0.0, heading), [place[0], place[1], height])
        self._meshcat.SetTransform(name, X)

    def _appear(self, name: str, t: float) -> None:
        """Shows from now on what was just drawn."""
        if t > self._frame:
            self._meshcat.SetProperty(name, "visible", False, 0.0)
        self._meshcat.SetProperty(name, "visible", True, t)
