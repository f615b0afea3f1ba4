"""A robot on two driven wheels and casters: wheel kinematics, multibody model, kinematic twin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.geometry import Box, Sphere
from pydrake.math import RigidTransform, cos, sin
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import (
    ModelInstanceIndex,
    PdControllerGains,
    RevoluteJoint,
    SpatialInertia,
)
from pydrake.systems.framework import BasicVector_, LeafSystem_
from pydrake.systems.scalar_conversion import TemplateSystem

from plants.motors import MotorModel
from plants.wheels import Sides, add_wheel, body_velocity, servo_matrix, wheel_speeds
from systems.validation import require, require_positive

_WHEEL_FRICTION = CoulombFriction(1.0, 1.0)
_NO_FRICTION = CoulombFriction(0.0, 0.0)
__all__ = [
    "DifferentialDriveParameters",
    "KinematicDifferentialDrive",
    "KinematicDifferentialDrive_",
    "add_differential_drive",
    "body_velocity",
    "hull",
    "hull_radius",
    "servo_matrix",
    "wheel_speeds",
]

_CREEP = 1e-3  # rad/s, at which a wheel held by its gear's friction gives way


@dataclass
class DifferentialDriveParameters:
    """Dimensions and masses of the robot, SI units. The paper gives none: these are ours.

    Attributes:
        wheel_radius: m.
        base: distance between the wheels' planes, m.
        wheel_width: m.
        wheel_mass: of one wheel, kg.
        length: of the chassis, m.
        width: of the chassis, m; it must fit between the wheels.
        height: of the chassis, m.
        clearance: from the ground to the chassis, m.
        mass: of the chassis with all it carries, kg.
        caster_radius: m.
        servo_gain: torque by error of wheel speed, N m s/rad; of servos, not of motors.
        max_torque: of one wheel's servo, N m.
    """

    wheel_radius: float = 0.0325
    base: float = 0.16
    wheel_width: float = 0.026
    wheel_mass: float = 0.035
    length: float = 0.22
    width: float = 0.12
    height: float = 0.07
    clearance: float = 0.025
    mass: float = 1.1
    caster_radius: float = 0.0125
    servo_gain: float = 0.5
    max_torque: float = 0.15

    def __post_init__(self) -> None:
        require_positive(**vars(self))
        require(
            self.width <= self.base - self.wheel_width,
            "width",
            self.width,
            f"at most base - wheel_width = {self.base - self.wheel_width:.3g} m",
        )
        require(
            2 * self.caster_radius <= self.clearance,
            "caster_radius",
            self.caster_radius,
            f"at most half the clearance of {self.clearance:.3g} m",
        )


def hull_radius(parameters: DifferentialDriveParameters) -> float:
    """Returns the radius of the smallest circle about base_link that holds the robot, m."""
    chassis = np.hypot(parameters.length / 2, parameters.width / 2)
    wheels = np.hypot(parameters.wheel_radius, (parameters.base + parameters.wheel_width) / 2)
    return float(max(chassis, wheels))


def hull(parameters: DifferentialDriveParameters) -> list[float]:
    """Returns [front, rear, half_width] (m): the rectangle about base_link that holds the robot.

    To the sides it holds the spheres that the wheels collide as.
    """
    end = max(parameters.length / 2, parameters.wheel_radius)
    return [
        end,
        end,
        parameters.base / 2 + max(parameters.wheel_radius, parameters.wheel_width / 2),
    ]


def add_differential_drive(
    plant: MultibodyPlant,
    parameters: DifferentialDriveParameters,
    name: str,
    motor: MotorModel | None = None,
) -> ModelInstanceIndex:
    """Adds the robot to a plant.

    The body `base_link` has its origin on the ground below the middle of the axle, x forward, y
    left, z up (REP 103, 105). Wheels collide as spheres and casters slide without friction: so the
    robot follows its kinematics to 0.1 % (cylinders lose up to 0.75 %).

    The wheels are driven through the instance's `desired_state` port: see `servo_matrix`. Without a
    motor the actuators are speed servos of `servo_gain` and `max_torque`. With one they make the
    torque of `plants.motors.DcMotors`, whatever the ground can bear of it: past the friction cone
    the wheel slips. The rotors' inertia is added, and the gears' friction.

    Args:
        plant: not finalized yet.
        parameters: dimensions.
        name: of the model instance.
        motor: what turns each wheel; None for a speed servo.

    Returns:
        The model instance.
    """
    p = parameters
    model = plant.AddModelInstance(name)
    middle = p.clearance + p.height / 2
    inertia = SpatialInertia.SolidBoxWithMass(p.mass, p.length, p.width, p.height)
    # The chassis' mass lies low (batteries, motors): at axle height, not at the box's centre.
    chassis = plant.AddRigidBody(
        "base_link", model, inertia.Shift(np.array([0.0, 0.0, -p.wheel_radius]))
    )
    X_BBox = RigidTransform([0.0, 0.0, middle])
    box = Box(p.length, p.width, p.height)
    plant.RegisterVisualGeometry(chassis, X_BBox, box, "chassis", np.array([0.13, 0.36, 0.58, 1.0]))
    plant.RegisterCollisionGeometry(chassis, X_BBox, box, "chassis", _NO_FRICTION)
    plant.RegisterVisualGeometry(  # shows which way is forward
        chassis,
        RigidTransform([p.length / 2 - 0.01, 0.0, p.clearance + p.height + 0.005]),
        Box(0.02, p.width * 0.6, 0.01),
        "nose",
        np.array([0.95, 0.65, 0.1, 1.0]),
    )
    for end, x in (("front", 1.0), ("rear", -1.0)):
        X_BCaster = RigidTransform([x * (p.length / 2 - p.caster_radius), 0.0, p.caster_radius])
        caster = Sphere(p.caster_radius)
        plant.RegisterVisualGeometry(
            chassis, X_BCaster, caster, f"{end}_caster", np.array([0.6, 0.6, 0.6, 1.0])
        )
        plant.RegisterCollisionGeometry(chassis, X_BCaster, caster, f"{end}_caster", _NO_FRICTION)
    for side, y in (("right", -1.0), ("left", 1.0)):
        joint = add_wheel(
            plant,
            model,
            chassis,
            name=f"{side}_wheel",
            position=np.array([0.0, y * p.base / 2, p.wheel_radius]),
            radius=p.wheel_radius,
            width=p.wheel_width,
            mass=p.wheel_mass,
            friction=_WHEEL_FRICTION,
        )
        _add_actuators(plant, joint, p, side, motor)
    return model


def _add_actuators(
    plant: MultibodyPlant,
    joint: RevoluteJoint,
    p: DifferentialDriveParameters,
    side: str,
    motor: MotorModel | None,
) -> None:
    if motor is None:
        actuator = plant.AddJointActuator(f"{side}_motor", joint, p.max_torque)
        actuator.set_controller_gains(PdControllerGains(p=0.0, d=p.servo_gain))
        return
    # Drake has no dry friction in joints: a servo toward standstill of no more than that torque is
    # one, solved implicitly, so that a wheel at rest stays there.
    friction = plant.AddJointActuator(f"{side}_friction", joint, motor.friction)
    friction.set_controller_gains(PdControllerGains(p=0.0, d=motor.friction / _CREEP))
    # After the friction: of two actuators of a joint Drake counts the last one's inertia.
    actuator = plant.AddJointActuator(f"{side}_motor", joint)
    actuator.set_controller_gains(PdControllerGains(p=0.0, d=motor.damping))
    actuator.set_default_rotor_inertia(motor.parameters.rotor_inertia)
    actuator.set_default_gear_ratio(motor.parameters.gear_ratio)


@TemplateSystem.define("KinematicDifferentialDrive_")
def KinematicDifferentialDrive_(T: Any) -> Any:  # noqa: D103 - the class carries the documentation
    class Impl(LeafSystem_[T]):
        """The kinematic twin: the wheels roll without slip and turn as they are told.

        .. pydrake_system::

            name: KinematicDifferentialDrive
            input_ports:
            - wheel_speeds
            output_ports:
            - pose
            - velocity

        Args:
            parameters: dimensions; of any robot with two driven sides.

        Ports:
            wheel_speeds (input, vector of 2): [right, left] (rad/s).
            pose (output, vector of 3): [x (m), y (m), theta (rad)] of base_link in the world,
                continuous state, theta not wrapped.
            velocity (output, vector of 2): [v (m/s), omega (rad/s)] of base_link.

        Source: [NAV], v = r (w_r + w_l) / 2, omega = r (w_r - w_l) / b. Scalar types: float,
        AutoDiffXd, Expression.
        """

        def _construct(self, *, parameters: Sides | None = None, converter: Any = None) -> None:
            super().__init__(converter=converter)
            self.parameters: Sides = parameters or DifferentialDriveParameters()
            self._wheel_speeds_input = self.DeclareVectorInputPort(
                "wheel_speeds", BasicVector_[T](2)
            )
            state = self.DeclareContinuousState(3)
            self._pose_output = self.DeclareStateOutputPort("pose", state)
            self._velocity_output = self.DeclareVectorOutputPort(
                "velocity",
                BasicVector_[T](2),
                lambda context, output: output.SetFromVector(self._velocity(context)),
                {self._wheel_speeds_input.ticket()},
            )

        def _construct_copy(self, other: Any, converter: Any = None) -> None:
            Impl._construct(self, parameters=other.parameters, converter=converter)

        def wheel_speeds_input_port(self) -> Any:
            """Returns the port of the wheel speeds."""
            return self._wheel_speeds_input

        def pose_output_port(self) -> Any:
            """Returns the port of the pose."""
            return self._pose_output

        def velocity_output_port(self) -> Any:
            """Returns the port of the velocity."""
            return self._velocity_output

        def _velocity(self, context: Any) -> list[Any]:
            wheel_speeds = self._wheel_speeds_input.Eval(context).tolist()
            return body_velocity(wheel_speeds, self.parameters)

        def DoCalcTimeDerivatives(self, context: Any, derivatives: Any) -> None:
            theta = context.get_continuous_state_vector().GetAtIndex(2)
            v, omega = self._velocity(context)
            derivatives.SetFromVector([v * cos(theta), v * sin(theta), omega])

    return Impl


KinematicDifferentialDrive = KinematicDifferentialDrive_[None]
