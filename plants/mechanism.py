"""Where some bodies of a plant are, and what forces on them do to its joints, in compiled code.

The plant's own ports tell the poses of all bodies and take spatial forces, but as lists, and to
make these for Python takes longer than all that is done with them at each step.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    Joint,
    PrismaticJoint,
    QuaternionFloatingJoint,
    RevoluteJoint,
    RigidBody,
    WeldJoint,
)

from systems.compiled import compiled, packed
from systems.small_matrices import multiply, rotation_of, rotation_of_quaternion
from systems.validation import require

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_KINDS = (WeldJoint, RevoluteJoint, PrismaticJoint, QuaternionFloatingJoint)
_WELD, _REVOLUTE, _PRISMATIC, _FLOATING = range(4)


class Mechanism:
    """Some bodies of a plant, with all that they hang on.

    Of a body C on its parent P by a joint from the frame F of P to the frame M of C, the pose is
    `X_WC = X_WP X_PF X_FM(q) X_MC`.

    Args:
        plant: finalized.
        bodies: m of them, whose poses are asked for and on which forces act.

    Attributes:
        links: (n, 4) of each body in turn, the world first and parents before their children:
            number of its parent in this list, kind of its joint, its first position, its first
            velocity.
        shapes: (n, 27) of each: `R_PF` row by row, `p_PF`, `R_MC`, `p_MC` (of a weld `X_FC`), and
            the joint's axis in F.
        places: (m,) which of them the given bodies are.

    Raises:
        ValueError: a joint of another kind than welded, revolute, prismatic or floating.
    """

    def __init__(self, plant: MultibodyPlant, bodies: Sequence[RigidBody]) -> None:
        joints: dict[int, Joint] = {}
        for index in plant.GetJointIndices():
            joint = plant.get_joint(index)
            joints[int(joint.child_body().index())] = joint
        places = {int(plant.world_body().index()): 0}
        links, shapes = [np.array([-1, _WELD, -1, -1])], [np.zeros(27)]

        def add(body: RigidBody) -> int:
            index = int(body.index())
            if index not in places:
                joint = joints[index]
                parent = add(joint.parent_body())
                places[index] = len(links)
                links.append(_link(joint, parent))
                shapes.append(_shape(joint))
            return places[index]

        self.places: Indices = np.array([add(body) for body in bodies])
        self.links: Indices = np.array(links)
        self.shapes: Array = np.array(shapes)

    def poses(self, state: Array) -> tuple[Array, Array]:
        """Returns rotations `R_WB` (m, 3, 3) and origins `p_WB` (m, 3) m of the bodies.

        Args:
            state: of the plant, positions first.
        """
        n = len(self.links)
        R, p = np.empty((n, 3, 3)), np.empty((n, 3))
        _poses(self.links, self.shapes, packed(state), R, p)
        return R[self.places], p[self.places]


def _link(joint: Joint, parent: int) -> Indices:
    kinds = [k for k, kind in enumerate(_KINDS) if isinstance(joint, kind)]
    require(bool(kinds), joint.name(), joint.type_name(), "welded, revolute, prismatic or floating")
    return np.array([parent, kinds[0], joint.position_start(), joint.velocity_start()])


def _shape(joint: Joint) -> Array:
    X_PF = joint.frame_on_parent().GetFixedPoseInBodyFrame()
    X_MC = joint.frame_on_child().GetFixedPoseInBodyFrame().inverse()
    axis = np.zeros(3)
    if isinstance(joint, WeldJoint):
        X_MC = joint.X_FM() @ X_MC
    elif isinstance(joint, RevoluteJoint):
        axis = joint.revolute_axis()
    elif isinstance(joint, PrismaticJoint):
        axis = joint.translation_axis()
    rotations = [X.rotation().matrix().ravel() for X in (X_PF, X_MC)]
    return np.concatenate(
        [rotations[0], X_PF.translation(), rotations[1], X_MC.translation(), axis]
    )


@compiled("void(i8[:,::1], f8[:,::1], f8[::1], f8[:,:,::1], f8[:,::1])")
def _poses(links: Indices, shapes: Array, q: Array, R: Array, p: Array) -> None:
    pivots, axes = np.empty((len(links), 3)), np.empty((len(links), 3))
    place_links(links, shapes, q, R, p, pivots, axes)


@compiled()
def place_links(
    links: Indices, shapes: Array, q: Array, R: Array, p: Array, pivots: Array, axes: Array
) -> None:
    """Writes where all bodies are.

    Args:
        links: see `Mechanism`, as `shapes`.
        shapes: likewise.
        q: positions of the plant.
        R: (n, 3, 3) written: `R_WB`.
        p: (n, 3) written: `p_WB`, m.
        pivots: (n, 3) written: origins in W of the frames F of the joints, m.
        axes: (n, 3) written: the joints' axes in W.
    """
    R_FM, p_FM, R_WF, R_WM = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for k in range(len(links)):
        parent, kind, at = links[k, 0], links[k, 1], links[k, 2]
        if parent < 0:
            R[k], p[k], pivots[k], axes[k] = np.eye(3), 0.0, 0.0, 0.0
            continue
        p_PF, p_MC, axis = shapes[k, 9:12], shapes[k, 21:24], shapes[k, 24:27]
        R_FM[:], p_FM[:] = np.eye(3), 0.0
        if kind == _REVOLUTE:
            rotation_of(axis * q[at], R_FM)
        elif kind == _PRISMATIC:
            p_FM[:] = axis * q[at]
        elif kind == _FLOATING:
            rotation_of_quaternion(q[at : at + 4], R_FM)
            p_FM[:] = q[at + 4 : at + 7]
        multiply(R[parent], shapes[k, :9].reshape(3, 3), R_WF)
        multiply(R_WF, R_FM, R_WM)
        multiply(R_WM, shapes[k, 12:21].reshape(3, 3), R[k])
        for i in range(3):
            pivots[k, i], axes[k, i], p[k, i] = p[parent, i], 0.0, 0.0
            for j in range(3):
                pivots[k, i] += R[parent, i, j] * p_PF[j]
                axes[k, i] += R_WF[i, j] * axis[j]
                p[k, i] += R_WF[i, j] * p_FM[j] + R_WM[i, j] * p_MC[j]
            p[k, i] += pivots[k, i]


@compiled()
def add_force(
    links: Indices, p: Array, pivots: Array, axes: Array, place: int, F: Array, tau: Array
) -> None:
    """Adds what a force on a body's origin does to the joints: Jacobian transposed times force.

    Args:
        links: see `Mechanism`.
        p: (n, 3) see `place_links`, as `pivots` and `axes`.
        pivots: likewise.
        axes: likewise.
        place: of the body in `links`.
        F: (3,) the force in W, N.
        tau: (velocities of the plant,) generalized forces, changed.
    """
    moment = np.empty(3)
    k = place
    while links[k, 0] >= 0:
        kind, at = links[k, 1], links[k, 3]
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            centre_a = p[k, a] if kind == _FLOATING else pivots[k, a]
            centre_b = p[k, b] if kind == _FLOATING else pivots[k, b]
            moment[i] = (p[place, a] - centre_a) * F[b] - (p[place, b] - centre_b) * F[a]
        for i in range(3):
            if kind == _REVOLUTE:
                tau[at] += axes[k, i] * moment[i]
            elif kind == _PRISMATIC:
                tau[at] += axes[k, i] * F[i]
            elif kind == _FLOATING:
                tau[at + i] += moment[i]
                tau[at + 3 + i] += F[i]
        k = links[k, 0]
