"""A SnailBot: a rocker-bogie chassis on six magnetic wheels that climbs a shell.

Frame B, the body `base_link`: x forward, y left, z up, which is the shell's outward normal. Its
origin is in the middle of the chassis' base, `clearance` above the shell, where the camera is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box, Cylinder, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    ModelInstanceIndex,
    PdControllerGains,
    RevoluteJoint,
    RigidBody,
    SpatialInertia,
)

from plants.shell import ShellParameters, contact_properties, pose_on_shell
from systems.validation import require, require_positive

Array = NDArray[np.float64]

SIDES = (("right", -1.0), ("left", 1.0))
STATIONS = ("front", "middle", "rear")

_Y = np.array([0.0, 1.0, 0.0])
_Z = np.array([0.0, 0.0, 1.0])
# Of the wheels with the shell where the robot is put down. Where a gap rounds to just above zero
# there is no contact in the first step, and the magnet has pulled that wheel in by a millimetre
# before the second.
_OVERLAP = 1e-5  # m
_PIVOT_DAMPING = 1e-4  # N m s/rad, of rockers and bogies
_PIVOT_RANGE = math.radians(30.0)
_ARM_WIDTH = 0.003  # m, of rockers and bogies
_DARK = np.array([0.12, 0.12, 0.12, 1.0])
_LIGHT = np.array([0.9, 0.9, 0.9, 1.0])
_ARM_COLOUR = np.array([0.45, 0.47, 0.50, 1.0])
_CHASSIS_COLOUR = np.array([0.16, 0.45, 0.36, 1.0])
_NOSE_COLOUR = np.array([0.95, 0.65, 0.1, 1.0])


@dataclass
class SnailBotParameters:
    """Dimensions and masses of the robot, SI units. The paper gives none: these are ours.

    Attributes:
        wheel_radius: m.
        wheel_width: m.
        wheel_mass: of one wheel with its magnet and its motor, kg.
        track: distance between the wheels' middles, right to left, m.
        wheelbase: distance between the axles, front to rear, m. With less than about half the track
            the middle wheels turn the robot in place against the scrubbing of the others; with
            more it turns slower than its wheels say.
        rocker_pivot: height of the rockers' pivots over the middle axle, m. They are above it.
        bogie_pivot: height of the bogies' pivots over the axles of front and middle wheel, m.
        arm_mass: of a rocker or a bogie, kg.
        length: of the chassis, m.
        width: of the chassis, m; it must fit between the rockers.
        height: of the chassis, m.
        clearance: from the shell to the chassis' base, m.
        mass: of the chassis with all it carries, kg.
        mass_height: of its centre of mass over its base, m.
        mount: height of what holds a shell of its own over the chassis, m.
        servo_gain: torque by error of wheel speed, N m s/rad.
        max_torque: of one wheel's motor, N m.
        rotor_inertia: of one motor's rotor, as the wheel feels it: times the gear ratio squared,
            kg m^2; the default is a rotor of 5e-10 kg m^2 behind 1:100.
    """

    wheel_radius: float = 0.006
    wheel_width: float = 0.006
    wheel_mass: float = 0.016
    track: float = 0.072
    wheelbase: float = 0.026
    rocker_pivot: float = 0.004
    bogie_pivot: float = 0.001
    arm_mass: float = 0.004
    length: float = 0.050
    width: float = 0.044
    height: float = 0.026
    clearance: float = 0.010
    mass: float = 0.13
    mass_height: float = 0.010
    mount: float = 0.005
    servo_gain: float = 2.0
    max_torque: float = 0.08
    rotor_inertia: float = 5e-6

    def __post_init__(self) -> None:
        require_positive(**vars(self))
        require(
            self.wheelbase > 4 * self.wheel_radius,
            "wheelbase",
            self.wheelbase,
            f"above two wheels' diameters = {4 * self.wheel_radius:.3g} m",
        )
        room = self.track - self.wheel_width - 4 * _ARM_WIDTH
        require(
            self.width <= room, "width", self.width, f"at most {room:.3g} m, between the rockers"
        )
        require(
            self.mass_height < self.height,
            "mass_height",
            self.mass_height,
            f"below the chassis' height of {self.height:.3g} m",
        )


def wheel_centres(parameters: SnailBotParameters, shell: ShellParameters) -> Array:
    """Returns where the wheels are in B when all of them touch the shell, (6, 3) m.

    In the order right front, right middle, right rear, left front, ... Rockers and bogies are made
    for the shell: on it they are at 0, and B's z axis passes through the shell's centre.

    Raises:
        ValueError: the shell is too small for the robot.
    """
    p = parameters
    across, ahead = p.track / 2, p.wheelbase / 2
    distance = shell.radius + p.wheel_radius
    # Where the wheels' inclination reaches 45 degrees they stand beside the sphere, not on it.
    smallest = math.sqrt(2) * math.hypot(across, ahead) - p.wheel_radius
    require(
        shell.radius >= smallest,
        "radius",
        shell.radius,
        f"at least {smallest:.3g} m for a robot of this track and wheelbase",
    )
    plane = np.array([[x, y * across] for _, y in SIDES for x in (ahead, 0.0, -ahead)])
    z = np.sqrt(distance**2 - (plane * plane).sum(axis=1)) - (shell.radius + p.clearance)
    return np.column_stack([plane, z])


def stance(angles: Array, parameters: SnailBotParameters, shell: ShellParameters) -> RigidTransform:
    """Returns `X_RB` of the robot on the shell, all its wheels touching while its joints are at 0.

    By a hundredth of a millimetre more than touching, a quarter of what the magnets press them in.

    Args:
        angles: [roll, pitch, yaw], rad: heading (0 toward the pole, positive to the left),
            latitude and longitude.
        parameters: the robot.
        shell: the sphere.
    """
    return pose_on_shell(angles, shell.radius + parameters.clearance - _OVERLAP)


def carried_shell_pose(parameters: SnailBotParameters, shell: ShellParameters) -> RigidTransform:
    """Returns `X_BR` of a shell that the robot carries on its back, for `plants.shell.add_shell`.

    The axes of the shell's frame R are those of B: its pole is on top, its yaw 0 in front. Its
    centre is over B's origin, `mount` above the chassis.

    It takes stronger magnets to carry it. With the default sizes and another robot anywhere on the
    upper half of it, for a margin of 1.5 (`plants.adhesion_margin`): 6.5 N a wheel on the pole, 8.5
    along the equator (roll 90), 20 at latitude 60 and 36 anywhere, whatever the heading.

    Args:
        parameters: the robot that carries it.
        shell: the sphere that is carried.
    """
    return RigidTransform([0.0, 0.0, parameters.height + parameters.mount + shell.radius])


def half_track(parameters: SnailBotParameters, shell: ShellParameters) -> float:
    """Returns half the track of the flat robot that turns like this one, m.

    A wheel of radius r whose middle is at y from the robot's plane touches the shell of radius R at
    y_c = R sin g, where sin g = y / (R + r), and rolls on the radius r cos g. Driving at v, the
    robot turns about its y axis by v / R; the contact is at R cos g from that axis, so the wheel
    turns by v / r, as on the flat. Turning by omega, a middle wheel rolls at omega y_c, that is by
    omega R tan g / r.
    """
    tilt = math.asin(parameters.track / 2 / (shell.radius + parameters.wheel_radius))
    return shell.radius * math.tan(tilt)


def wheel_speeds(command: Any, parameters: SnailBotParameters, shell: ShellParameters) -> list[Any]:
    """Returns the speeds [right, left] (rad/s) of the middle wheels.

    Args:
        command: [v, omega], the speed along the shell's surface (m/s: v / radius is how fast the
            robot goes round) and the rate of roll (rad/s).
        parameters: the robot.
        shell: the sphere.
    """
    v, omega = command
    r, b = parameters.wheel_radius, half_track(parameters, shell)
    return [(v + omega * b) / r, (v - omega * b) / r]


def body_velocity(
    wheel_speeds: Any, parameters: SnailBotParameters, shell: ShellParameters
) -> list[Any]:
    """Returns [v (m/s), omega (rad/s)] of wheel speeds [right, left] (rad/s): the inverse."""
    r, b = parameters.wheel_radius, half_track(parameters, shell)
    right, left = wheel_speeds
    return [r * (right + left) / 2, r * (right - left) / (2 * b)]


def servo_matrix(
    plant: MultibodyPlant,
    model: ModelInstanceIndex,
    parameters: SnailBotParameters,
    shell: ShellParameters,
) -> Array:
    """Returns the matrix (12, 2) from [right, left] (rad/s) to the `desired_state` of the wheels.

    The wheels of a side turn alike when the robot drives. When it turns in place, those at the ends
    roll as far as they are in line with the turn, cos(psi) of what the middle one does, where psi
    is the angle of their axle about the shell: so they slip aside, as they must, but not along.
    """
    reach = shell.radius + parameters.wheel_radius
    in_line = math.sqrt(1 - (parameters.wheelbase / 2) ** 2 / (reach**2 - parameters.track**2 / 4))
    matrix = np.zeros((12, 2))
    for row, index in enumerate(plant.GetJointActuatorIndices(model)):
        side, station = plant.get_joint_actuator(index).name().split("_")[:2]
        share = 1.0 if station == "middle" else in_line
        own, other = (1 + share) / 2, (1 - share) / 2
        matrix[6 + row] = [own, other] if side == "right" else [other, own]
    return matrix


def add_snailbot(
    plant: MultibodyPlant, parameters: SnailBotParameters, shell: ShellParameters, name: str
) -> ModelInstanceIndex:
    """Adds the robot to a plant.

    On each side a rocker, pivoted on the chassis above the middle axle, carries the rear wheel and,
    at its front end, a bogie with the other two: so each wheel bears a third. A differential keeps
    the rockers at opposite angles. The wheels' treads are crowned: they collide as spheres.

    The wheels are driven through the instance's `desired_state` port: see `servo_matrix`. The
    magnets are apart: `plants.magnets.MagneticAdhesion`. `base_link` floats: put it at `stance`.
    From a gap it falls before its magnets grip: on the equator from 2 mm by 2 degrees, from 5 mm by
    13, from 10 mm for good.

    The plant needs `discrete_contact_approximation` "lagged" and a step of at most 5 ms, such as
    the 1/300 s of its inertial sensor. (At 10 ms it creeps by 0.13 mm/s where it should rest.)

    Args:
        plant: not finalized yet.
        parameters: dimensions.
        shell: what it is made to stand on.
        name: of the model instance.

    Returns:
        The model instance.
    """
    p = parameters
    model = plant.AddModelInstance(name)
    chassis = _add_chassis(plant, model, p)
    centres = wheel_centres(p, shell)
    rockers = [
        _add_side(plant, model, chassis, p, shell, side, centres[3 * k : 3 * k + 3])
        for k, (side, _) in enumerate(SIDES)
    ]
    plant.AddCouplerConstraint(*rockers, -1.0)
    return model


def _add_chassis(
    plant: MultibodyPlant, model: ModelInstanceIndex, p: SnailBotParameters
) -> RigidBody:
    inertia = SpatialInertia.SolidBoxWithMass(p.mass, p.length, p.width, p.height)
    # `Shift` takes the new origin as seen from the old one, the centre of mass.
    chassis = plant.AddRigidBody(
        "base_link", model, inertia.Shift(np.array([0.0, 0.0, -p.mass_height]))
    )
    X_BBox = RigidTransform([0.0, 0.0, p.height / 2])
    box = Box(p.length, p.width, p.height)
    plant.RegisterVisualGeometry(chassis, X_BBox, box, "chassis", _CHASSIS_COLOUR)
    plant.RegisterCollisionGeometry(chassis, X_BBox, box, "chassis", CoulombFriction(0.0, 0.0))
    plant.RegisterVisualGeometry(  # shows which way is forward
        chassis,
        RigidTransform([p.length / 2 - 0.003, 0.0, p.height + 0.0015]),
        Box(0.006, p.width * 0.6, 0.003),
        "nose",
        _NOSE_COLOUR,
    )
    return chassis


def _add_side(
    plant: MultibodyPlant,
    model: ModelInstanceIndex,
    chassis: RigidBody,
    p: SnailBotParameters,
    shell: ShellParameters,
    side: str,
    centres: Array,
) -> RevoluteJoint:
    """Adds rocker, bogie and wheels; returns the rocker's joint."""
    front, middle, rear = centres
    p_BRocker = middle + p.rocker_pivot * _Z
    p_BBogie = (front + middle) / 2 + p.bogie_pivot * _Z
    inward = -math.copysign(p.wheel_width / 2 + _ARM_WIDTH, middle[1])
    rocker_ends = [rear - p_BRocker, p_BBogie - p_BRocker]
    bogie_ends = [front - p_BBogie, middle - p_BBogie]
    rocker = _add_arm(plant, model, p, f"{side}_rocker", inward, rocker_ends)
    bogie = _add_arm(plant, model, p, f"{side}_bogie", inward, bogie_ends)
    rocking = _add_pivot(plant, model, chassis, rocker, p_BRocker)
    _add_pivot(plant, model, rocker, bogie, p_BBogie - p_BRocker)
    places = (front - p_BBogie, middle - p_BBogie, rear - p_BRocker)
    for station, arm, place in zip(STATIONS, (bogie, bogie, rocker), places, strict=True):
        _add_wheel(plant, model, arm, p, shell, f"{side}_{station}", place)
    return rocking


def _add_arm(
    plant: MultibodyPlant,
    model: ModelInstanceIndex,
    p: SnailBotParameters,
    name: str,
    inward: float,
    ends: list[Array],
) -> RigidBody:
    """Adds a rocker or a bogie: bars from its pivot, the body's origin, to its ends (3,) m.

    They run beside the wheels, `inward` (m, along y) of their middles.
    """
    inertia = SpatialInertia.SolidBoxWithMass(p.arm_mass, p.wheelbase / 2, _ARM_WIDTH, _ARM_WIDTH)
    arm = plant.AddRigidBody(name, model, inertia)
    for k, end in enumerate(ends):
        R = RotationMatrix.MakeYRotation(math.atan2(-end[2], end[0]))
        place = end / 2 + inward * _Y
        bar = Box(float(np.linalg.norm(end)), _ARM_WIDTH, _ARM_WIDTH)
        plant.RegisterVisualGeometry(arm, RigidTransform(R, place), bar, f"bar_{k}", _ARM_COLOUR)
    return arm


def _add_pivot(
    plant: MultibodyPlant,
    model: ModelInstanceIndex,
    parent: RigidBody,
    arm: RigidBody,
    place: Array,
) -> RevoluteJoint:
    pivot = plant.AddFrame(
        FixedOffsetFrame(f"{arm.name()}_pivot", parent.body_frame(), RigidTransform(place), model)
    )
    return plant.AddJoint(
        RevoluteJoint(
            arm.name(), pivot, arm.body_frame(), _Y, -_PIVOT_RANGE, _PIVOT_RANGE, _PIVOT_DAMPING
        )
    )


def _add_wheel(
    plant: MultibodyPlant,
    model: ModelInstanceIndex,
    arm: RigidBody,
    p: SnailBotParameters,
    shell: ShellParameters,
    name: str,
    place: Array,
) -> None:
    r = p.wheel_radius
    inertia = SpatialInertia.SolidCylinderWithMass(p.wheel_mass, r, p.wheel_width, _Y)
    wheel = plant.AddRigidBody(f"{name}_wheel", model, inertia)
    axle = plant.AddFrame(
        FixedOffsetFrame(f"{name}_axle", arm.body_frame(), RigidTransform(place), model)
    )
    joint = plant.AddJoint(RevoluteJoint(f"{name}_wheel", axle, wheel.body_frame(), _Y))
    motor = plant.AddJointActuator(f"{name}_motor", joint, p.max_torque)
    motor.set_controller_gains(PdControllerGains(p=0.0, d=p.servo_gain))
    motor.set_default_rotor_inertia(p.rotor_inertia)  # of a gear ratio of 1
    X_WheelTyre = RigidTransform(RotationMatrix.MakeXRotation(math.pi / 2))
    plant.RegisterVisualGeometry(wheel, X_WheelTyre, Cylinder(r, p.wheel_width), "tyre", _DARK)
    spoke = Box(1.6 * r, 1.02 * p.wheel_width, 0.0015)  # so that one sees the wheel turn
    plant.RegisterVisualGeometry(wheel, RigidTransform(), spoke, "spoke", _LIGHT)
    plant.RegisterCollisionGeometry(
        wheel, RigidTransform(), Sphere(r), "tyre", contact_properties(shell.friction)
    )
