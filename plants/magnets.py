"""Magnetic wheels: what holds a robot on a steel shell."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, ModelInstanceIndex
from pydrake.systems.framework import Context, DiagramBuilder, InputPort, LeafSystem, OutputPort

from plants.adhesion_margin import Suspension, adhesion_margin
from plants.mechanism import Mechanism, add_force, place_links
from plants.shell import ShellParameters
from systems.compiled import compiled, packed
from systems.markers.pnp import cross_matrix
from systems.validation import require, require_non_negative, require_positive

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


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


@compiled("void(i8[:,::1], f8[:,::1], i8[::1], f8[::1], f8, f8, f8, f8[::1])")
def _pull(
    links: Indices,
    shapes: Array,
    places: Indices,
    state: Array,
    reach: float,
    force: float,
    gap: float,
    tau: Array,
) -> None:
    """Writes what the magnets do to the plant's joints, see `magnet_force`.

    Args:
        links: see `Mechanism`, as `shapes`.
        shapes: likewise.
        places: (n + 1,) in `links`, of the wheels and of the shell.
        state: of the plant.
        reach: distance of a wheel's centre from the shell's when they touch, m.
        force: at contact, N.
        gap: at which a quarter of it is left, m.
        tau: (velocities of the plant,) zeros; the generalized forces are written.
    """
    n, shell = len(links), places[-1]
    R, p, pivots, axes = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    place_links(links, shapes, state, R, p, pivots, axes)
    F, reaction = np.empty(3), np.zeros(3)
    for wheel in places[:-1]:
        square = 0.0
        for i in range(3):
            F[i] = p[shell, i] - p[wheel, i]
            square += F[i] * F[i]
        distance = math.sqrt(square)
        weaker = 1 + max(distance - reach, 0.0) / gap
        for i in range(3):
            F[i] *= force / (weaker * weaker) / distance
            reaction[i] -= F[i]
        add_force(links, p, pivots, axes, wheel, F, tau)
    add_force(links, p, pivots, axes, shell, reaction, tau)


class MagneticAdhesion(LeafSystem):
    """Pulls the wheels of a robot to a shell, and the shell to them.

    .. pydrake_system::

        name: MagneticAdhesion
        input_ports:
        - state
        output_ports:
        - generalized_forces
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
        state (input, vector of positions and velocities): of the plant, all of it.
        generalized_forces (output, vector of its velocities): what the pull of each wheel toward
            the sphere's centre, and their reaction on the sphere, do to the joints; for the plant's
            `applied_generalized_force` (of several robots: their sum).
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
        self._shell_radius = shell_parameters.radius
        self._reach = shell_parameters.radius + wheel_radius
        self._friction = shell_parameters.friction
        bodies = [plant.get_body(index) for index in plant.GetBodyIndices(model)]
        wheels = [body.index() for body in bodies if body.name().endswith("_wheel")]
        require(len(wheels) >= 3, "wheels", len(wheels), "at least three bodies named ..._wheel")
        self._supports = _supports(plant, wheels)
        # Which wheel bears on which support, and which way its rocker turns.
        self._bearing = np.zeros((len(self._supports), len(wheels)))
        self._senses = np.ones(len(self._supports))
        for k, support in enumerate(self._supports):
            self._bearing[k, support.wheels] = 1.0
            self._senses[k] = 1.0 if support.rocker == self._supports[0].rocker else -1.0
        base = plant.GetBodyByName("base_link", model)
        context = plant.CreateDefaultContext()
        X_BW = base.EvalPoseInWorld(context).inverse()
        p_BCom = X_BW.multiply(plant.CalcCenterOfMassPositionInWorld(context, [model]))
        names = [plant.GetModelInstanceName(instance) for instance in carried]
        allowed = "neither the robot itself nor its shell, and none twice"
        distinct = {int(instance) for instance in (*carried, model, shell)}
        require(len(distinct) == len(carried) + 2, "carried", names, allowed)
        loads = [
            plant.get_body(index)
            for instance in carried
            for index in plant.GetBodyIndices(instance)
        ]
        # Bodies' masses, and where in them the centre of mass is; the robot as one.
        self._masses = np.array(
            [plant.CalcTotalMass(context, [model]), *(body.get_mass(context) for body in loads)]
        )
        self._centres_of_mass = np.array(
            [p_BCom, *(body.CalcCenterOfMassInBodyFrame(context) for body in loads)]
        )
        self._weight = self._masses.sum() * plant.gravity_field().gravity_vector()
        # What is asked at each step, and what the margin asks beside: where they are in its list.
        sphere = plant.GetBodyByName("shell", shell)
        self._pulled = Mechanism(plant, [*map(plant.get_body, wheels), sphere])
        rockers = [plant.get_body(support.rocker) for support in self._supports]
        bearers = [plant.get_body(support.body) for support in self._supports]
        self._weighed = Mechanism(plant, [*rockers, *bearers, base, *loads])
        self._state_input = self.DeclareVectorInputPort("state", plant.num_multibody_states())
        state = {self._state_input.ticket()}
        self._num_velocities = plant.num_velocities()
        self._forces_output = self.DeclareVectorOutputPort(
            "generalized_forces", self._num_velocities, self._calc_forces, state
        )
        self._gaps_output = self.DeclareVectorOutputPort(
            "gaps", len(wheels), self._calc_gaps, state
        )
        self._margin_output = self.DeclareVectorOutputPort("margin", 1, self._calc_margin, state)
        self._detached_output = self.DeclareVectorOutputPort(
            "detached", 1, self._calc_detached, state
        )

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder, plant: MultibodyPlant, **arguments: Any
    ) -> MagneticAdhesion:
        """Adds the block for the only robot on magnets in a plant, connected both ways.

        Of several robots the forces have to be added.

        Args:
            builder: of the diagram that the plant is in.
            plant: finalized.
            arguments: the others of the constructor.
        """
        adhesion = builder.AddSystem(MagneticAdhesion(plant=plant, **arguments))
        builder.Connect(plant.get_state_output_port(), adhesion.state_input_port())
        builder.Connect(
            adhesion.generalized_forces_output_port(),
            plant.get_applied_generalized_force_input_port(),
        )
        return adhesion

    def state_input_port(self) -> InputPort:
        """Returns the port of the plant's state."""
        return self._state_input

    def generalized_forces_output_port(self) -> OutputPort:
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

    def _calc_forces(self, context: Context, output: Any) -> None:
        bodies, magnets, tau = self._pulled, self._parameters, np.zeros(self._num_velocities)
        _pull(
            bodies.links, bodies.shapes, bodies.places, packed(self._state_input.Eval(context)),
            self._reach, float(magnets.force), float(magnets.gap), tau,
        )  # fmt: skip
        output.SetFromVector(tau)

    def _calc_gaps(self, context: Context, output: Any) -> None:
        output.SetFromVector(self._wheels_seen(context)[1] - self._reach)

    def _calc_detached(self, context: Context, output: Any) -> None:
        gaps = self._wheels_seen(context)[1] - self._reach
        output.SetFromVector([float(gaps.min() > self._parameters.detached_gap)])

    def _wheels_seen(self, context: Context) -> tuple[Array, Array, Array]:
        """Returns where the wheels' middles are from the shell's centre, (n, 3) m; how far; it."""
        *wheels, centre = self._pulled.poses(self._state_input.Eval(context))[1]
        offsets = np.array(wheels) - centre
        return offsets, np.sqrt((offsets * offsets).sum(axis=1)), centre

    def _calc_margin(self, context: Context, output: Any) -> None:
        offsets, distances, centre = self._wheels_seen(context)
        contacts = offsets * (self._shell_radius / distances)[:, None]
        R, p = self._weighed.poses(self._state_input.Eval(context))
        p, base = p - centre, 2 * len(self._supports)
        moments = self._masses @ (
            p[base:] + np.einsum("nij,nj->ni", R[base:], self._centres_of_mass)
        )
        margin = adhesion_margin(
            contacts=contacts,
            pulls=magnet_force(distances - self._reach, self._parameters),
            weight=self._weight,
            centre_of_mass=moments / self._masses.sum(),
            friction=self._friction,
            suspension=self._suspension(contacts, p[:base], R[base, :, 1]),
        )
        output.SetFromVector([margin])

    def _suspension(self, contacts: Array, p: Array, y: Array) -> Suspension | None:
        """Returns what bears the robot.

        Args:
            contacts: (n, 3) of the wheels from the shell's centre, m.
            p: (2 m, 3) of the supports' rockers, then of the supports, likewise.
            y: (3,) the robot's axis.
        """
        if not self._supports:
            return None
        rockers, supports = np.split(p, 2)
        for k, support in enumerate(self._supports):
            if support.is_wheel:
                supports[k] = contacts[support.wheels[0]]
        sway = self._senses[:, None] * ((supports - rockers) @ cross_matrix(y).T)
        return Suspension(supports, self._bearing, sway)


class _Support(NamedTuple):
    """Where a robot on rockers rests."""

    body: BodyIndex  # a bogie, with its pivot as its origin, or a wheel
    is_wheel: bool  # it bears on the shell itself
    wheels: list[int]  # numbers of those that bear on it
    rocker: BodyIndex


def _supports(plant: MultibodyPlant, wheels: list[BodyIndex]) -> list[_Support]:
    """Returns what the wheels bear on if all are on two rockers, else nothing."""
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    mounts = {int(joint.child_body().index()): joint.parent_body() for joint in joints}
    found: dict[int, _Support] = {}
    for number, wheel in enumerate(wheels):
        body, mount = wheel, mounts.get(int(wheel))
        if mount is not None and mount.name().endswith("_bogie"):
            body = mount.index()
            mount = mounts.get(int(body))
        if mount is None or not mount.name().endswith("_rocker"):
            return []
        support = _Support(body, body == wheel, [], mount.index())
        found.setdefault(int(body), support).wheels.append(number)
    supports = list(found.values())
    return supports if len({int(support.rocker) for support in supports}) == 2 else []
