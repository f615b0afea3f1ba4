"""Wheels of robots on the ground: kinematics of two driven sides, and a wheel as a body."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box, Cylinder, Ellipsoid, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    ModelInstanceIndex,
    RevoluteJoint,
    RigidBody,
    SpatialInertia,
)

Array = NDArray[np.float64]


class Sides(Protocol):
    """What the kinematics of two driven sides rest on."""

    @property
    def wheel_radius(self) -> float:
        """Of all wheels, m."""
        ...

    @property
    def base(self) -> float:
        """Distance of two wheels that would turn the robot alike without slip, m."""
        ...


def body_velocity(wheel_speeds: Any, parameters: Sides) -> list[Any]:
    """Returns [v (m/s), omega (rad/s)] of wheel speeds [right, left] (rad/s), without slip.

    v = r (w_r + w_l) / 2, omega = r (w_r - w_l) / b ([NAV]).
    """
    r, b = parameters.wheel_radius, parameters.base
    right, left = wheel_speeds
    return [r * (right + left) / 2, r * (right - left) / b]


def wheel_speeds(command: Any, parameters: Sides) -> list[Any]:
    """Returns the wheel speeds [right, left] (rad/s) of [v (m/s), omega (rad/s)]: the inverse."""
    r, b = parameters.wheel_radius, parameters.base
    v, omega = command
    return [(v + omega * b / 2) / r, (v - omega * b / 2) / r]


def add_wheel(
    plant: MultibodyPlant,
    model: ModelInstanceIndex,
    chassis: RigidBody,
    *,
    name: str,
    position: Array,
    radius: float,
    width: float,
    mass: float,
    friction: CoulombFriction,
    narrow: bool = False,
) -> RevoluteJoint:
    """Adds a wheel that turns about the chassis' y axis; returns its joint, of the same name.

    It meets the ground in one point below its middle, as a sphere does; so it rolls on its radius
    to 0.1 %, where a cylinder loses up to 0.75 %.

    Args:
        plant: not finalized yet.
        model: of the robot.
        chassis: that carries it.
        name: of the wheel, `left_wheel` for example; its axle has the name `left_axle`.
        position: (3,) of its middle in the chassis, m.
        radius: m.
        width: m.
        mass: kg.
        friction: of its tyre.
        narrow: it collides as an ellipsoid of its width, not as a sphere.
    """
    wheel = plant.AddRigidBody(
        name,
        model,
        SpatialInertia.SolidCylinderWithMass(mass, radius, width, np.array([0.0, 1.0, 0.0])),
    )
    axle = plant.AddFrame(
        FixedOffsetFrame(
            name.replace("wheel", "axle"), chassis.body_frame(), RigidTransform(position), model
        )
    )
    joint = plant.AddJoint(RevoluteJoint(name, axle, wheel.body_frame(), np.array([0.0, 1.0, 0.0])))
    plant.RegisterVisualGeometry(
        wheel,
        RigidTransform(RotationMatrix.MakeXRotation(np.pi / 2)),
        Cylinder(radius, width),
        "tyre",
        np.array([0.1, 0.1, 0.1, 1.0]),
    )
    plant.RegisterVisualGeometry(  # a spoke, so that one sees the wheel turn
        wheel,
        RigidTransform(),
        Box(1.6 * radius, 1.02 * width, 0.004),
        "spoke",
        np.array([0.9, 0.9, 0.9, 1.0]),
    )
    shape = Ellipsoid(radius, width / 2, radius) if narrow else Sphere(radius)
    plant.RegisterCollisionGeometry(wheel, RigidTransform(), shape, "tyre", friction)
    return joint


def servo_matrix(plant: MultibodyPlant, model: ModelInstanceIndex) -> Array:
    """Returns the matrix from [right, left] (rad/s) to the `desired_state` of the wheels.

    The speeds are set-points of speed servos, or the `servo_speeds` of `DcMotors`, for all motors
    of a side, whose names end in `right_motor` or `left_motor`. Positions have no gain and the
    gears' friction holds the wheels back toward speed 0.
    """
    actuators = plant.num_actuators(model)
    matrix = np.zeros((2 * actuators, 2))
    for row, index in enumerate(plant.GetJointActuatorIndices(model)):
        name = plant.get_joint_actuator(index).name()
        for side, motor in enumerate(("right_motor", "left_motor")):
            matrix[actuators + row, side] = name.endswith(motor)
    return matrix


def joint_matrices(plant: MultibodyPlant, model: ModelInstanceIndex) -> tuple[Array, Array]:
    """Returns what makes [right, left] of a model's state: of its wheels' angles, of their rates.

    A side's is the mean of its wheels', whose joints end in `right_wheel` or `left_wheel`.
    """
    positions, velocities = plant.num_positions(model), plant.num_velocities(model)
    angles = np.zeros((2, positions + velocities))
    rates = np.zeros_like(angles)
    first_q = plant.GetBodyByName("base_link", model).floating_positions_start()
    first_v = plant.GetBodyByName("base_link", model).floating_velocities_start_in_v()
    for index in plant.GetJointIndices(model):
        joint = plant.get_joint(index)
        for side, wheel in enumerate(("right_wheel", "left_wheel")):
            if joint.name().endswith(wheel):
                angles[side, joint.position_start() - first_q] = 1.0
                rates[side, positions + joint.velocity_start() - first_v] = 1.0
    return (
        angles / angles.sum(axis=1, keepdims=True),
        rates / rates.sum(axis=1, keepdims=True),
    )
