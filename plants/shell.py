"""The reference robot: a ferromagnetic sphere that others climb, at rest or moved as prescribed.

Frame R of the shell: origin in the sphere's centre, z toward its pole, x toward yaw 0 on its
equator.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import AddContactMaterial, ProximityProperties, Sphere
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    Frame,
    ModelInstanceIndex,
    PdControllerGains,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    SpatialInertia,
)
from pydrake.systems.framework import Context, LeafSystem, OutputPort

from systems.shell.angles import rotation
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]

BODY = "shell"

# Of the contact between a wheel's tread and the sheet, both together twice this: a wheel held by a
# few newtons sinks in by some hundredths of a millimetre, as thin hard rubber does.
_STIFFNESS = 2e5  # N/m
_DISSIPATION = 20.0  # s/m
# What holds a moving shell: a robot's weight displaces it by less than 0.1 mm and 0.01 degrees.
_FORCE_GAINS = PdControllerGains(p=1e5, d=5e2)  # N/m, N s/m
_TORQUE_GAINS = PdControllerGains(p=1e4, d=15.0)  # N m/rad, N m s/rad
_COLOUR = np.array([0.72, 0.74, 0.76, 1.0])


@dataclass
class ShellParameters:
    """The sphere. The paper gives neither its radius nor its mass: these are ours.

    Attributes:
        radius: outer, m.
        mass: kg; the default is 1 mm of steel, half of it holes.
        friction: coefficient between the sheet and a wheel's tread, static and dynamic.
    """

    radius: float = 0.075
    mass: float = 0.28
    friction: float = 0.8

    def __post_init__(self) -> None:
        require_positive(radius=self.radius, mass=self.mass)
        require_non_negative(friction=self.friction)


def pose_on_shell(angles: Array, distance: float) -> RigidTransform:
    """Returns `X_RB` of a robot that stands on the shell (see `systems.shell.angles`).

    Args:
        angles: [roll, pitch, yaw], rad.
        distance: of the origin of B from the sphere's centre, m.
    """
    R_RB = rotation(angles)
    return RigidTransform(RotationMatrix(R_RB), distance * R_RB[:, 2])


def contact_properties(friction: float) -> ProximityProperties:
    """Returns what a surface is like in contact, for the sheet and what touches it alike."""
    properties = ProximityProperties()
    AddContactMaterial(
        dissipation=_DISSIPATION,
        point_stiffness=_STIFFNESS,
        friction=CoulombFriction(friction, friction),
        properties=properties,
    )
    return properties


def add_shell(
    plant: MultibodyPlant,
    parameters: ShellParameters,
    name: str,
    parent: Frame | None = None,
    X_PR: RigidTransform | None = None,
    plain: bool = True,
) -> ModelInstanceIndex:
    """Adds a shell that is fixed to the world, or to a robot which carries it.

    Args:
        plant: not finalized yet.
        parameters: the sphere.
        name: of the model instance; its body is `shell`.
        parent: what it is fixed to; None for the world.
        X_PR: its pose there; None for the parent's own.
        plain: whether it looks like a plain sphere; if not, `plants.shell_surface` is to give it
            its looks.

    Returns:
        The model instance.
    """
    model = plant.AddModelInstance(name)
    body = _add_sphere(plant, model, parameters, plain)
    plant.WeldFrames(
        plant.world_frame() if parent is None else parent,
        body.body_frame(),
        RigidTransform() if X_PR is None else X_PR,
    )
    return model


def add_moving_shell(
    plant: MultibodyPlant,
    parameters: ShellParameters,
    name: str,
    X_WS: RigidTransform | None = None,
    plain: bool = True,
) -> ModelInstanceIndex:
    """Adds a shell whose pose is driven through the model instance's `desired_state` port.

    Six actuated joints carry it, stiff enough for a robot on it to be of no account: x, y, z (m),
    then yaw, pitch, roll (rad), about the place S where it starts. See `ShellMotion`.

    Args:
        plant: not finalized yet.
        parameters: the sphere.
        name: of the model instance; its body is `shell`.
        X_WS: where it is while all six are 0; None for the world's origin.
        plain: whether it looks like a plain sphere; if not, `plants.shell_surface` is to give it
            its looks.

    Returns:
        The model instance.
    """
    model = plant.AddModelInstance(name)
    shell = _add_sphere(plant, model, parameters, plain)
    # Slides and rings between the ground and the sphere: light, but not without mass.
    inertia = SpatialInertia.HollowSphereWithMass(parameters.mass / 20, parameters.radius)
    rings = [plant.AddRigidBody(f"ring_{k}", model, inertia) for k in range(5)]
    frame: Frame = plant.AddFrame(
        FixedOffsetFrame(
            "start", plant.world_frame(), RigidTransform() if X_WS is None else X_WS, model
        )
    )
    for k, body in enumerate([*rings, shell]):
        kind, axis, gains = (
            (PrismaticJoint, np.eye(3)[k], _FORCE_GAINS)
            if k < 3
            else (RevoluteJoint, np.eye(3)[5 - k], _TORQUE_GAINS)
        )
        coordinate = ("x", "y", "z", "yaw", "pitch", "roll")[k]
        joint = plant.AddJoint(kind(coordinate, frame, body.body_frame(), axis))
        plant.AddJointActuator(coordinate, joint).set_controller_gains(gains)
        frame = body.body_frame()
    return model


def _add_sphere(
    plant: MultibodyPlant,
    model: ModelInstanceIndex,
    p: ShellParameters,
    plain: bool,
) -> RigidBody:
    inertia = SpatialInertia.HollowSphereWithMass(p.mass, p.radius)
    body = plant.AddRigidBody(BODY, model, inertia)
    X_RG = RigidTransform()
    shape = Sphere(p.radius)
    plant.RegisterCollisionGeometry(body, X_RG, shape, BODY, contact_properties(p.friction))
    if plain:
        plant.RegisterVisualGeometry(body, X_RG, shape, BODY, _COLOUR)
    return body


@dataclass
class ShellMotionParameters:
    """How a moving shell moves: every coordinate swings from 0 to its amplitude and back.

    q(t) = amplitude (1 - cos(2 pi t / period)) / 2: it starts at 0 at rest.

    Attributes:
        translation: amplitudes along [x, y, z], m.
        translation_period: s.
        rotation: amplitudes of [yaw, pitch, roll], rad; pitch within a right angle.
        rotation_period: s.
    """

    translation: list[float] = field(default_factory=lambda: [0.1, 0.05, 0.0])
    translation_period: float = 20.0
    rotation: list[float] = field(default_factory=lambda: [1.0, 0.3, 0.2])
    rotation_period: float = 30.0

    def __post_init__(self) -> None:
        for name in ("translation", "rotation"):
            value = getattr(self, name)
            require(
                len(value) == 3 and bool(np.isfinite(value).all()),
                name,
                value,
                "three finite numbers",
            )
        require(abs(self.rotation[1]) < np.pi / 2, "rotation[1]", self.rotation[1], "within +-pi/2")
        require_positive(
            translation_period=self.translation_period, rotation_period=self.rotation_period
        )

    def coordinates(self, t: float) -> tuple[Array, Array]:
        """Returns [x, y, z, yaw, pitch, roll] (6,) m and rad, and their rates (6,), at t (s)."""
        amplitude = np.array([*self.translation, *self.rotation])
        rate = 2 * np.pi / np.repeat([self.translation_period, self.rotation_period], 3)
        swing = (1 - np.cos(rate * t)) / 2
        return amplitude * swing, amplitude * rate * np.sin(rate * t) / 2


class ShellMotion(LeafSystem):
    """Says where a moving shell is to be, and how fast: the reference robot's known motion.

    .. pydrake_system::

        name: ShellMotion
        output_ports:
        - desired_state
        - pose
        - spatial_velocity

    Args:
        parameters: how it moves.
        X_WS: where it starts; None for the world's origin.

    Ports:
        desired_state (output, vector of 12): for the actuators of `add_moving_shell`: [x, y, z (m),
            yaw, pitch, roll (rad)] from the start, then their rates.
        pose (output, RigidTransform): `X_WR`.
        spatial_velocity (output, vector of 6): of R in W, rotation first (rad/s, m/s).
    """

    def __init__(
        self,
        *,
        parameters: ShellMotionParameters | None = None,
        X_WS: RigidTransform | None = None,
    ) -> None:
        super().__init__()
        self._parameters = parameters or ShellMotionParameters()
        self._X_WS = RigidTransform() if X_WS is None else X_WS
        time = {self.time_ticket()}
        self._desired_state_output = self.DeclareVectorOutputPort(
            "desired_state", 12, self._calc_desired_state, time
        )
        self._pose_output = self.DeclareAbstractOutputPort(
            "pose", lambda: AbstractValue.Make(RigidTransform()), self._calc_pose, time
        )
        self._velocity_output = self.DeclareVectorOutputPort(
            "spatial_velocity", 6, self._calc_velocity, time
        )

    def desired_state_output_port(self) -> OutputPort:
        """Returns the port of coordinates and rates."""
        return self._desired_state_output

    def pose_output_port(self) -> OutputPort:
        """Returns the port of the pose."""
        return self._pose_output

    def spatial_velocity_output_port(self) -> OutputPort:
        """Returns the port of the velocity."""
        return self._velocity_output

    def _calc_desired_state(self, context: Context, output: Any) -> None:
        output.SetFromVector(np.concatenate(self._parameters.coordinates(context.get_time())))

    def _calc_pose(self, context: Context, output: Any) -> None:
        q, _ = self._parameters.coordinates(context.get_time())
        output.set_value(self._X_WS @ RigidTransform(RollPitchYaw(q[:2:-1]), q[:3]))

    def _calc_velocity(self, context: Context, output: Any) -> None:
        q, rates = self._parameters.coordinates(context.get_time())
        w_SR = RollPitchYaw(q[:2:-1]).CalcAngularVelocityInParentFromRpyDt(rates[:2:-1])
        R_WS = self._X_WS.rotation().matrix()
        output.SetFromVector(np.concatenate([R_WS @ w_SR, R_WS @ rates[:3]]))
