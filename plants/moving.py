"""Cylinders that travel back and forth: where they are is a function of time alone."""

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
from pydrake.systems.framework import Context, LeafSystem, OutputPort

from plants.obstacles import CylinderObstacle, require_point
from plants.planar_shapes import PlanarShapes
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
    """

    radius: float
    path: list[list[float]]
    speed: float
    height: float = 0.6
    pause: float = 0.0

    def __post_init__(self) -> None:
        require_positive(radius=self.radius, height=self.height, speed=self.speed)
        require_non_negative(pause=self.pause)
        require(len(self.path) > 1, "path", self.path, "at least two points [x, y]")
        for k, point in enumerate(self.path):
            require_point(f"path[{k}]", point)
        for k, (a, b) in enumerate(zip(self.path[:-1], self.path[1:], strict=True)):
            require(a != b, f"path[{k + 1}]", b, "another point than the one before")

    def motion(self, t: float) -> tuple[Array, Array]:
        """Returns where the axis is, (2,) m, and its velocity, (2,) m/s, at time t (s)."""
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
        output_ports:
        - positions
        - desired_state

    Args:
        cylinders: at least one.

    Ports:
        positions (output, vector of 2 for each cylinder): [x, y, ...] of their axes in the world,
            m.
        desired_state (output, vector of 4 for each cylinder): for the actuators of
            `add_moving_cylinders`: displacements from the first points of the paths [x, y, ...]
            (m), then all velocities [x, y, ...] (m/s).
    """

    def __init__(self, *, cylinders: Sequence[MovingCylinder]) -> None:
        super().__init__()
        require(len(cylinders) > 0, "cylinders", cylinders, "at least one")
        self._cylinders = tuple(cylinders)
        self._starts = starting_points(cylinders)
        size, time_only = 2 * len(cylinders), {self.time_ticket()}
        self._positions_output = self.DeclareVectorOutputPort(
            "positions", size, self._calc_positions, time_only
        )
        self._desired_state_output = self.DeclareVectorOutputPort(
            "desired_state", 2 * size, self._calc_desired_state, time_only
        )

    def positions_output_port(self) -> OutputPort:
        """Returns the port of the positions."""
        return self._positions_output

    def desired_state_output_port(self) -> OutputPort:
        """Returns the port of displacements and velocities."""
        return self._desired_state_output

    def _calc_positions(self, context: Context, output: Any) -> None:
        t = context.get_time()
        output.SetFromVector(np.concatenate([c.motion(t)[0] for c in self._cylinders]))

    def _calc_desired_state(self, context: Context, output: Any) -> None:
        t = context.get_time()
        positions, velocities = zip(*(c.motion(t) for c in self._cylinders), strict=True)
        displacements = np.concatenate(positions) - self._starts
        output.SetFromVector(np.concatenate([displacements, *velocities]))


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
