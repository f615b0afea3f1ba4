"""Magnetic wheels: what holds a robot on a steel shell, and by how much more than it needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

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
)

from plants.shell import ShellParameters
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


def adhesion_margin(
    contacts: Array, pulls: Array, weight: Array, centre_of_mass: Array, friction: float
) -> float:
    """Returns the adhesion that a robot has over the adhesion that it needs to stay on a sphere.

    It needs as much as keeps it, at rest, from slipping and from tipping over any edge of its
    wheels. So below 1 it comes off or slides down, and at 3 the magnets could be a third as strong.

    Slipping: the pulls and the normal forces all point to the sphere's centre, so that friction
    alone balances the moment of the weight about it. With the centre of mass at the distance l, the
    outward normal n there, and W = W_n n + W_t, that takes sum |T| >= |W_t| l / R. What friction
    can give is mu sum N, where the forces along n balance: c sum N = H - W_n, with
    H = sum F (n_i n) and c the mean of n_i n. So H >= W_n + c |W_t| l / (mu R). With W_t = 0 this
    says that the pulls carry the weight.

    Tipping: about the line through two contacts, when all others have lost their normal forces, the
    moment of the pulls must hold that of the weight. All pairs with no wheel beyond are tried.

    Both are necessary for equilibrium, not sufficient: a robot may slip and tip at once. The linear
    programme of all normal and friction forces, which takes a thousand times as long, finds 0 to
    25 % less (as a rule 5 %), as the tests show.

    Args:
        contacts: (n, 3) m, n >= 3, where the wheels touch, from the sphere's centre; any frame.
        pulls: (n,) N, of the magnets, toward the centre.
        weight: (3,) N, as a force, in that frame.
        centre_of_mass: (3,) m, of the robot, from the sphere's centre.
        friction: coefficient between wheel and sphere.

    Returns:
        The ratio; inf when no adhesion is needed.
    """
    R = np.sqrt((contacts * contacts).sum(axis=1)).mean()
    distance = np.sqrt(centre_of_mass @ centre_of_mass)
    n = centre_of_mass / distance
    outward = weight @ n
    along = weight - outward * n
    cosines = contacts @ n / R
    grip = np.sqrt(along @ along) * distance * cosines.mean()
    needed = outward + (grip / (friction * R) if friction > 0 else np.inf if grip > 0 else 0.0)
    margin = pulls @ cosines / needed if needed > 0 else np.inf

    count = len(contacts)
    first, second = np.repeat(np.arange(count), count), np.tile(np.arange(count), count)
    p, q = contacts[first], contacts[second]
    beyond = _cross(p, q) @ contacts.T
    edges = (beyond <= 1e-9 * R**3).all(axis=1) & (first != second)
    holding = -beyond[edges] @ pulls / R
    tipping = -(_cross(centre_of_mass - p[edges], weight) * (q - p)[edges]).sum(axis=1)
    tips = tipping > 0
    if tips.any():
        margin = min(margin, (holding[tips] / tipping[tips]).min())
    return float(margin)


def _cross(a: Array, b: Array) -> Array:
    # numpy's own takes ten times as long for a handful of vectors.
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]


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
            middles.
        shell: model instance of the sphere; its body is `shell`.
        wheel_radius: m.
        shell_parameters: the sphere.
        parameters: the magnets.

    Ports:
        body_poses (input, list): the plant's `body_poses`.
        forces (output, list): `ExternallyAppliedSpatialForce` of each wheel, toward the sphere's
            centre, and last their reaction on the sphere: for the plant's
            `applied_spatial_force` (of several robots: joined).
        gaps (output, vector of one for each wheel): between wheel and shell, in the order of the
            bodies, m; negative when they are pressed together.
        margin (output, vector of 1): see `adhesion_margin`; of the robot as it stands in the
            default context, under the plant's gravity. The shell's own acceleration and what the
            robot may carry are left out. Inf when it needs no adhesion.
        detached (output, vector of 1): 1 when all gaps are above `detached_gap`, else 0.

    Raises:
        ValueError: less than three wheels.
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
        self._pulled = [*wheels, BodyIndex(self._shell)]
        base = plant.GetBodyByName("base_link", model)
        self._base = int(base.index())
        context = plant.CreateDefaultContext()
        mass = plant.CalcTotalMass(context, [model])
        self._weight = mass * plant.gravity_field().gravity_vector()
        X_BW = base.EvalPoseInWorld(context).inverse()
        self._p_BCom = X_BW.multiply(plant.CalcCenterOfMassPositionInWorld(context, [model]))
        self._body_poses_input = self.DeclareAbstractInputPort(
            "body_poses", AbstractValue.Make([RigidTransform()])
        )
        poses = {self._body_poses_input.ticket()}
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

    def _wheels_seen(self, poses: list[RigidTransform]) -> tuple[Array, Array]:
        """Returns where the wheels' middles are from the shell's centre, (n, 3) m, and how far."""
        centre = poses[self._shell].translation()
        offsets = np.array([poses[wheel].translation() for wheel in self._wheels]) - centre
        return offsets, np.sqrt((offsets * offsets).sum(axis=1))

    def _gap(self, distances: Array) -> Array:
        return distances - (self._shell_radius + self._wheel_radius)

    def _calc_forces(self, context: Context, output: Any) -> None:
        offsets, distances = self._wheels_seen(self._body_poses_input.Eval(context))
        pulls = magnet_force(self._gap(distances), self._parameters)
        vectors = offsets * (-pulls / distances)[:, None]
        F = np.zeros((len(self._pulled), 6))
        F[:-1, 3:] = vectors
        F[-1, 3:] = -vectors.sum(axis=0)
        output.set_value([_at_origin(*pair) for pair in zip(self._pulled, F, strict=True)])

    def _calc_gaps(self, context: Context, output: Any) -> None:
        output.SetFromVector(self._gap(self._wheels_seen(self._body_poses_input.Eval(context))[1]))

    def _calc_detached(self, context: Context, output: Any) -> None:
        gaps = self._gap(self._wheels_seen(self._body_poses_input.Eval(context))[1])
        output.SetFromVector([float(gaps.min() > self._parameters.detached_gap)])

    def _calc_margin(self, context: Context, output: Any) -> None:
        poses = self._body_poses_input.Eval(context)
        offsets, distances = self._wheels_seen(poses)
        margin = adhesion_margin(
            contacts=offsets * (self._shell_radius / distances)[:, None],
            pulls=magnet_force(self._gap(distances), self._parameters),
            weight=self._weight,
            centre_of_mass=poses[self._base].multiply(self._p_BCom)
            - poses[self._shell].translation(),
            friction=self._friction,
        )
        output.SetFromVector([margin])


def _at_origin(body: BodyIndex, F_W: Array) -> ExternallyAppliedSpatialForce:
    applied = ExternallyAppliedSpatialForce()
    applied.body_index = body
    applied.F_Bq_W = SpatialForce(F_W)
    return applied
