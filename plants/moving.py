"""Cylinders that travel back and forth, blind or with courtesy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Cylinder
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    ModelInstanceIndex,
    PdControllerGains,
    PrismaticJoint,
    SpatialInertia,
)
from pydrake.systems.framework import (
    Context,
    DiscreteValues,
    InputPort,
    LeafSystem,
    OutputPort,
)

from plants.obstacles import CylinderObstacle, require_point
from plants.planar_shapes import PlanarShapes
from systems.periods import period
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

MODEL = "moving_obstacles"

# What drives a cylinder: as a person pushes a cart. It follows its path within 2 cm, is not shoved
# aside by a robot of a few kilograms, and stalls, instead of crushing, when it meets a wall.
_MASS = 10.0  # kg
_STIFFNESS = 4000.0  # N/m
_DAMPING = 400.0  # N s/m: critical, 2 sqrt(stiffness mass)
_MAX_FORCE = 50.0  # N, along each axis
_GAP = 0.001  # m between cylinder and ground, which do not touch
_COLOUR = np.array([0.80, 0.45, 0.15, 1.0])


@dataclass
class MovingCylinder:
    """A cylinder that travels along a path and back, for ever.

    It starts at the first point at once, and rests for `pause` at both ends of the path.

    Attributes:
        radius: m.
        height: m.
        path: [[x, y], ...], at least two points, m.
        speed: m/s.
        pause: at each end, s.
        courtesy: it waits while the middle of a robot is ahead of it and nearer to its surface than
            this, m; with 0 it looks for nobody.
    """

    radius: float
    path: list[list[float]]
    speed: float
    height: float = 0.6
    pause: float = 0.0
    courtesy: float = 0.0

    def __post_init__(self) -> None:
        require_positive(radius=self.radius, height=self.height, speed=self.speed)
        require_non_negative(pause=self.pause, courtesy=self.courtesy)
        require(len(self.path) > 1, "path", self.path, "at least two points [x, y]")
        for k, point in enumerate(self.path):
            require_point(f"path[{k}]", point)
        for k, (a, b) in enumerate(zip(self.path[:-1], self.path[1:], strict=True)):
            require(a != b, f"path[{k + 1}]", b, "another point than the one before")

    def motion(self, t: float) -> tuple[Array, Array]:
        """Returns where the axis is, (2,) m, and its velocity, (2,) m/s, t s after the start."""
        points = np.array(self.path)
        legs = np.diff(points, axis=0)
        lengths = np.sqrt((legs * legs).sum(axis=1))
        ends = np.cumsum(lengths)
        way = ends[-1] / self.speed  # s
        phase = t % (2 * (way + self.pause))
        back = phase >= way + self.pause
        if back:
            phase -= way + self.pause
        along = min(phase, way) * self.speed
        if back:
            along = ends[-1] - along
        leg = min(int(np.searchsorted(ends, along, side="right")), len(legs) - 1)
        direction = legs[leg] / lengths[leg]
        position = points[leg] + direction * (along - ends[leg] + lengths[leg])
        pace = 0.0 if phase >= way else -self.speed if back else self.speed
        return position, pace * direction

    def is_hindered(self, t: float, robots: Array) -> bool:
        """Whether one of the robots (k, 2) m is so near ahead that courtesy makes it wait."""
        position, velocity = self.motion(t)
        offset = robots - position
        near = np.hypot(offset[:, 0], offset[:, 1]) - self.radius < self.courtesy
        return bool((near & (offset @ velocity > 0)).any())

    def at_start(self) -> CylinderObstacle:
        """Returns the cylinder as it stands at t = 0."""
        return CylinderObstacle(self.path[0], self.radius, self.height)

    def swept(self) -> PlanarShapes:
        """Returns the ground that it covers in the course of time: one shape for each leg."""
        points = np.array(self.path)
        legs = np.diff(points, axis=0)
        lengths = np.hypot(*legs.T)
        return PlanarShapes(
            centres=(points[:-1] + points[1:]) / 2,
            headings=np.arctan2(legs[:, 1], legs[:, 0]),
            sizes=np.column_stack([lengths, np.zeros_like(lengths)]),
            radii=np.full(len(legs), self.radius),
        )


class MovingObstacles(LeafSystem):
    """Says where moving cylinders are to be.

    .. pydrake_system::

        name: MovingObstacles
        input_ports:
        - robots
        output_ports:
        - positions
        - desired_state

    Args:
        cylinders: at least one.
        robots: how many robots they may have to wait for.
        rate: how often they look for them, Hz.

    Ports:
        robots (input, vector of 3 for each robot): [x (m), y (m), theta (rad), ...] of base_link in
            the world. May be left unconnected; then nobody waits.
        positions (output, vector of 2 for each cylinder): [x, y, ...] of their axes in the world,
            m.
        desired_state (output, vector of 4 for each cylinder): for the actuators of
            `add_moving_cylinders`: displacements from the first points of the paths [x, y, ...]
            (m), then all velocities [x, y, ...] (m/s).
    """

    def __init__(
        self, *, cylinders: Sequence[MovingCylinder], robots: int = 0, rate: float = 50.0
    ) -> None:
        super().__init__()
        require(len(cylinders) > 0, "cylinders", cylinders, "at least one")
        require_positive(rate=rate)
        self._cylinders = tuple(cylinders)
        self._starts = starting_points(cylinders)
        n = len(cylinders)
        self._robots_input = self.DeclareVectorInputPort("robots", 3 * robots)
        # How long each has waited before, and since when it waits; NaN while it travels.
        self._waited = self.DeclareDiscreteState(np.zeros(n))
        self._since = self.DeclareDiscreteState(np.full(n, np.nan))
        if robots and any(cylinder.courtesy > 0 for cylinder in cylinders):
            self.DeclarePeriodicDiscreteUpdateEvent(period(rate), 0.0, self._look)
        depends_on = {self.time_ticket(), self.xd_ticket()}
        self._positions_output = self.DeclareVectorOutputPort(
            "positions", 2 * n, self._calc_positions, depends_on
        )
        self._desired_state_output = self.DeclareVectorOutputPort(
            "desired_state", 4 * n, self._calc_desired_state, depends_on
        )

    def robots_input_port(self) -> InputPort:
        """Returns the port of the robots' poses."""
        return self._robots_input

    def positions_output_port(self) -> OutputPort:
        """Returns the port of the positions."""
        return self._positions_output

    def desired_state_output_port(self) -> OutputPort:
        """Returns the port of displacements and velocities."""
        return self._desired_state_output

    def _look(self, context: Context, discrete_state: DiscreteValues) -> None:
        if not self._robots_input.HasValue(context):
            return
        now = context.get_time()
        robots = self._robots_input.Eval(context).reshape(-1, 3)[:, :2]
        waited = context.get_discrete_state(self._waited).get_value().copy()
        since = context.get_discrete_state(self._since).get_value().copy()
        for k, (cylinder, travelled) in enumerate(self._travelled(context)):
            if cylinder.is_hindered(travelled, robots):
                since[k] = now if np.isnan(since[k]) else since[k]
            elif not np.isnan(since[k]):
                waited[k] += now - since[k]
                since[k] = np.nan
        discrete_state.set_value(self._waited, waited)
        discrete_state.set_value(self._since, since)

    def _travelled(self, context: Context) -> list[tuple[MovingCylinder, float]]:
        """Returns each cylinder and for how long it has travelled or paused, s."""
        since = context.get_discrete_state(self._since).get_value()
        waited = context.get_discrete_state(self._waited).get_value()
        times = np.where(np.isnan(since), context.get_time(), since) - waited
        return list(zip(self._cylinders, times.tolist(), strict=True))

    def _calc_positions(self, context: Context, output: Any) -> None:
        output.SetFromVector(np.concatenate([c.motion(t)[0] for c, t in self._travelled(context)]))

    def _calc_desired_state(self, context: Context, output: Any) -> None:
        positions, velocities = zip(
            *(c.motion(t) for c, t in self._travelled(context)), strict=True
        )
        waiting = ~np.isnan(context.get_discrete_state(self._since).get_value())
        rates = np.where(waiting[:, None], 0.0, velocities)
        displacements = np.concatenate(positions) - self._starts
        output.SetFromVector(np.concatenate([displacements, rates.ravel()]))


def starting_points(cylinders: Sequence[MovingCylinder]) -> Array:
    """Returns [x, y, ...] of the first points of the paths, (2 n,) m."""
    return np.array([cylinder.path[0] for cylinder in cylinders], float).ravel()


def add_moving_cylinders(
    plant: MultibodyPlant, cylinders: Sequence[MovingCylinder], friction: CoulombFriction
) -> ModelInstanceIndex:
    """Adds moving cylinders to a plant, each at the first point of its path.

    A cylinder slides along x and y, driven by actuators of limited force that follow the model
    instance's `desired_state` port (see `MovingObstacles`). Its positions are displacements from
    the first point, so the plant's default, zero, is where it stands at t = 0.

    Args:
        plant: not finalized yet.
        cylinders: the cylinders.
        friction: of their surfaces.

    Returns:
        The model instance of all of them.
    """
    model = plant.AddModelInstance(MODEL)
    for index, cylinder in enumerate(cylinders):
        name = f"moving_{index}"
        r, h = cylinder.radius, cylinder.height
        start = plant.AddFrame(
            FixedOffsetFrame(
                f"{name}_start",
                plant.world_frame(),
                RigidTransform([*cylinder.path[0], _GAP + h / 2]),
                model,
            )
        )
        # Half of the mass rides on the first slide alone; a slide without any would do as well.
        inertia = SpatialInertia.SolidCylinderWithMass(_MASS / 2, r, h, np.array([0.0, 0.0, 1.0]))
        slide = plant.AddRigidBody(f"{name}_slide", model, inertia)
        body = plant.AddRigidBody(name, model, inertia)
        frames = [start, slide.body_frame(), body.body_frame()]
        for axis, direction in enumerate(np.eye(3)[:2]):
            joint = plant.AddJoint(
                PrismaticJoint(
                    f"{name}_{'xy'[axis]}", frames[axis], frames[axis + 1], direction, damping=0.0
                )
            )
            actuator = plant.AddJointActuator(f"{name}_{'xy'[axis]}", joint, _MAX_FORCE)
            actuator.set_controller_gains(PdControllerGains(p=_STIFFNESS, d=_DAMPING))
        shape = Cylinder(r, h)
        plant.RegisterCollisionGeometry(body, RigidTransform(), shape, name, friction)
        plant.RegisterVisualGeometry(body, RigidTransform(), shape, name, _COLOUR)
    return model
