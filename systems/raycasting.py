"""Ray casting against the solids of a scene, which Drake itself does not offer.

Every solid is convex, so a line runs inside it during one interval [enter, leave] of its length,
and a ray from outside hits where it enters. An affine map leaves the length along a ray as it is
and takes box, cylinder and ellipsoid (sphere) to unit shapes: the cube, cut by a ball in none, two
or three of its dimensions. So they are one case, with the slabs of Kay and Kajiya ("Ray tracing
complex scenes", SIGGRAPH 1986). Hulls are cut face by face (Cyrus and Beck, "Generalized two- and
three-dimensional clipping", 1978). A ray is tried only against the solids whose bounding sphere it
meets.

Touching a solid without entering it may count as a hit or as a miss: rounding decides.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    FrameId,
    HalfSpace,
    Mesh,
    QueryObject,
    Role,
    SceneGraphInspector,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem, ValueProducer

from systems.validation import require

Array = NDArray[np.float64]
Interval = tuple[Array, Array]

# Stands for a divisor of zero: the result is then so large that any other bound wins.
_TINY = 1e-200
# In which dimensions a ball cuts the unit cube.
_CUBE, _TUBE, _FULL = np.array([[0.0, 0, 0], [1, 1, 0], [1, 1, 1]])[:, :, None]
_ROUND_BOX, _CAPSULE, _HULL = range(3)
# A hull thinner than this part of its radius is a flat decal, which has no inside.
_FLAT = 1e-5


def _clip(enter: Array, leave: Array) -> Array:
    """Returns where intervals begin; NaN for an empty one."""
    return np.where(enter <= leave, enter, np.nan)


def _slabs(o: Array, d: Array) -> Interval:
    """Returns where the lines `o + t d` run in |x| <= 1, component by component.

    A line along the slab is in it from -inf to inf, or enters at inf.
    """
    a, b = (-1 - o) / d, (1 - o) / d
    return np.minimum(a, b), np.maximum(a, b)


def _ball(o: Array, d: Array, part: Array) -> Interval:
    """Returns where the lines run in the unit ball, in those dimensions whose `part` is 1, not 0.

    NaN for a miss. The distance is taken at the closest point, which keeps its digits when the
    line starts far away.
    """
    d_part = part * d
    square = np.maximum((d_part * d).sum(axis=0), _TINY)
    middle = (d_part * o).sum(axis=0) / -square
    closest = o + middle * d
    half = np.sqrt((1 - (part * closest * closest).sum(axis=0)) / square)
    return middle - half, middle + half


def _enter_round_box(o: Array, d: Array, part: Array) -> Array:
    """Returns where the lines enter the unit cube cut by a ball; NaN for a miss."""
    near, far = _slabs(o, d)
    enter, leave = _ball(o, d, part)
    return _clip(np.maximum(enter, near.max(axis=0)), np.minimum(leave, far.min(axis=0)))


def _enter_capsule(o: Array, d: Array, ratio: Array) -> Array:
    """Returns where the lines enter a capsule of unit radius; NaN for a miss.

    `ratio` is half the length of the straight part.
    """
    tube, _ = _ball(o, d, _TUBE)
    # What enters the endless tube beyond the straight part can only come in through that cap.
    height = o[2] + tube * d[2]
    from_cap = o.copy()
    from_cap[2] -= np.copysign(ratio, height)
    cap, _ = _ball(from_cap, d, _FULL)
    return np.where(np.abs(height) <= ratio, tube, cap)


def _enter_hull(o: Array, d: Array, faces: Array, counts: NDArray[np.intp]) -> Array:
    """Returns where the lines enter a hull; NaN for a miss.

    Args:
        o: (3, n) m, from the hull's centre.
        d: (3, n).
        faces: (4, sum of counts) those of all hulls in one row: normal, distance from the centre.
        counts: (n,) how many belong to each line's hull.
    """
    line = np.repeat(np.arange(len(counts)), counts)
    height = faces[3] - np.einsum("in,in->n", faces[:3], o.take(line, axis=1))
    rise = np.einsum("in,in->n", faces[:3], d.take(line, axis=1))
    rise = np.where(np.abs(rise) < _TINY, _TINY, rise)
    t = height / rise
    starts = np.cumsum(counts) - counts
    enter = np.maximum.reduceat(np.where(rise < 0, t, -np.inf), starts)
    leave = np.minimum.reduceat(np.where(rise > 0, t, np.inf), starts)
    return _clip(enter, leave)


@dataclass(frozen=True)
class _Solid:
    """What the intersection needs to know of one shape.

    Attributes:
        kind: which function intersects it.
        scale: (3,) half sizes, m; the map to the unit shape divides by them.
        radius: of the bounding sphere around `centre`, m.
        centre: (3,) m, in the shape's frame; also the origin of `faces`.
        part: (3, 1) of a round box, see `_ball`.
        ratio: of a capsule, see `_enter_capsule`.
        faces: (f, 4) of a hull: outward unit normal and distance from the centre, m.
    """

    kind: int
    scale: Array
    radius: float
    centre: Array = field(default_factory=lambda: np.zeros(3))
    part: Array = field(default_factory=lambda: _CUBE)
    ratio: float = 1.0
    faces: Array = field(default_factory=lambda: np.zeros((0, 4)))


def _describe(shape: Shape) -> _Solid | None:
    """Returns the solid of a shape; None for one without an inside."""
    if isinstance(shape, Box):
        half = np.asarray(shape.size()) / 2
        return _Solid(_ROUND_BOX, half, float(np.linalg.norm(half)))
    if isinstance(shape, Cylinder):
        radius, half_length = shape.radius(), shape.length() / 2
        scale = np.array([radius, radius, half_length])
        return _Solid(_ROUND_BOX, scale, float(np.hypot(radius, half_length)), part=_TUBE)
    if isinstance(shape, Ellipsoid):
        axes = np.array([shape.a(), shape.b(), shape.c()])
        return _Solid(_ROUND_BOX, axes, float(axes.max()), part=_FULL)
    if isinstance(shape, Sphere):
        radius = shape.radius()
        return _Solid(_ROUND_BOX, np.full(3, radius), radius, part=_FULL) if radius > 0 else None
    if isinstance(shape, Capsule):
        radius, half_length = shape.radius(), shape.length() / 2
        scale = np.full(3, radius)
        return _Solid(_CAPSULE, scale, radius + half_length, ratio=half_length / radius)
    if isinstance(shape, HalfSpace):
        return _Solid(_HULL, np.ones(3), np.inf, faces=np.array([[0.0, 0.0, 1.0, 0.0]]))
    if isinstance(shape, Convex | Mesh):
        return _describe_hull(shape)
    raise ValueError(
        f"shape is {shape!r}: must be Box, Sphere, Ellipsoid, Cylinder, Capsule, HalfSpace, "
        "Convex or Mesh"
    )


def _describe_hull(shape: Convex | Mesh) -> _Solid | None:
    mesh = shape.GetConvexHull()
    vertices = np.array([mesh.vertex(i) for i in range(mesh.num_vertices())])
    normals = np.array([mesh.face_normal(i) for i in range(mesh.num_faces())])
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    radius = float(np.linalg.norm(vertices - centre, axis=1).max())
    heights = (vertices - centre) @ normals.T
    if np.ptp(heights, axis=0).min() <= _FLAT * radius:
        return None
    faces = np.column_stack([normals, heights.max(axis=0)])
    return _Solid(_HULL, np.ones(3), radius, centre, faces=faces)


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
        described = [(i, _describe(shape)) for i, shape in enumerate(shapes)]
        kept = sorted(((i, s) for i, s in described if s is not None), key=lambda e: e[1].kind)
        solids = [solid for _, solid in kept]
        self._order = np.array([i for i, _ in kept], int)
        k = len(kept)
        X = np.array([poses[i].GetAsMatrix34() for i in self._order]).reshape(k, 3, 4)
        centres = np.array([solid.centre for solid in solids]).reshape(k, 3)
        scales = np.array([solid.scale for solid in solids]).reshape(k, 3)
        self._centres = np.einsum("kij,kj->ki", X[:, :, :3], centres) + X[:, :, 3]
        # World to unit shape, without the shift by the centre: (3, 3, k), as gathering is fastest.
        self._to_unit = np.ascontiguousarray((X[:, :, :3] / scales[:, None, :]).transpose(2, 1, 0))
        # Rounding must not turn away a ray that only just meets the bounding sphere.
        self._radii = np.array([solid.radius for solid in solids]) * (1 + 1e-9)
        self._parts = np.array([solid.part[:, 0] for solid in solids]).reshape(k, 3).T.copy()
        self._ratios = np.array([solid.ratio for solid in solids])
        kinds = np.array([solid.kind for solid in solids], int)
        self._kinds = np.searchsorted(kinds, range(_HULL + 1))
        hulls = solids[self._kinds[_HULL] :]
        self._faces = np.concatenate([np.zeros((0, 4)), *(hull.faces for hull in hulls)]).T.copy()
        self._face_counts = np.array([len(hull.faces) for hull in hulls], int)
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
        distances = np.full(len(directions), np.inf)
        solid, ray, o, d = self._candidates(np.atleast_2d(origins), directions, max_range)
        if len(solid) == 0:
            return distances
        _, capsules, hulls = np.searchsorted(solid, self._kinds)
        parts: list[Array] = []
        with np.errstate(divide="ignore", invalid="ignore"):  # inf and NaN mean something here
            if capsules > 0:
                part = self._parts.take(solid[:capsules], axis=1)
                parts.append(_enter_round_box(o[:, :capsules], d[:, :capsules], part))
            if hulls > capsules:
                one = slice(capsules, hulls)
                parts.append(_enter_capsule(o[:, one], d[:, one], self._ratios[solid[one]]))
            if len(solid) > hulls:
                hull = solid[hulls:] - self._kinds[_HULL]
                faces, counts = self._faces_of(hull)
                parts.append(_enter_hull(o[:, hulls:], d[:, hulls:], faces, counts))
        enter = np.concatenate(parts)
        hit = enter >= 0  # else it starts inside or beyond, or misses
        np.minimum.at(distances, ray[hit], enter[hit])
        distances[distances > max_range] = np.inf
        return distances

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
        directions = rays / np.maximum(distances, _TINY)[:, None]
        return np.isfinite(self.first_hit(origin, directions, distances - tolerance))

    def _candidates(
        self, origins: Array, directions: Array, max_range: float | Array
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, Array]:
        """Pairs solids and rays that meet the solid's bounding sphere.

        Returns:
            Index of the solid (ascending) and of the ray, and the ray's origin and direction in
            the frame of the unit shape, (3, pairs) each.
        """
        nothing = np.zeros(0, np.intp)
        if len(self) == 0 or len(directions) == 0:
            return nothing, nothing, np.zeros((3, 0)), np.zeros((3, 0))
        # About the first origin, which keeps the digits of rays far from the world's origin.
        base = origins[0]
        o = origins - base
        c = self._centres - base
        r = self._radii[:, None]
        along = c @ directions.T  # how far along the ray its closest point to the centre lies
        square = (c * c).sum(axis=1, keepdims=True)
        spread = 0.0
        if len(o) > 1:
            along -= (o * directions).sum(axis=1)
            norms = (o * o).sum(axis=1)
            square = square - 2 * c @ o.T + norms
            spread = float(np.sqrt(norms.max()))
        near = along > -r
        along *= along
        near &= along >= square - r * r
        reach = np.max(max_range) + spread
        if math.isfinite(reach):
            near &= np.sqrt((c * c).sum(axis=1, keepdims=True)) - r <= reach
        # Divided by hand: nonzero of two dimensions takes nine times as long.
        solid, ray = np.divmod(np.flatnonzero(near), near.shape[1])
        to_unit = self._to_unit.take(solid, axis=2)
        o_unit = -np.einsum("ijk,kj->ik", self._to_unit, c).take(solid, axis=1)
        if len(o) > 1:
            o_unit += np.einsum("ijn,jn->in", to_unit, o.T.take(ray, axis=1))
        d_unit = np.einsum("ijn,jn->in", to_unit, directions.T.take(ray, axis=1))
        return solid, ray, o_unit, d_unit

    def _faces_of(self, hull: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp]]:
        """Returns the faces of those hulls in one row, (4, ...), and how many each has."""
        counts = self._face_counts[hull]
        skip = self._face_starts[hull] - (np.cumsum(counts) - counts)
        row = np.arange(counts.sum()) + np.repeat(skip, counts)
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
