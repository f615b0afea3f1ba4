"""Circuits with tags beside them: a closed route, and tags as a good installer puts them up.

Tags stand beside the route and look against the direction of travel, turned toward the route by so
much that they are not seen from the front, where a square's two poses are one. What the installer
looks for is held to here: all along the route a camera on the robot has at least `in_view` tags
that are large enough, not too tilted and not hidden, also when the robot is a little beside the
route or askew; and every tag is in view for half a metre at least. Where a place lacks tags one
ahead of it is put up elsewhere, and a circuit that
still has such a place is drawn again; the seed says which random numbers come next, so one seed
always ends with the same circuit. Tags are numbered in the order in which they come; tag 0 is in
view at the start. Lengths are whole millimetres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Box
from pydrake.math import RigidTransform, RollPitchYaw

from plants.boards import PLATE_THICKNESS
from plants.circuit_parameters import CircuitParameters
from systems.markers.family import family
from systems.markers.layout import Marker, MarkerMap
from systems.markers.visibility import visible_markers
from systems.noise import generator, stream_key
from systems.planners.closed_curve import ClosedCurve
from systems.raycasting import Solids

Array = NDArray[np.float64]

_DRAWS = 60  # circuits, until the parameters are given up
_MOVES = 40  # of tags that leave as many places lacking, until a circuit is given up
_TRIES = 30  # places for a tag, until the circuit is given up
_LOOK = 0.05  # m between two places at which tags in view are counted
_HIDDEN = 1000  # how much more is lacking while it is for other reasons than what boards hide
_SEEN = 0.5  # m of the route, along which a tag is in view at least
_IN_FRONT = 1e-3  # m before a tag; what is nearer to it is its own board
_AHEAD = (0.5, 3.5)  # m before a tag from which it may be seen
_HARMONICS = (2, 3, 4)  # by which a route differs from a circle
_POINTS = 16  # of a route


@dataclass(frozen=True, eq=False)
class Circuit:
    """A circuit that was drawn.

    Attributes:
        points: (n, 2) m, through which the route goes (`ClosedCurve`), from the start on.
        markers: the tags.
    """

    points: Array
    markers: MarkerMap

    def route(self) -> ClosedCurve:
        """Returns the route."""
        return ClosedCurve(self.points)

    def start(self) -> Array:
        """Returns (3,) the pose [x (m), y (m), theta (rad)] at the start."""
        position, heading = self.route().at(0.0)
        return np.array([*position, math.remainder(float(heading), 2 * math.pi)])


def circuit(seed: int, parameters: CircuitParameters | None = None) -> Circuit:
    """Draws a circuit that has `in_view` tags in view all along its route.

    Args:
        seed: any integer.
        parameters: what kind of circuit.

    Raises:
        ValueError: there is no such circuit among many.
    """
    p = parameters or CircuitParameters()
    key = stream_key(seed, "circuit")
    for draw in range(_DRAWS):
        random = generator(key, draw)
        points = _draw_points(random, p)
        route = ClosedCurve(points)
        if np.abs(route.curvatures).max() > 1 / p.min_radius:
            continue
        markers = _put_up(random, route, p)
        if markers is None:
            continue
        from_start = seen_along(route, markers, p)[0].all(axis=0)
        numbered = _numbered(route, markers, from_start)
        if numbered is not None:
            return Circuit(points, numbered)
    raise ValueError(
        f"circuit: none of {_DRAWS} of {p.length:g} m with {p.tags} tags has {p.in_view} in view "
        "everywhere: ask for less"
    )


def tag_poses(
    positions: ArrayLike,
    headings: ArrayLike,
    *,
    across: ArrayLike,
    heights: ArrayLike,
    turns: ArrayLike,
) -> tuple[Array, Array]:
    """Returns the poses of upright tags beside a route: (n, 3, 3) `R_WT` and (n, 3) `p_WT`, m.

    Args:
        positions: (n, 2) of the route, m.
        headings: (n,) of the route there, rad.
        across: (n,) how far to the right of it, m; negative to the left.
        heights: (n,) m.
        turns: (n,) by how much each is turned toward the route from looking straight against the
            direction of travel, rad.
    """
    p, theta, a, z, turn = (
        np.asarray(v, float) for v in (positions, headings, across, heights, turns)
    )
    ahead = np.stack([np.cos(theta), np.sin(theta)], axis=1)
    right = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1)
    toward = -np.sign(a)[:, None] * right  # the route
    normal = -ahead * np.cos(turn)[:, None] + toward * np.sin(turn)[:, None]
    zero, one = np.zeros(len(p)), np.ones(len(p))
    x_axis = np.column_stack([normal, zero])
    z_axis = np.column_stack([zero, zero, one])
    R_WT = np.stack([x_axis, np.cross(z_axis, x_axis), z_axis], axis=2)
    return R_WT, np.column_stack([p + a[:, None] * right, z])


def in_view(route: ClosedCurve, markers: MarkerMap, parameters: CircuitParameters) -> Array:
    """Returns (n,) the least number of tags in view at places along a route, some cm apart.

    It is the least of the robot on the route, and beside it and askew as far as it may be.
    """
    return seen_along(route, markers, parameters).sum(axis=2).min(axis=1)


def seen_along(
    route: ClosedCurve, markers: MarkerMap, parameters: CircuitParameters
) -> NDArray[np.bool_]:
    """Returns (n, 5, tags) which tags are in view, in the order of the map.

    At n places along the route the robot is on it, left and right of it, and turned either way.
    """
    return _seen(_views(route, parameters, _LOOK), markers, parameters, hiding=True)


@dataclass(frozen=True, eq=False)
class _Views:
    """Cameras at places along a route: `R_CW` (n, 5, 3, 3) and `p_WC` (n, 5, 3) m."""

    R_CW: Array
    p_WC: Array


def _views(route: ClosedCurve, p: CircuitParameters, step: float) -> _Views:
    """Returns the cameras of robots on the route, left and right of it, and turned either way."""
    count = math.ceil(route.length / step)
    places, headings = route.at(np.linspace(0.0, route.length, count, endpoint=False))
    askew = math.radians(p.askew_deg)
    asides = np.array([0.0, p.sway, -p.sway, 0.0, 0.0])
    theta = headings[:, None] + [0.0, 0.0, 0.0, askew, -askew]
    left = np.stack([-np.sin(headings), np.cos(headings)], axis=1)
    p_WB = np.zeros((*theta.shape, 3))
    p_WB[..., :2] = places[:, None] + asides[:, None] * left[:, None]
    R_WB = np.zeros((*theta.shape, 3, 3))
    R_WB[..., 0, 0] = R_WB[..., 1, 1] = np.cos(theta)
    R_WB[..., 1, 0], R_WB[..., 0, 1] = np.sin(theta), -np.sin(theta)
    R_WB[..., 2, 2] = 1.0
    X_BC = p.camera.mounting()
    R_WC = R_WB @ X_BC.rotation().matrix()
    return _Views(R_WC.swapaxes(-1, -2), p_WB + R_WB @ X_BC.translation())


def _seen(
    views: _Views, markers: MarkerMap, p: CircuitParameters, *, hiding: bool
) -> NDArray[np.bool_]:
    """Returns (n, 5, tags) which tags are in view, all at once; boards may hide others."""
    shape = views.p_WC.shape[:2]
    R_CW, p_WC = views.R_CW.reshape(-1, 1, 3, 3), views.p_WC.reshape(-1, 3)
    X_WM, sizes = _arrays(markers)
    X_CM = np.empty((len(p_WC), len(sizes), 3, 4))
    X_CM[..., :3] = R_CW @ X_WM[:, :, :3]
    X_CM[..., 3] = (R_CW @ (X_WM[:, :, 3] - p_WC[:, None])[..., None])[..., 0]
    found = visible_markers(
        camera=p.camera.model(),
        X_WC=RigidTransform(),  # the world is each camera's own frame
        X_WM=X_CM.reshape(-1, 3, 4),
        sizes=np.tile(sizes, len(p_WC)),
        cells=markers.family.cells,
        parameters=p.camera.limits(),
    )
    view, tag = np.divmod(found.index, len(sizes))
    if hiding:
        points = np.array([[*m.corners(), m.X_WM.translation()] for m in markers])  # (tags, 5, 3)
        rays = points[tag] - p_WC[view][:, None]
        lengths = np.linalg.norm(rays, axis=2)
        hits = _boards(markers).first_hit(
            np.repeat(p_WC[view], 5, axis=0),
            (rays / lengths[..., None]).reshape(-1, 3),
            lengths.ravel() - _IN_FRONT,
        )
        free = ~np.isfinite(hits).reshape(-1, 5).any(axis=1)
        view, tag = view[free], tag[free]
    seen = np.zeros((len(p_WC), len(sizes)), bool)
    seen[view, tag] = True
    return seen.reshape(*shape, len(sizes))


def _arrays(markers: MarkerMap) -> tuple[Array, Array]:
    """Returns (n, 3, 4) poses and (n,) sizes (m), in the order of the map."""
    poses = np.array([tag.X_WM.GetAsMatrix34() for tag in markers]).reshape(-1, 3, 4)
    return poses, np.array([tag.size for tag in markers])


def _boards(markers: MarkerMap) -> Solids:
    """Returns the boards, which hide what is behind them."""
    cells = markers.family.cells
    behind = RigidTransform([-PLATE_THICKNESS, 0.0, 0.0])  # not in the printed face itself
    sides = [tag.size * (cells + 2) / cells for tag in markers]
    return Solids(
        [Box(PLATE_THICKNESS, side, side) for side in sides],
        [tag.X_WM @ behind for tag in markers],
    )


def _draw_points(random: np.random.Generator, p: CircuitParameters) -> Array:
    """Draws the points of a closed way about the origin, scaled to its length."""
    angles = np.linspace(0, 2 * math.pi, _POINTS, endpoint=False)
    radii = np.ones(_POINTS)
    for m in _HARMONICS:
        size = p.waviness * random.uniform(0.3, 1.0) / (m - 1) ** 1.5
        radii += size * np.cos(m * angles + random.uniform(0, 2 * math.pi))
    if random.random() < 0.5:
        angles = -angles  # clockwise
    points = radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.asarray((points * (p.length / ClosedCurve(points).length)).round(3))


def _put_up(
    random: np.random.Generator, route: ClosedCurve, p: CircuitParameters
) -> MarkerMap | None:
    """Draws tags, and moves some until there are enough in view; None when that does not help."""
    tags: list[Marker] = []
    for k in range(p.tags):
        tag = _draw_tag(random, route, p, k, tags)
        if tag is None:
            return None
        tags.append(tag)
    coarse, fine = _views(route, p, 2 * _LOOK), _views(route, p, _LOOK)

    def lacks(tags: list[Marker]) -> tuple[int, list[int], list[float]]:
        """How much is lacking, which tags are seen too little, and the ways (m) of poor places."""
        # Where some are hidden matters, and costs time, only when all else is well.
        for views, step, hiding in ((coarse, 2 * _LOOK, False), (fine, _LOOK, True)):
            seen = _seen(views, _map(tags, p), p, hiding=hiding)
            places = np.maximum(p.in_view - seen.sum(axis=2).min(axis=1), 0)
            useless = np.flatnonzero(_seen_for(seen, step) < _SEEN).tolist()
            if lacking := int(places.sum() * step / _LOOK) + len(useless):
                break
        more = 0 if hiding or not lacking else _HIDDEN
        return lacking + more, useless, (np.flatnonzero(places) * step).tolist()

    (lacking, useless, ways), tries = lacks(tags), 0
    while lacking and tries < _MOVES:
        tries += 1
        if useless:
            k = tags[random.choice(useless)].id
        else:
            ahead = random.uniform(_AHEAD[0], _AHEAD[1])
            k = round((random.choice(ways) + ahead) / route.length * p.tags) % p.tags
        moved = _draw_tag(random, route, p, k, [tag for tag in tags if tag.id != k])
        if moved is None:
            continue
        changed = [moved if tag.id == k else tag for tag in tags]
        now = lacks(changed)
        if now[0] < lacking:
            tries = 0
        if now[0] <= lacking:
            tags, (lacking, useless, ways) = changed, now
    return _map(tags, p) if lacking == 0 else None


def _seen_for(seen: NDArray[np.bool_], step: float) -> Array:
    """Returns (tags,) along how much of the route each is in view however the robot sways, m."""
    return np.asarray(seen.all(axis=1).sum(axis=0) * step, np.float64)


def _map(tags: list[Marker], p: CircuitParameters) -> MarkerMap:
    return MarkerMap(family(p.family), p.size, {tag.id: tag for tag in tags})


def _draw_tag(
    random: np.random.Generator,
    route: ClosedCurve,
    p: CircuitParameters,
    k: int,
    others: list[Marker],
) -> Marker | None:
    """Draws the k-th tag, clear of the route and of other tags; None when there is no place."""
    outside = np.sign(_area(route.positions))  # 1: the right side is outside
    half = p.board() / 2
    for _ in range(_TRIES):
        side = outside * (-1 if random.random() < p.inside_share else 1)
        position, heading = route.at([(k + random.uniform(-0.4, 0.4)) * route.length / p.tags])
        turn = p.turn_deg + random.uniform(-1, 1) * p.turn_spread_deg
        R, place = tag_poses(
            position,
            heading,
            across=[side * random.uniform(p.offset[0], p.offset[1])],
            heights=[random.uniform(p.height[0], p.height[1])],
            turns=[math.radians(turn)],
        )
        facing = round(math.degrees(math.atan2(R[0, 1, 0], R[0, 0, 0])), 1)
        X = RigidTransform(RollPitchYaw(0.0, 0.0, math.radians(facing)), place[0].round(3))
        middle = X.translation()[:2]
        ends = middle + half * np.outer([-1, 1], X.rotation().matrix()[:2, 1])
        gaps = np.array([np.hypot(*(o.X_WM.translation()[:2] - middle)) for o in others])
        if route.distances(ends).min() >= p.clearance and (gaps > 3 * half).all():
            return Marker(k, X, p.size)
    return None


def _area(polygon: Array) -> float:
    x, y = polygon.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def _numbered(
    route: ClosedCurve, markers: MarkerMap, from_start: NDArray[np.bool_]
) -> MarkerMap | None:
    """Returns the tags numbered as they come, the nearest of those `from_start` first."""
    if not from_start.any():
        return None
    tags = list(markers)
    away = [np.hypot(*(tag.X_WM.translation()[:2] - route.positions[0])) for tag in tags]
    first = int(np.argmin(np.where(from_start, away, np.inf)))
    ordered = tags[first:] + tags[:first]
    return replace(markers, markers={k: replace(tag, id=k) for k, tag in enumerate(ordered)})
