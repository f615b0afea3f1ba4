"""Ray casting against the solids of a scene, which Drake itself does not offer.

Each ray is tried against each solid whose bounding sphere it meets; what a trial does is in
`systems.solid_shapes`.

Touching a solid without entering it may count as a hit or as a miss: rounding decides.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import FrameId, QueryObject, Role, SceneGraphInspector, Shape
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem, ValueProducer

from systems.compiled import compiled, in_rows
from systems.solid_shapes import (
    CAPSULE,
    ROUND_BOX,
    TINY,
    describe,
    enter_capsule,
    enter_hull,
    enter_round_box,
)
from systems.validation import require

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Rounding must not turn away a ray that only just meets what holds a solid.
_SLACK = 1e-9
_WORLD = np.eye(3, 4)

SolidArrays = tuple[Array, Array, Array, Index, Index, Array, Index, Index, Array]
"""Solids for compiled code, where they are a tuple:

(k, 3) centres, m; (k, 3, 3) from the world to the unit shape; (k,) radii of the spheres around the
centres that hold them, m; then of `systems.solid_shapes`: (k,) kinds, (k,) dimensions of round
boxes, (k,) ratios of capsules, (k,) where a hull's faces begin and (k,) how many they are, (..., 4)
the faces of all hulls.
"""
SOLID_ARRAYS = (
    "Tuple((f8[:,::1], f8[:,:,::1], f8[::1], i8[::1], i8[::1], f8[::1], i8[::1], i8[::1],"
    " f8[:,::1]))"
)
"""Numba's signature of it."""


class Solids:
    """Convex solids at rest, ready for rays. Immutable.

    Args:
        shapes: Drake's shapes. A `Mesh` counts as its convex hull (as in Drake's contact queries);
            a mesh or hull that is flat and a sphere of radius 0 are never hit.
        poses: X_WS of each.

    Raises:
        ValueError: lists of different lengths, or a shape of another kind.
    """

    def __init__(self, shapes: Sequence[Shape], poses: Sequence[RigidTransform]) -> None:
        require(len(poses) == len(shapes), "poses", len(poses), f"{len(shapes)}, one a shape")
        described = [(i, describe(shape)) for i, shape in enumerate(shapes)]
        kept = [(i, solid) for i, solid in described if solid is not None]
        solids = [solid for _, solid in kept]
        self._order = np.array([i for i, _ in kept], np.intp)
        self._numbers = np.append(self._order, -1)  # where -1, for none, finds itself
        k = len(kept)
        X = np.array([poses[i].GetAsMatrix34() for i in self._order]).reshape(k, 3, 4)
        centres = np.array([solid.centre for solid in solids]).reshape(k, 3)
        scales = np.array([solid.scale for solid in solids]).reshape(k, 3)
        self._centres = np.einsum("kij,kj->ki", X[:, :, :3], centres) + X[:, :, 3]
        # World to unit shape, without the shift by the centre.
        self._to_unit = (X[:, :, :3] / scales[:, None, :]).transpose(0, 2, 1).copy()
        counts = np.array([len(solid.faces) for solid in solids], np.intp)
        # What of a solid does not depend on where it is; see `SolidArrays`.
        self._shapes = (
            np.array([solid.radius for solid in solids], float) * (1 + _SLACK),
            np.array([solid.kind for solid in solids], np.intp),
            np.array([solid.dimensions for solid in solids], np.intp),
            np.array([solid.ratio for solid in solids], float),
            np.cumsum(counts) - counts,
            counts,
            np.concatenate([np.zeros((0, 4)), *(solid.faces for solid in solids)]),
        )

    def __len__(self) -> int:
        """Number of solids that can be hit."""
        return len(self._order)

    @property
    def arrays(self) -> SolidArrays:
        """The solids for compiled code."""
        return self._centres, self._to_unit, *self._shapes

    def carried(self, X: Array) -> Solids:
        """Returns the same solids, each carried along by a rigid motion of its own.

        Args:
            X: (n, 3, 4) rotation and translation, in the order of the constructor's lists.
        """
        return self._carried(X, self._order)

    def _carried(self, X: Array, motions: Index) -> Solids:
        """Returns the solids, each carried along by one of the motions."""
        carried = Solids.__new__(Solids)
        carried.__dict__ |= self.__dict__
        carried._centres = np.empty_like(self._centres)
        carried._to_unit = np.empty_like(self._to_unit)
        _carry(
            self._centres, self._to_unit, in_rows(X, 3, 4), motions,
            carried._centres, carried._to_unit,
        )  # fmt: skip
        return carried

    def first_hit(
        self, origins: Array, directions: Array, max_range: float | Array = np.inf
    ) -> Array:
        """Returns how far each ray gets until it enters a solid.

        A ray that starts inside a solid does not see that one.

        Args:
            origins: (n, 3) m, or (3,) for one origin of all rays.
            directions: (n, 3), of unit length.
            max_range: how far a ray reaches, m; a number or (n,).

        Returns:
            (n,) m; inf for a ray that hits nothing within its range.
        """
        return self.first_hits(origins, directions, max_range)[0]

    def first_hits(
        self, origins: Array, directions: Array, max_range: float | Array = np.inf
    ) -> tuple[Array, Index]:
        """Returns how far each ray gets, as `first_hit` does, and which solid it enters then.

        Returns:
            (n,) m, and (n,) the solid's number in the constructor's lists; -1 where the distance
            is inf.
        """
        n = len(directions)
        distances, entered = np.empty(n), np.empty(n, np.intp)
        reach = np.array(np.broadcast_to(max_range, n), float)
        cast(
            self.arrays, in_rows(np.asarray(origins), 3), in_rows(directions, 3), reach,
            distances, entered,
        )  # fmt: skip
        return distances, self.numbers(entered)

    def numbers(self, entered: Index) -> Index:
        """Returns the numbers in the constructor's lists of what `cast` has found (any shape)."""
        return self._numbers[entered]

    def occluded(
        self, origin: Array, targets: Array, tolerance: float | Array = 0.0
    ) -> NDArray[np.bool_]:
        """Tells which targets a solid hides from the origin.

        Args:
            origin: (3,) m.
            targets: (n, 3) m.
            tolerance: a solid this close before the target hides nothing, m; a number or (n,). It
                lets a target lie on the surface of the solid that carries it.

        Returns:
            (n,)
        """
        hidden = np.empty(len(targets), bool)
        allowed = np.array(tolerance, float)
        occlude(self.arrays, in_rows(origin, 3), in_rows(targets, 3), allowed.reshape(-1), hidden)
        return hidden


@compiled(f"void({SOLID_ARRAYS}, f8[:,::1], f8[:,::1], f8[::1], f8[::1], i8[::1])")
def cast(
    solids: SolidArrays,
    origins: Array,
    directions: Array,
    reach: Array,
    distances: Array,
    entered: Index,
) -> None:
    """Writes how far n rays get and which of k solids they enter then: inf and -1 for none.

    Args:
        solids: see `Solids.arrays`.
        origins: (n or 1, 3) m.
        directions: (n, 3).
        reach: (n,) m.
        distances: (n,) written, m.
        entered: (n,) written.
    """
    centres, to_unit, radii, kinds, dimensions, ratios, starts, counts, faces = solids
    c, o, d = np.empty(3), np.empty(3), np.empty(3)
    for r in range(len(directions)):
        start = 0 if len(origins) == 1 else r
        nearest, first = math.inf, -1
        for s in range(len(centres)):
            along, square = 0.0, 0.0  # how far along the ray its closest point to the centre lies
            for i in range(3):
                c[i] = centres[s, i] - origins[start, i]
                along += c[i] * directions[r, i]
                square += c[i] * c[i]
            radius = radii[s]
            if (
                along < -radius
                or along - radius > min(nearest, reach[r])
                or square - along * along > radius * radius
            ):
                continue
            for i in range(3):
                o[i], d[i] = 0.0, 0.0
                for j in range(3):
                    o[i] -= to_unit[s, i, j] * c[j]
                    d[i] += to_unit[s, i, j] * directions[r, j]
            if kinds[s] == ROUND_BOX:
                t = enter_round_box(o, d, dimensions[s])
            elif kinds[s] == CAPSULE:
                t = enter_capsule(o, d, ratios[s])
            else:
                t = enter_hull(o, d, faces[starts[s] : starts[s] + counts[s]])
            # Else it starts inside or beyond, or misses.
            if t >= 0 and t <= reach[r] and t < nearest:
                nearest, first = t, s
        distances[r], entered[r] = nearest, first


@compiled(f"void({SOLID_ARRAYS}, f8[:,::1], f8[:,::1], f8[::1], b1[::1])")
def occlude(
    solids: SolidArrays,
    origin: Array,
    targets: Array,
    tolerance: Array,
    hidden: NDArray[np.bool_],
) -> None:
    """Writes which targets solids hide from the origin, see `Solids.occluded`.

    Args:
        solids: see `Solids.arrays`.
        origin: (1, 3) m.
        targets: (n, 3) m.
        tolerance: (n or 1,) m.
        hidden: (n,) written.
    """
    n = len(targets)
    directions, reach = np.empty((n, 3)), np.empty(n)
    distances, entered = np.empty(n), np.empty(n, np.intp)
    for k in range(n):
        square = 0.0
        for i in range(3):
            directions[k, i] = targets[k, i] - origin[0, i]
            square += directions[k, i] * directions[k, i]
        distance = math.sqrt(square)
        for i in range(3):
            directions[k, i] /= max(distance, TINY)
        reach[k] = distance - tolerance[k if len(tolerance) > 1 else 0]
    cast(solids, origin, directions, reach, distances, entered)
    for k in range(n):
        hidden[k] = entered[k] >= 0


@compiled("void(f8[:,::1], f8[:,:,::1], f8[:,:,::1], i8[::1], f8[:,::1], f8[:,:,::1])")
def _carry(
    centres: Array,
    to_unit: Array,
    X: Array,
    motions: Index,
    carried_centres: Array,
    carried_to_unit: Array,
) -> None:
    """Writes where solids (see `SolidArrays`) are after one of the motions (..., 3, 4) each."""
    for s in range(len(centres)):
        m = motions[s]
        for i in range(3):
            place = X[m, i, 3]
            for j in range(3):
                place += X[m, i, j] * centres[s, j]
                turned = 0.0
                for k in range(3):
                    turned += to_unit[s, i, k] * X[m, j, k]
                carried_to_unit[s, i, j] = turned
            carried_centres[s, i] = place


class SceneSolids:
    """The solids of a SceneGraph in the frames that carry them, ready to be posed. Immutable.

    Made by `solids_from_inspector`.
    """

    def __init__(
        self, solids: Solids, frames: tuple[FrameId, ...], frame_of_solid: NDArray[np.intp]
    ) -> None:
        self._solids = solids
        self._frames = frames
        self._motions = frame_of_solid[solids._order]

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self

    def pose(self, query_object: QueryObject) -> Solids:
        """Returns the solids in the world, as they stand now."""
        if not self._frames:
            return self._solids
        return self._solids._carried(frame_poses(query_object, self._frames), self._motions)


def frame_poses(query_object: QueryObject, frames: Sequence[FrameId]) -> Array:
    """Returns the poses of the world, then of the frames, in it.

    Returns:
        (1 + n, 3, 4) rotations and translations (m).
    """
    poses = np.empty((1 + len(frames), 3, 4))
    poses[0] = _WORLD
    for k, frame in enumerate(frames):
        poses[k + 1] = query_object.GetPoseInWorld(frame).GetAsMatrix34()
    return poses


def solids_from_inspector(
    inspector: SceneGraphInspector,
    *,
    role: Role = Role.kPerception,
    exclude_frames: Collection[FrameId] = (),
) -> SceneSolids:
    """Returns the solids of a SceneGraph that have a role.

    Args:
        inspector: of the SceneGraph, or of a query object.
        role: `Role.kPerception` for what cameras see, `Role.kProximity` for what robots bump into.
        exclude_frames: frames whose geometry is left out, such as the robot's own.
    """
    world = inspector.world_frame_id()
    shapes, poses, frames, frame_of_solid = [], [], [], []
    for geometry in inspector.GetAllGeometryIds(role):
        frame = inspector.GetFrameId(geometry)
        if frame in exclude_frames:
            continue
        if frame != world and frame not in frames:
            frames.append(frame)
        shapes.append(inspector.GetShape(geometry))
        poses.append(inspector.GetPoseInFrame(geometry))
        frame_of_solid.append(0 if frame == world else 1 + frames.index(frame))
    return SceneSolids(Solids(shapes, poses), tuple(frames), np.array(frame_of_solid, np.intp))


class SolidsMemo:
    """The posed solids behind a block's query port, kept in the Context.

    The shapes are looked at once a Context, at the first call; geometry that is added to the
    Context later is not seen. (Drake's `GeometryVersion` cannot tell: without a renderer it does
    not count perception geometry.)

    Args:
        system: the block that owns the memo; call this in its constructor.
        role: see `solids_from_inspector`.
        exclude_frames: see `solids_from_inspector`.
    """

    def __init__(
        self, system: LeafSystem, *, role: Role, exclude_frames: Collection[FrameId] = ()
    ) -> None:
        self._role = role
        self._exclude_frames = frozenset(exclude_frames)
        no_calc: Any = ValueProducer.NoopCalc
        self._entry = system.DeclareCacheEntry(
            "solids of the scene",
            ValueProducer(allocate=lambda: AbstractValue.Make([]), calc=no_calc),
            {system.nothing_ticket()},
        )

    def __call__(self, context: Context, query_object: QueryObject) -> Solids:
        """Returns the solids in the world, as the query object sees them."""
        slot: Any = self._entry.get_mutable_cache_entry_value(context).GetMutableValueOrThrow()
        if not slot:
            slot.append(
                solids_from_inspector(
                    query_object.inspector(), role=self._role, exclude_frames=self._exclude_frames
                )
            )
        return slot[0].pose(query_object)
