"""Magnetic wheels: what holds a robot on a steel shell."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import BodyIndex, ModelInstanceIndex
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    InputPort,
    LeafSystem,
    OutputPort,
    ValueProducer,
)

from plants.adhesion_margin import Suspension, adhesion_margin
from plants.shell import ShellParameters
from systems.compiled import compiled
from systems.markers.pnp import cross_matrix
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]


@dataclass
class MagnetParameters:
    """The magnet of each wheel. The paper gives none: these are ours.

    Attributes:
        force: at contact, N.
        gap: the gap at which a quarter of the force is left, m.
        detached_gap: the robot has come off once all its wheels are farther than this, m.
    """

    force: float = 4.0
    gap: float = 0.001
    detached_gap: float = 0.005

    def __post_init__(self) -> None:
        require_non_negative(force=self.force)
        require_positive(gap=self.gap, detached_gap=self.detached_gap)


def magnet_force(gap: Any, parameters: MagnetParameters) -> Any:
    """Returns the pull (N) of a magnet at a gap (m), a float or an array of them.

    F = F0 / (1 + gap / gap0)^2. A magnet that drives its flux through its own reluctance and, in
    series, that of an air gap, has a flux density B = B0 / (1 + gap / gap0); its pull is the
    Maxwell stress B^2 / (2 mu0) over the pole (any text on magnetic circuits). What is pressed
    together is at contact.
    """
    return parameters.force / (1 + np.maximum(gap, 0.0) / parameters.gap) ** 2


@compiled("void(f8[:,::1], f8, f8, f8, f8[:,::1])")
def _pull(centres: Array, reach: float, force: float, gap: float, F: Array) -> None:
    """Writes the spatial forces, see `magnet_force`.

    Args:
        centres: (n + 1, 3) of the wheels, and of the shell, m.
        reach: distance of a wheel's centre from the shell's when they touch, m.
        force: at contact, N.
        gap: at which a quarter of it is left, m.
        F: (n + 1, 6) zeros; the forces are written, and last their reaction on the shell, N.
    """
    last = len(centres) - 1
    offset = np.empty(3)
    for k in range(last):
        square = 0.0
        for i in range(3):
            offset[i] = centres[k, i] - centres[last, i]
            square += offset[i] * offset[i]
        distance = math.sqrt(square)
        weaker = 1 + max(distance - reach, 0.0) / gap
        for i in range(3):
            F[k, 3 + i] = -force / (weaker * weaker) / distance * offset[i]
            F[last, 3 + i] -= F[k, 3 + i]


class MagneticAdhesion(LeafSystem):
    """Pulls the wheels of a robot to a shell, and the shell to them.

    .. pydrake_system::

        name: MagneticAdhesion
        input_ports:
        - body_poses
        output_ports:
        - forces
        - gaps
        - margin
        - detached

    Args:
        plant: finalized.
        model: the robot; its wheels are the bodies named `..._wheel`, with their origins in their
            middles. If they all are jointed to two bodies named `..._rocker`, or to a `..._bogie`
            that is, these are its suspension: their origins are their pivots, and the rockers turn
            about y of `base_link`, by opposite angles. Else it counts as rigid.
        shell: model instance of the sphere; its body is `shell`.
        wheel_radius: m.
        shell_parameters: the sphere.
        parameters: the magnets.
        carried: model instances that the robot carries, such as a shell of its own and whoever
            drives on it.

    Ports:
        body_poses (input, list): the plant's `body_poses`.
        forces (output, list): `ExternallyAppliedSpatialForce` of each wheel, toward the sphere's
            centre, and last their reaction on the sphere: for the plant's
            `applied_spatial_force` (of several robots: joined).
        gaps (output, vector of one for each wheel): between wheel and shell, in the order of the
            bodies, m; negative when they are pressed together.
        margin (output, vector of 1): see `adhesion_margin`; of the robot with its arms and wheels
            where they are in the default context, and of what it carries where that is, under the
            plant's gravity. All accelerations are left out. Inf when it needs no adhesion.
        detached (output, vector of 1): 1 when all gaps are above `detached_gap`, else 0.

    Raises:
        ValueError: less than three wheels, or it is to carry itself or the shell it stands on.
    """

    def __init__(
        self,
        *,
        plant: MultibodyPlant,
        model: ModelInstanceIndex,
        shell: ModelInstanceIndex,
        wheel_radius: float,
        shell_parameters: ShellParameters,
        parameters: MagnetParameters | None = None,
        carried: Sequence[ModelInstanceIndex] = (),
    ) -> None:
        super().__init__()
        require_positive(wheel_radius=wheel_radius)
        self._parameters = parameters or MagnetParameters()
        self._wheel_radius = wheel_radius
        self._shell_radius = shell_parameters.radius
        self._friction = shell_parameters.friction
        bodies = [plant.get_body(index) for index in plant.GetBodyIndices(model)]
        wheels = [body.index() for body in bodies if body.name().endswith("_wheel")]
        require(len(wheels) >= 3, "wheels", len(wheels), "at least three bodies named ..._wheel")
        self._wheels = [int(index) for index in wheels]
        self._shell = int(plant.GetBodyByName("shell", shell).index())
        self._bodies = [*wheels, BodyIndex(self._shell)]
        self._pulled = [*self._wheels, self._shell]
        self._supports = _supports(plant, wheels)
        # Which wheel bears on which support, and which way its rocker turns.
        self._bearing = np.zeros((len(self._supports), len(wheels)))
        self._senses = np.ones(len(self._supports))
        for k, (_, borne, rocker) in enumerate(self._supports):
            self._bearing[k, borne] = 1.0
            self._senses[k] = 1.0 if rocker == self._supports[0].rocker else -1.0
        base = plant.GetBodyByName("base_link", model)
        self._base = int(base.index())
        context = plant.CreateDefaultContext()
        X_BW = base.EvalPoseInWorld(context).inverse()
        p_BCom = X_BW.multiply(plant.CalcCenterOfMassPositionInWorld(context, [model]))
        # Bodies, their masses, and where in them the centre of mass is; the robot as one.
        names = [plant.GetModelInstanceName(instance) for instance in carried]
        allowed = "neither the robot itself nor its shell, and none twice"
        distinct = {int(instance) for instance in (*carried, model, shell)}
        require(len(distinct) == len(carried) + 2, "carried", names, allowed)
        bodies = [
            plant.get_body(index)
            for instance in carried
            for index in plant.GetBodyIndices(instance)
        ]
        self._loads = [
            (self._base, plant.CalcTotalMass(context, [model]), p_BCom),
            *(
                (
                    int(body.index()),
                    body.get_mass(context),
                    body.CalcCenterOfMassInBodyFrame(context),
                )
                for body in bodies
            ),
        ]
        self._mass = sum(mass for _, mass, _ in self._loads)
        self._weight = self._mass * plant.gravity_field().gravity_vector()
        self._body_poses_input = self.DeclareAbstractInputPort(
            "body_poses", AbstractValue.Make([RigidTransform()])
        )
        poses = {self._body_poses_input.ticket()}
        # To be filled in at each step: to make them takes as long as all else.
        self._blank_forces = self.DeclareCacheEntry(
            "forces to be filled in",
            ValueProducer(allocate=lambda: AbstractValue.Make([]), calc=self._calc_blank_forces),
            {self.nothing_ticket()},
        )
        self._forces_output = self.DeclareAbstractOutputPort(
            "forces",
            lambda: AbstractValue.Make([ExternallyAppliedSpatialForce()]),
            self._calc_forces,
            poses,
        )
        self._gaps_output = self.DeclareVectorOutputPort(
            "gaps", len(wheels), self._calc_gaps, poses
        )
        self._margin_output = self.DeclareVectorOutputPort("margin", 1, self._calc_margin, poses)
        self._detached_output = self.DeclareVectorOutputPort(
            "detached", 1, self._calc_detached, poses
        )

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder, plant: MultibodyPlant, **arguments: Any
    ) -> MagneticAdhesion:
        """Adds the block for the only robot on magnets in a plant, connected both ways.

        Of several robots the forces have to be joined: `JoinForces`.

        Args:
            builder: of the diagram that the plant is in.
            plant: finalized.
            arguments: the others of the constructor.
        """
        adhesion = builder.AddSystem(MagneticAdhesion(plant=plant, **arguments))
        builder.Connect(plant.get_body_poses_output_port(), adhesion.body_poses_input_port())
        builder.Connect(adhesion.forces_output_port(), plant.get_applied_spatial_force_input_port())
        return adhesion

    def body_poses_input_port(self) -> InputPort:
        """Returns the port of the poses of all bodies."""
        return self._body_poses_input

    def forces_output_port(self) -> OutputPort:
        """Returns the port of the forces."""
        return self._forces_output

    def gaps_output_port(self) -> OutputPort:
        """Returns the port of the gaps."""
        return self._gaps_output

    def margin_output_port(self) -> OutputPort:
        """Returns the port of the adhesion margin."""
        return self._margin_output

    def detached_output_port(self) -> OutputPort:
        """Returns the port that tells whether the robot has come off."""
        return self._detached_output

    def _centres(self, poses: list[RigidTransform]) -> Array:
        """Returns where the wheels' middles are, and last the shell's centre, (n + 1, 3) m."""
        return np.array([poses[body].translation() for body in self._pulled])

    def _wheels_seen(self, poses: list[RigidTransform]) -> tuple[Array, Array]:
        """Returns where the wheels' middles are from the shell's centre, (n, 3) m, and how far."""
        *wheels, centre = self._centres(poses)
        offsets = np.array(wheels) - centre
        return offsets, np.sqrt((offsets * offsets).sum(axis=1))

    def _gap(self, distances: Array) -> Array:
        return distances - (self._shell_radius + self._wheel_radius)

    def _calc_forces(self, context: Context, output: Any) -> None:
        F = np.zeros((len(self._pulled), 6))
        magnets = self._parameters
        _pull(
            self._centres(self._body_poses_input.Eval(context)),
            self._shell_radius + self._wheel_radius, float(magnets.force), float(magnets.gap), F,
        )  # fmt: skip
        forces = self._blank_forces.Eval(context)
        for force, F_W in zip(forces, F, strict=True):
            force.F_Bq_W = SpatialForce(F_W)
        output.set_value(forces)

    def _calc_blank_forces(self, context: Context, output: AbstractValue) -> None:
        del context
        forces = [ExternallyAppliedSpatialForce() for _ in self._bodies]
        for force, body in zip(forces, self._bodies, strict=True):
            force.body_index = body
        output.set_value(forces)

    def _calc_gaps(self, context: Context, output: Any) -> None:
        output.SetFromVector(self._gap(self._wheels_seen(self._body_poses_input.Eval(context))[1]))

    def _calc_detached(self, context: Context, output: Any) -> None:
        gaps = self._gap(self._wheels_seen(self._body_poses_input.Eval(context))[1])
        output.SetFromVector([float(gaps.min() > self._parameters.detached_gap)])

    def _calc_margin(self, context: Context, output: Any) -> None:
        poses = self._body_poses_input.Eval(context)
        centre = poses[self._shell].translation()
        offsets, distances = self._wheels_seen(poses)
        contacts = offsets * (self._shell_radius / distances)[:, None]
        moment = sum(mass * poses[body].multiply(p) for body, mass, p in self._loads)
        margin = adhesion_margin(
            contacts=contacts,
            pulls=magnet_force(self._gap(distances), self._parameters),
            weight=self._weight,
            centre_of_mass=moment / self._mass - centre,
            friction=self._friction,
            suspension=self._suspension(poses, contacts) if self._supports else None,
        )
        output.SetFromVector([margin])

    def _suspension(self, poses: list[RigidTransform], contacts: Array) -> Suspension:
        centre = poses[self._shell].translation()
        supports = np.array(
            [
                contacts[wheels[0]] if pivot is None else poses[pivot].translation() - centre
                for pivot, wheels, _ in self._supports
            ]
        )
        rockers = np.array(
            [poses[rocker].translation() - centre for _, _, rocker in self._supports]
        )
        axis = cross_matrix(poses[self._base].rotation().matrix()[:, 1])
        sway = self._senses[:, None] * ((supports - rockers) @ axis.T)
        return Suspension(supports, self._bearing, sway)


class _Support(NamedTuple):
    """Where a robot on rockers rests: indices of bodies, and of the wheels that bear on it."""

    pivot: int | None  # of a bogie; None for a wheel's own contact
    wheels: list[int]
    rocker: int


def _supports(plant: MultibodyPlant, wheels: list[BodyIndex]) -> list[_Support]:
    """Returns what the wheels bear on if all are on two rockers, else nothing."""
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    mounts = {int(joint.child_body().index()): joint.parent_body() for joint in joints}
    found: dict[int, _Support] = {}
    for place, wheel in enumerate(wheels):
        mount = mounts.get(int(wheel))
        pivot = None
        if mount is not None and mount.name().endswith("_bogie"):
            pivot = int(mount.index())
            mount = mounts.get(pivot)
        if mount is None or not mount.name().endswith("_rocker"):
            return []
        key = int(wheel) if pivot is None else pivot
        found.setdefault(key, _Support(pivot, [], int(mount.index()))).wheels.append(place)
    supports = list(found.values())
    return supports if len({support.rocker for support in supports}) == 2 else []


class JoinForces(LeafSystem):
    """Joins the forces of several robots for the plant, which takes them on one port.

    .. pydrake_system::

        name: JoinForces
        input_ports:
        - "forces_{k}"
        output_ports:
        - forces

    Args:
        robots: how many, n.

    Ports:
        forces_{k} (input, list): of one of them, such as `MagneticAdhesion` sends.
        forces (output, list): all of them, in that order, for `applied_spatial_force`.

    Raises:
        ValueError: no robot.
    """

    def __init__(self, *, robots: int) -> None:
        super().__init__()
        require(robots >= 1, "robots", robots, "at least 1")
        model = AbstractValue.Make([ExternallyAppliedSpatialForce()])
        self._inputs = [
            self.DeclareAbstractInputPort(f"forces_{k + 1}", model) for k in range(robots)
        ]
        self._forces_output = self.DeclareAbstractOutputPort(
            "forces",
            lambda: AbstractValue.Make([ExternallyAppliedSpatialForce()]),
            self._calc_forces,
            {port.ticket() for port in self._inputs},
        )

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder, plant: MultibodyPlant, adhesions: Sequence[MagneticAdhesion]
    ) -> JoinForces:
        """Adds the block for all robots on magnets in a plant, which are connected both ways.

        Args:
            builder: of the diagram that the plant is in.
            plant: finalized.
            adhesions: in the diagram, not connected yet.
        """
        joined = builder.AddSystem(JoinForces(robots=len(adhesions)))
        for k, adhesion in enumerate(adhesions):
            builder.Connect(plant.get_body_poses_output_port(), adhesion.body_poses_input_port())
            builder.Connect(adhesion.forces_output_port(), joined.forces_input_port(k + 1))
        builder.Connect(joined.forces_output_port(), plant.get_applied_spatial_force_input_port())
        return joined

    def forces_input_port(self, k: int) -> InputPort:
        """Returns the port of the k-th robot's forces, k from 1."""
        return self._inputs[k - 1]

    def forces_output_port(self) -> OutputPort:
        """Returns the port of all forces."""
        return self._forces_output

    def _calc_forces(self, context: Context, output: Any) -> None:
        output.set_value([force for port in self._inputs for force in port.Eval(context)])
