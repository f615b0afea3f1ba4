"""AgileX' LIMO in its differential mode: four driven wheels, those of a side alike (skid-steered).

It turns by letting its tyres slip sideways, so it turns less than its wheels would make one on two
wheels turn. With four equal loads and friction that is the same in all directions the slip's moment
about the middle vanishes at

    omega = r (w_r - w_l) / b,  b = W + L^2 / W,

for a track W and a wheelbase L, whatever the friction and the speed: at each wheel the slip is
omega times its lever less what the wheel takes back, and the friction, opposite to it, is of the
same size everywhere. So the robot drives as one on two wheels that are b apart, the *effective
track* (Mandow, Martinez, Morales, Blanco, Garcia-Cerezo, Gonzalez, "Experimental kinematics for
wheeled skid-steer mobile robots", IROS 2007, who calibrate it; it is 1.5 to 2 times the track
there). What is lost in accelerating and to centrifugal force is what the plant has beyond that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Box
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, PdControllerGains, SpatialInertia

from plants.wheels import add_wheel
from systems.validation import require, require_non_negative, require_positive

_NO_FRICTION = CoulombFriction(0.0, 0.0)
_BODY_COLOUR = np.array([0.82, 0.83, 0.85, 1.0])
_TOP_COLOUR = np.array([0.16, 0.17, 0.19, 1.0])


@dataclass
class LimoParameters:
    """Dimensions and masses, SI units.

    Sources: LIMO User Manual, section 1.3 (322 x 220 x 251 mm, wheelbase 200 mm, ground clearance
    24 mm, four hub motors of 14.4 W, 1 m/s at most). Mass, track and wheels are as commonly given
    for later versions (4.2 kg, 172 mm, wheels of 45 mm radius; the manual's first version has
    4.8 kg and 175 mm): measure your own. What drives and slips is ours: friction of rubber on a
    floor, and motors that hold their speed, since a hub motor with an encoder is regulated.

    Attributes:
        wheel_radius: m.
        wheelbase: from the front axle to the rear one, m.
        track: distance between the planes of right and left wheels, m.
        wheel_width: m.
        wheel_mass: of one wheel with its motor, kg.
        length: of the body, m.
        width: over the wheels, m.
        height: from the ground to the top, m.
        clearance: from the ground to the body, m.
        mass: of all of it, kg.
        friction: of tyres on a floor whose own coefficient is 1.
        centre_height: of the body's centre of mass over the ground, m.
        effective_track: of the robot's own kinematics, m: calibrated for commands and odometry; 0
            takes what follows from wheelbase and track.
        servo_gain: torque by error of wheel speed, N m s/rad.
        max_torque: of one motor, N m.
    """

    wheel_radius: float = 0.045
    wheelbase: float = 0.2
    track: float = 0.172
    wheel_width: float = 0.046
    wheel_mass: float = 0.3
    length: float = 0.322
    width: float = 0.22
    height: float = 0.251
    clearance: float = 0.024
    mass: float = 4.2
    friction: float = 0.7
    centre_height: float = 0.08
    effective_track: float = 0.0
    servo_gain: float = 40.0
    max_torque: float = 1.0

    def __post_init__(self) -> None:
        require_non_negative(effective_track=self.effective_track)
        require_positive(**{k: v for k, v in vars(self).items() if k != "effective_track"})
        require(
            4 * self.wheel_mass < self.mass,
            "wheel_mass",
            self.wheel_mass,
            f"less than a quarter of the mass, {self.mass / 4:.3g} kg",
        )
        require(
            self.track - self.wheel_width > 0,
            "wheel_width",
            self.wheel_width,
            f"less than the track, {self.track:.3g} m",
        )
        require(
            self.clearance < self.height, "clearance", self.clearance, f"below {self.height:.3g} m"
        )
        require(
            self.clearance <= self.centre_height <= self.height,
            "centre_height",
            self.centre_height,
            f"from {self.clearance:.3g} to {self.height:.3g} m, in the body",
        )

    @property
    def base(self) -> float:
        """The effective track, m, as the kinematics of two driven sides take it."""
        return self.effective_track or self.track + self.wheelbase**2 / self.track


def hull(parameters: LimoParameters) -> list[float]:
    """Returns [front, rear, half_width] (m): the rectangle about base_link that holds the robot."""
    p = parameters
    end = max(p.length / 2, p.wheelbase / 2 + p.wheel_radius)
    return [end, end, max(p.width / 2, (p.track + p.wheel_width) / 2)]


def add_limo(plant: MultibodyPlant, parameters: LimoParameters, name: str) -> ModelInstanceIndex:
    """Adds the robot to a plant.

    The body `base_link` has its origin on the ground below the middle of the four wheels, x
    forward, y left, z up. Joints and motors are called `front_right`, `rear_right`, `front_left`
    and `rear_left`, in this order. The motors are speed servos, driven through the instance's
    `desired_state` port (`plants.wheels.servo_matrix`).

    Args:
        plant: not finalized yet.
        parameters: dimensions.
        name: of the model instance.

    Returns:
        The model instance.
    """
    p = parameters
    model = plant.AddModelInstance(name)
    body_mass = p.mass - 4 * p.wheel_mass
    low = p.clearance
    depth = p.track - p.wheel_width  # of what lies between the wheels
    deck = 2 * p.wheel_radius + 0.008  # above the wheels the body is as wide as all of it
    box = SpatialInertia.SolidBoxWithMass(body_mass, p.length, p.width, p.height - low)
    chassis = plant.AddRigidBody(
        "base_link", model, box.Shift(np.array([0.0, 0.0, -p.centre_height]))
    )
    parts = {
        "floor": (0.9 * p.length, depth, low, deck, _TOP_COLOUR),
        "body": (p.length, p.width, deck, 0.62 * p.height, _BODY_COLOUR),
        "head": (0.5 * p.length, 0.8 * p.width, 0.62 * p.height, p.height, _TOP_COLOUR),
    }
    for label, (length, width, bottom, top, colour) in parts.items():
        X_BPart = RigidTransform([0.0, 0.0, (bottom + top) / 2])
        shape = Box(length, width, top - bottom)
        plant.RegisterVisualGeometry(chassis, X_BPart, shape, label, colour)
        plant.RegisterCollisionGeometry(chassis, X_BPart, shape, label, _NO_FRICTION)
    plant.RegisterVisualGeometry(  # shows which way is forward
        chassis,
        RigidTransform([p.length / 2 + 0.002, 0.0, 0.5 * p.height]),
        Box(0.004, 0.5 * p.width, 0.04),
        "display",
        np.array([0.95, 0.65, 0.1, 1.0]),
    )
    tyre = CoulombFriction(p.friction, p.friction)
    for side, y in (("right", -1.0), ("left", 1.0)):
        for end, x in (("front", 1.0), ("rear", -1.0)):
            joint = add_wheel(
                plant,
                model,
                chassis,
                name=f"{end}_{side}_wheel",
                position=np.array([x * p.wheelbase / 2, y * p.track / 2, p.wheel_radius]),
                radius=p.wheel_radius,
                width=p.wheel_width,
                mass=p.wheel_mass,
                friction=tyre,
                narrow=True,
            )
            motor = plant.AddJointActuator(f"{end}_{side}_motor", joint, p.max_torque)
            motor.set_controller_gains(PdControllerGains(p=0.0, d=p.servo_gain))
    return model
