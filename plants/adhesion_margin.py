"""By how much more a robot is held on a sphere than it needs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from systems.markers.pnp import cross_matrix

Array = NDArray[np.float64]

# How much more a support is held in its contact than along the surface, where a lifting robot has
# to slip by a little: enough for the least slip, and well conditioned.
_FIRMNESS = 1e3


class Suspension(NamedTuple):
    """What a robot on rockers and bogies stands on, and how its rockers give way.

    A wheel on a rocker supports it where it touches. Wheels on a bogie do so at its pivot: what
    they bear, and what their magnets hold, passes through it. The rockers turn by opposite angles.

    Attributes:
        supports: (m, 3) m, from the sphere's centre.
        bearing: (m, n) 1 where a wheel bears on a support, else 0.
        sway: (m, 3) m, how far each support goes for each radian that the rockers turn.
    """

    supports: Array
    bearing: Array
    sway: Array


def adhesion_margin(
    contacts: Array,
    pulls: Array,
    weight: Array,
    centre_of_mass: Array,
    friction: float,
    suspension: Suspension | None = None,
) -> float:
    """Returns the adhesion that a robot has over the adhesion that it needs to stay on a sphere.

    It needs as much as keeps it, at rest, from slipping and from tipping. So below 1 it comes off
    or slides down, and at 3 the magnets could be a third as strong.

    Slipping: the pulls and the normal forces all point to the sphere's centre, so that friction
    alone balances the moment of the weight about it. With the centre of mass at the distance l, the
    outward normal n there, and W = W_n n + W_t, that takes sum |T| >= |W_t| l / R. What friction
    can give is mu sum N, where the forces along n balance: c sum N = H - W_n, with
    H = sum F (n_i n) and c the mean of n_i n. So H >= W_n + c |W_t| l / (mu R). With W_t = 0 this
    says that the pulls carry the weight.

    Tipping, of a rigid robot: about the line through two contacts, when all others have lost their
    normal forces, the moment of the pulls must hold that of the weight. All pairs with no wheel
    beyond are tried. Of one on rockers: a single support lifts off while the others stay, as the
    rockers turn; the pulls must take more work in that than the weight gives. So it tips over its
    bogies' pivots, before their outer wheels, and aslant sooner than to either side.

    Both are necessary for equilibrium, not sufficient: a robot may slip and tip at once. The linear
    programme of all normal and friction forces, which takes a thousand times as long, finds 0 to
    25 % less (as a rule 5 %) of a rigid robot, as the tests show. Of one on rockers it finds 25 %
    less to 20 % more: there the contacts slip a little as a support lifts, and friction, which
    would resist it, is left out. A load that comes on at once, as when a simulation starts, makes
    a robot fall up to 1.4.

    Args:
        contacts: (n, 3) m, n >= 3, where the wheels touch, from the sphere's centre; any frame.
        pulls: (n,) N, of the magnets, toward the centre.
        weight: (3,) N, as a force, in that frame.
        centre_of_mass: (3,) m, of the robot and all that it carries, from the sphere's centre.
        friction: coefficient between wheel and sphere.
        suspension: what gives way; by default nothing does.

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
    held = contacts * (-pulls / R)[:, None]
    holding, tipping = (
        _about_edges(contacts, held, weight, centre_of_mass)
        if suspension is None
        else _by_lifting(suspension, held, weight, centre_of_mass)
    )
    tips = tipping > 0
    if tips.any():
        margin = min(margin, (holding[tips] / tipping[tips]).min())
    return float(margin)


def _about_edges(
    contacts: Array, held: Array, weight: Array, centre_of_mass: Array
) -> tuple[Array, Array]:
    """Returns the moments of the pulls (n, 3) N and of the weight about each edge."""
    count = len(contacts)
    first, second = np.repeat(np.arange(count), count), np.tile(np.arange(count), count)
    beyond = _cross(contacts[first], contacts[second]) @ contacts.T
    edges = (beyond <= 1e-9 * np.abs(beyond).max()).all(axis=1) & (first != second)
    p, q = contacts[first[edges]], contacts[second[edges]]
    # (c - p) x F . (q - p), which with F toward the centre is (p x q) . F.
    holding = (_cross(p, q) @ held.T).sum(axis=1)
    tipping = -(_cross(centre_of_mass - p, weight) * (q - p)).sum(axis=1)
    return holding, tipping


def _by_lifting(
    suspension: Suspension, held: Array, weight: Array, centre_of_mass: Array
) -> tuple[Array, Array]:
    """Returns the work that the pulls (n, 3) N take and the weight gives as each support lifts."""
    supports, bearing, sway = suspension
    forces = bearing @ held
    count = len(supports)
    inward = forces / np.sqrt((forces * forces).sum(axis=1, keepdims=True))
    # How the supports move with the robot's velocity at the centre, its turn, and the rockers'.
    J = np.zeros((count, 3, 7))
    J[:, :, :3] = np.eye(3)
    J[:, :, 3:6] = -cross_matrix(supports)
    J[:, :, 6] = sway
    normal = inward[:, :, None] * inward[:, None]
    along = np.eye(3) - normal
    # Of the motions in which one leaves the surface by 1 m/s, that in which the others slip least.
    firm = _FIRMNESS * normal + (1 - np.eye(count))[:, :, None, None] * along
    A = (firm @ J).reshape(count, 3 * count, 7)
    lifted = np.eye(count)[:, :, None] * -_FIRMNESS * inward
    u = (np.linalg.pinv(A) @ lifted.reshape(count, -1, 1))[:, :, 0]
    holding = -np.einsum("si,sij,kj->k", forces, J, u)
    return holding, u[:, :3] @ weight + _cross(u[:, 3:6], centre_of_mass) @ weight


def _cross(a: Array, b: Array) -> Array:
    # numpy's own takes ten times as long for a handful of vectors.
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]
