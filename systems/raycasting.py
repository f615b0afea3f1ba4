"""Ray casting against the solids of a scene, which Drake itself does not offer.

A ray is tried only against the solids that it may meet. For a few rays and solids those are the
ones whose bounding sphere it meets. Many rays from one place (or nearly) are sorted by their
azimuth about the vertical: from there a solid is seen within an interval of azimuths, that of the
corners of its bounding box. So the turn of a lidar, 360 rays among 100 solids, costs a thousand
trials, not 36,000. What a trial does is in `systems.solid_shapes`.

Touching a solid without entering it may count as a hit or as a miss: rounding decides.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import FrameId, QueryObject, Role, SceneGraphInspector, Shape
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem, ValueProducer

from systems.solid_shapes import (
    CAPSULE,
    HULL,
    ROUND_BOX,
    TINY,
    describe,
    enter_box,
    enter_capsule,
    enter_hull,
    enter_round_box,
)
from systems.validation import require

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# The corners of the unit cube.
_CORNERS = np.array(np.meshgrid([-1.0, 1], [-1.0, 1], [-1.0, 1])).reshape(3, 8).T
# So many pairs of solids and rays are sooner tried each than sorted.
_FEW = 12_000
# Pairs that are tried at once: larger arrays go back to the system each time, and fetching them
# anew takes a quarter longer.
_BLOCK = 2000
# Rounding must not turn away a ray that only just meets what holds a solid: part, and rad.
_SLACK = 1e-9


def _runs(starts: Index, counts: Index) -> tuple[Index, Index]:
    """Returns the runs [start, start + count) in one row: which run, and the number in it."""
    run = np.repeat(np.arange(len(counts)), counts)
    shift = starts - (np.cumsum(counts) - counts)
    return run, np.arange(len(run)) + shift[run]


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
        kept = sorted(((i, s) for i, s in described if s is not None), key=lambda e: e[1].kind)
        solids = [solid for _, solid in kept]
        self._order = np.array([i for i, _ in kept], np.intp)
        k = len(kept)
        X = np.array([poses[i].GetAsMatrix34() for i in self._order]).reshape(k, 3, 4)
        centres = np.array([solid.centre for solid in solids]).reshape(k, 3)
        self._scales = np.array([solid.scale for solid in solids]).reshape(k, 3)
        self._extents = np.array([solid.extent for solid in solids]).reshape(k, 3)
        self._extents *= 1 + _SLACK
        self._radii = np.array([solid.radius for solid in solids]) * (1 + _SLACK)
        self._centres = np.einsum("kij,kj->ki", X[:, :, :3], centres) + X[:, :, 3]
        # World to unit shape, without the shift by the centre: (3, 3, k), as gathering is fastest.
        self._to_unit = np.ascontiguousarray(
            (X[:, :, :3] / self._scales[:, None, :]).transpose(2, 1, 0)
        )
        self._parts = np.array([solid.part[:, 0] for solid in solids]).reshape(k, 3).T.copy()
        self._ratios = np.array([solid.ratio for solid in solids])
        kinds = np.array([solid.kind for solid in solids], int)
        self._kinds = np.searchsorted(kinds, (ROUND_BOX, CAPSULE, HULL))
        hulls = solids[self._kinds[-1] :]
        self._faces = np.concatenate([np.zeros((0, 4)), *(hull.faces for hull in hulls)]).T.copy()
        self._face_counts = np.array([len(hull.faces) for hull in hulls], np.intp)
        self._face_starts = np.cumsum(self._face_counts) - self._face_counts

    def __len__(self) -> int:
        """Number of solids that can be hit."""
        return len(self._radii)

    def carried(self, X: Array) -> Solids:
        """Returns the same solids, each carried along by a rigid motion of its own.

        Args:
            X: (n, 3, 4) rotation and translation, in the order of the constructor's lists.
        """
        X = X[self._order]
        R = X[:, :, :3]
        carried = copy.copy(self)
        carried._centres = (R @ self._centres[:, :, None])[:, :, 0] + X[:, :, 3]
        to_unit = self._to_unit.transpose(2, 0, 1) @ R.transpose(0, 2, 1)
        carried._to_unit = np.ascontiguousarray(to_unit.transpose(1, 2, 0))
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
        distances = np.full(len(directions), np.inf)
        entered = np.full(len(directions), -1, np.intp)
        if len(self) == 0 or len(directions) == 0:
            return distances, entered
        # About the first origin, which keeps the digits of rays far from the world's origin.
        origins = np.atleast_2d(origins)
        base = origins[0]
        offsets = origins - base if len(origins) > 1 else None
        c = self._centres - base
        few = len(self) * len(directions) <= _FEW
        candidates = self._meet_spheres if few else self._see_azimuths
        solid, ray = candidates(c, offsets, directions, float(np.max(max_range)))
        blocks = [slice(i, i + _BLOCK) for i in range(0, len(solid), _BLOCK)] or [slice(0)]
        enter = np.concatenate(
            [self._enter(c, offsets, directions, solid[block], ray[block]) for block in blocks]
        )
        hit = np.flatnonzero(enter >= 0)  # else it starts inside or beyond, or misses
        solid, ray, enter = solid[hit], ray[hit], enter[hit]
        np.minimum.at(distances, ray, enter)
        distances[distances > max_range] = np.inf
        first = np.flatnonzero(enter == distances[ray])
        entered[ray[first]] = self._order[solid[first]]
        return distances, entered

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
        rays = targets - origin
        distances = np.sqrt((rays * rays).sum(axis=1))
        directions = rays / np.maximum(distances, TINY)[:, None]
        return np.isfinite(self.first_hit(origin, directions, distances - tolerance))

    def _meet_spheres(
        self, c: Array, offsets: Array | None, directions: Array, reach: float
    ) -> tuple[Index, Index]:
        """Pairs each ray with the solids whose bounding sphere it meets; see `_see_azimuths`."""
        r = self._radii[:, None]
        along = c @ directions.T  # how far along the ray its closest point to the centre lies
        square = (c * c).sum(axis=1, keepdims=True)
        near = np.sqrt(square) - r <= reach
        if offsets is not None:
            along -= (offsets * directions).sum(axis=1)
            norms = (offsets * offsets).sum(axis=1)
            near = np.sqrt(square) - r <= reach + np.sqrt(norms.max())
            square = square - 2 * c @ offsets.T + norms
        near = near & (along > -r)
        along *= along
        near &= along >= square - r * r
        # Divided by hand: nonzero of two dimensions takes nine times as long.
        solid, ray = np.divmod(np.flatnonzero(near), near.shape[1])
        return solid, ray

    def _see_azimuths(
        self, c: Array, offsets: Array | None, directions: Array, reach: float
    ) -> tuple[Index, Index]:
        """Pairs solids with the rays whose azimuth and height they may be met at.

        Args:
            c: (k, 3) centres of the solids from the place that the rays are sorted about, m.
            offsets: (n, 3) where the rays start, from there, m; None for all there.
            directions: (n, 3).
            reach: how far the rays go, m.

        Returns:
            Index of the solid (ascending) and of the ray.
        """
        n = len(directions)
        # A ray that starts beside the place sees a solid where the place sees a larger one.
        spread = 0.0 if offsets is None else float(np.sqrt((offsets**2).sum(axis=1).max()))
        half = self._extents + spread
        along, across, up = c.T
        with np.errstate(invalid="ignore"):  # NaN, of an endless solid: every ray may meet it
            axes = self._to_unit * (self._scales * half).T[:, None, :]  # (axis, world, k)
            x, y = (_CORNERS @ axes[:, w] + c[:, w] for w in (0, 1))
            # Azimuths of the corners from that of the centre. A solid in whose outline the place
            # does not lie spans less than half a turn.
            turn = np.arctan2(along * y - across * x, along * x + across * y)
            first = turn.min(axis=0)
            width = turn.max(axis=0) - first
            beside = (width < np.pi) & (along * along + across * across > 0)
            height = np.abs(axes[:, 2]).sum(axis=0)
            distance = np.sqrt((c * c).sum(axis=1))
            far = np.minimum(distance + self._radii + spread, reach)
            missed = distance - self._radii > reach + spread
            missed |= up - height > far * max(directions[:, 2].max(), 0.0)
            missed |= up + height < far * min(directions[:, 2].min(), 0.0)
        azimuths = np.arctan2(directions[:, 1], directions[:, 0])
        order = np.argsort(azimuths, kind="stable")
        azimuths = azimuths[order]
        twice = np.concatenate([azimuths, azimuths + 2 * np.pi])
        start = np.where(beside, np.arctan2(across, along) + first, 0.0) - _SLACK
        start -= 2 * np.pi * np.floor((start + np.pi) / (2 * np.pi))
        begin = np.where(beside, twice.searchsorted(start), 0)
        end = np.where(beside, twice.searchsorted(start + width + 2 * _SLACK), n)
        solid, place = _runs(begin, np.where(missed, 0, end - begin))
        return solid, np.concatenate([order, order])[place]

    def _enter(
        self, c: Array, offsets: Array | None, directions: Array, solid: Index, ray: Index
    ) -> Array:
        """Returns where each pair's ray enters the pair's solid; NaN for a miss.

        The solids are in ascending order; for the other arguments see `_see_azimuths`.
        """
        to_unit = self._to_unit.take(solid, axis=2)
        o = -np.einsum("ijk,kj->ik", self._to_unit, c).take(solid, axis=1)
        if offsets is not None:
            o += np.einsum("ijn,jn->in", to_unit, offsets.T.take(ray, axis=1))
        d = np.einsum("ijn,jn->in", to_unit, directions.T.take(ray, axis=1))
        rounds, capsules, hulls = np.searchsorted(solid, self._kinds)
        parts: list[Array] = []
        with np.errstate(divide="ignore", invalid="ignore"):  # inf and NaN mean something here
            if rounds > 0:
                parts.append(enter_box(o[:, :rounds], d[:, :rounds]))
            if capsules > rounds:
                one = slice(rounds, capsules)
                part = self._parts.take(solid[one], axis=1)
                parts.append(enter_round_box(o[:, one], d[:, one], part))
            if hulls > capsules:
                one = slice(capsules, hulls)
                parts.append(enter_capsule(o[:, one], d[:, one], self._ratios[solid[one]]))
            if len(solid) > hulls:
                faces, counts = self._faces_of(solid[hulls:] - self._kinds[-1])
                parts.append(enter_hull(o[:, hulls:], d[:, hulls:], faces, counts))
        return np.concatenate(parts) if parts else np.zeros(0)

    def _faces_of(self, hull: Index) -> tuple[Array, Index]:
        """Returns the faces of those hulls in one row, (4, ...), and how many each has."""
        counts = self._face_counts[hull]
        _, row = _runs(self._face_starts[hull], counts)
        return self._faces.take(row, axis=1), counts


class SceneSolids:
    """The solids of a SceneGraph in the frames that carry them, ready to be posed. Immutable.

    Made by `solids_from_inspector`.
    """

    def __init__(
        self, solids: Solids, frames: tuple[FrameId, ...], frame_of_solid: NDArray[np.intp]
    ) -> None:
        self._solids = solids
        self._frames = frames
        self._frame_of_solid = frame_of_solid

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self

    def pose(self, query_object: QueryObject) -> Solids:
        """Returns the solids in the world, as they stand now."""
        if not self._frames:
            return self._solids
        X_WF = frame_poses(query_object, self._frames)
        anchored = np.eye(3, 4)[None]
        return self._solids.carried(np.concatenate([anchored, X_WF])[self._frame_of_solid])


def frame_poses(query_object: QueryObject, frames: Sequence[FrameId]) -> Array:
    """Returns the poses X_WF of the frames: (n, 3, 4), rotation and translation (m)."""
    poses = [query_object.GetPoseInWorld(frame).GetAsMatrix34() for frame in frames]
    return np.array(poses).reshape(-1, 3, 4)


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
